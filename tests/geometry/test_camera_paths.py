"""Rings and blends of cameras; `orbit_cameras` is tested with the cameras."""

import dataclasses
import itertools
import math

import pytest
import torch

from monopart.geometry.camera_paths import blend_cameras, ring_of_cameras
from monopart.geometry.cameras import Camera
from monopart.geometry.errors import InputError
from monopart.geometry.rotations import axis_angle_to_rotmat, rotation_angle

F64 = torch.float64
TARGET = torch.tensor([0.3, -0.2, 1.0], dtype=F64)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, 2.0, 0.0), (1.0, -1.0, 0.5)])
@pytest.mark.parametrize("elevation", [0.0, 0.5, -1.2])
def test_a_ring_looks_at_its_target_from_its_height(up, elevation):
    axis = torch.tensor(up, dtype=F64)
    ring = ring_of_cameras(TARGET, axis, 2.5, elevation, 5, (40, 60), 0.8)
    unit = axis / axis.norm()
    middle = torch.tensor([30.0, 20.0], dtype=F64)
    for camera in ring:
        arm = camera.center - TARGET
        assert float(arm.norm()) == pytest.approx(2.5)
        assert float(arm @ unit) == pytest.approx(2.5 * math.sin(elevation))
        torch.testing.assert_close(camera.project(TARGET)[0], middle)
        assert float(camera.project(TARGET + 0.1 * unit)[0][1]) < 20  # up is up
    arms = torch.stack([c.center - TARGET for c in ring])
    flat = arms - (arms @ unit)[:, None] * unit
    for one, two in zip(flat, flat.roll(-1, 0), strict=True):
        sine = torch.linalg.cross(one, two) @ unit / one.square().sum()
        assert float(sine) == pytest.approx(math.sin(2 * math.pi / 5))


def ends() -> tuple[Camera, Camera]:
    K = torch.tensor([[50.0, 0, 30], [0, 50, 20], [0, 0, 1]], dtype=F64)
    R = axis_angle_to_rotmat(torch.tensor([0.1, 0.2, -0.3], dtype=F64))
    first = Camera(K, R, torch.tensor([0.1, 0.2, 3.0], dtype=F64), (40, 60))
    turn = axis_angle_to_rotmat(torch.tensor([0.6, -1.1, 0.4], dtype=F64))
    K = K * torch.tensor([[2.0], [2.0], [1.0]], dtype=F64)
    return first, Camera(K, turn @ R, torch.tensor([-1.0, 0.2, 2.0], dtype=F64), (40, 60))


@pytest.mark.parametrize("count", [2, 3, 7])
def test_a_blend_turns_and_moves_evenly(count):
    first, last = ends()
    path = blend_cameras(first, last, count)
    assert len(path) == count and path[0] is first and path[-1] is last
    steps = [rotation_angle(a.R, b.R) for a, b in itertools.pairwise(path)]
    torch.testing.assert_close(
        torch.stack(steps), rotation_angle(first.R, last.R).expand(count - 1) / (count - 1)
    )
    for i, camera in enumerate(path):
        share = i / (count - 1)
        torch.testing.assert_close(camera.center, torch.lerp(first.center, last.center, share))
        torch.testing.assert_close(camera.K, torch.lerp(first.K, last.K, share))


def test_wrong_paths_are_refused():
    first, last = ends()
    up, zero = torch.tensor([0.0, 0, 1], dtype=F64), torch.zeros(3, dtype=F64)
    bent = dataclasses.replace(last, distortion=torch.full((4,), 0.1, dtype=F64))
    for call, message in (
        (lambda: blend_cameras(first, last, 1), "at least 2"),
        (lambda: blend_cameras(first, last.resized(0.5), 3), "one size and lens"),
        (lambda: blend_cameras(first, bent, 3), "one size and lens"),
        (lambda: ring_of_cameras(TARGET, up, 0.0, 0.0, 3, (4, 4), 1.0), "distance"),
        (lambda: ring_of_cameras(TARGET, up, 1.0, 1.6, 3, (4, 4), 1.0), "elevation"),
        (lambda: ring_of_cameras(TARGET, zero, 1.0, 0.0, 3, (4, 4), 1.0), "up: expected"),
        (lambda: ring_of_cameras(TARGET, up, 1.0, 0.0, 0, (4, 4), 1.0), "at least one camera"),
        (lambda: ring_of_cameras(TARGET, up, 1.0, 0.0, 3, (4, 4), 60.0), "convert degrees"),
    ):
        with pytest.raises(InputError, match=message):
            call()
