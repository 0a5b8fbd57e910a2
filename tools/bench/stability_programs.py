"""Stress of cameras that are stated as other programs state them."""

import tempfile
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.camera_conventions import (
    camera_from_blender,
    camera_from_opengl,
    camera_from_pytorch3d,
    camera_to_blender,
    camera_to_opengl,
    camera_to_pytorch3d,
)
from monopart.geometry.cameras import Camera
from monopart.geometry.rotations import axis_angle_to_rotmat
from monopart.toolkit.captures.colmap import read_colmap, write_colmap

from .stability_cases import DOUBLE, Family, Inputs, Stress, Way
from .stability_rotations import Make, exact_rotmat

_NEAR, _FAR = 1e-3, 1e6


def _posed(
    focal: float = 1000.0, centre: float = 256.0, away: float = 0.0, depth: float = 3.0
) -> Make:
    """Points in front of a camera, its rotation vector and translation, and fx, fy, cx, cy."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        turn = torch.tensor([0.3, -0.7, 0.2], dtype=DOUBLE)
        R = axis_angle_to_rotmat(turn)
        shift = torch.tensor([0.1, -0.2, 0.5], dtype=DOUBLE) - R @ torch.full((3,), away).double()
        z = depth * (1 + torch.rand(count, 1, generator=generator, dtype=DOUBLE))
        plane = 0.6 * torch.rand(count, 2, generator=generator, dtype=DOUBLE) - 0.3
        points = (torch.cat((plane * z, z), 1) - shift) @ R
        lens = torch.tensor([[focal, 1.1 * focal, centre, centre + 1]], dtype=DOUBLE)
        return points, torch.cat((turn, shift))[None], lens

    return make


def _house(size: tuple[int, int], pose: Tensor, lens: Tensor) -> Camera:
    fx, fy, cx, cy = lens[0]
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    K = torch.stack((fx, zero, cx, zero, fy, cy, zero, zero, one)).view(3, 3)
    return Camera(K, axis_angle_to_rotmat(pose[0, :3]), pose[0, 3:], size)


def _opengl(camera: Camera, points: Tensor) -> Tensor:
    """Pixels by clip space."""
    view, projection = camera_to_opengl(camera, _NEAR, _FAR)
    ones = torch.ones_like(points[:, :1])
    clip = torch.cat((points, ones), 1) @ view.mT @ projection.mT
    height, width = camera.size
    plane = clip[:, :2] / clip[:, 3:]
    middle = points.new_tensor([width / 2, height / 2])
    return middle + plane * middle * points.new_tensor([1, -1])


def _pytorch3d(camera: Camera, points: Tensor) -> Tensor:
    """Pixels by its normalised coordinates."""
    made = camera_to_pytorch3d(camera)
    local = points @ made.R + made.T
    plane = made.focal_length * local[:, :2] / local[:, 2:] + made.principal_point
    height, width = made.image_size
    return points.new_tensor([width / 2, height / 2]) - plane * min(height, width) / 2


def _colmap(camera: Camera, points: Tensor) -> Tensor:
    with tempfile.TemporaryDirectory() as folder:
        write_colmap(folder, {"a.png": camera})
        (found,) = read_colmap(folder).values()
    return found.to(points).project(points)[0]


def _conventions() -> Stress:
    def by(pixels: Callable[[Camera, Tensor], Tensor]) -> Callable[..., Tensor]:
        return lambda size, points, pose, lens: pixels(_house(size, pose, lens), points)

    def back(turned: Callable[[Camera], Camera]) -> Callable[..., Tensor]:
        return by(lambda camera, points: turned(camera).project(points)[0])

    ways = (
        Way("OpenGL", by(_opengl), True),
        Way(
            "OpenGL and back",
            back(lambda c: camera_from_opengl(*camera_to_opengl(c, _NEAR, _FAR), c.size)),
            True,
        ),
        Way("PyTorch3D", by(_pytorch3d), True),
        Way(
            "PyTorch3D and back",
            back(lambda c: camera_from_pytorch3d(camera_to_pytorch3d(c))),
            True,
        ),
        Way(
            "Blender and back",
            back(lambda c: camera_from_blender(camera_to_blender(c))),
            True,
            differentiable=False,
        ),
        Way("COLMAP and back", by(_colmap), True, differentiable=False),
    )

    def exact(size: Any, points: np.ndarray, pose: np.ndarray, lens: np.ndarray) -> np.ndarray:
        local = points @ exact_rotmat(None, pose[:, :3])[0].T + pose[0, 3:]
        return local[:, :2] / local[:, 2:] * lens[0, :2] + lens[0, 2:]

    def scale(size: Any, exact: np.ndarray, points: Any, pose: Any, lens: Any) -> np.ndarray:
        depth = points @ exact_rotmat(None, pose[:, :3])[0, 2] + pose[0, 5]
        largest = np.maximum(np.abs(points).max(1), np.abs(pose[0, 3:]).max())
        carried = lens[0, :2].max() * largest / depth * 1.5
        return np.maximum(carried, max(np.abs(lens[0, 2:]).max(), *size)) + np.abs(exact).max(1)

    square, wide = (512, 512), (3, 16384)
    shapes = (
        *(("3 m", square, _posed()), ("3 × 16384 pixels", wide, _posed(4e4, 8000.0))),
        *(("one pixel", (1, 1), _posed(2.0, 0.5)), ("depth 1e-2", square, _posed(depth=1e-2))),
        *(("focal 1", square, _posed(1.0)), ("focal 1e6", square, _posed(1e6))),
        ("principal point outside", square, _posed(1000.0, -5000.0)),
        ("100 km away", square, _posed(away=1e5)),
    )
    families = [Family(n, m, extra=s, step=1e-7, smooth=n != "100 km away") for n, s, m in shapes]
    return Stress(
        name="camera_conventions",
        title="cameras of other programs (pixels of points)",
        domain="pinholes of any size and intrinsics; a lens, and skew for Blender and PyTorch3D, "
        "is an error; of Blender and COLMAP the way there and back is measured",
        error="f·S/z, S the largest coordinate; principal point, image and pixel where larger",
        families=tuple(families),
        ways=ways,
        exact=exact,
        scale=scale,
        wrt=(0, 1, 2),
        rows_apart=False,
        cases=64,
    )


def stresses() -> list[Stress]:
    """Cameras of other programs."""
    return [_conventions()]
