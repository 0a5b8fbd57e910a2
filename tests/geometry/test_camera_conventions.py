"""Cameras of OpenGL, Blender and PyTorch3D: each against that program or its documented formula."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from monopart.geometry.camera_conventions import (
    BlenderCamera,
    camera_from_blender,
    camera_from_opengl,
    camera_from_pytorch3d,
    camera_to_blender,
    camera_to_opengl,
    camera_to_pytorch3d,
)
from monopart.geometry.cameras import Camera
from monopart.geometry.errors import InputError
from monopart.geometry.rotations import axis_angle_to_rotmat

F64 = torch.float64
POINTS = torch.tensor([[0.1, 0.2, 0.3], [-0.4, 0.5, -0.2], [0.7, -0.3, 0.6]], dtype=F64)
SHAPES = [
    ([[537.1, 0, 251.3], [0, 537.1, 247.9], [0, 0, 1]], (480, 520)),
    ([[400.0, 0, 150], [0, 320.0, 300], [0, 0, 1]], (512, 320)),
    ([[300.0, 0, 170], [0, 420.0, 100], [0, 0, 1]], (240, 320)),
]
# matrix_world of `camera_to_blender` set in bpy 4.2.0, sensor fit HORIZONTAL, projected by
# `calc_matrix_camera` (float32)
BLENDER = [
    [[241.2511, 225.2030], [204.6791, 310.3588], [303.3241, 149.7612]],
    [[142.5162, 286.4773], [115.2796, 337.2125], [188.7444, 241.5297]],
    [[164.3872, 82.2515], [143.9597, 148.8414], [199.0583, 23.2577]],
]


def make_camera(shape: int = 0) -> Camera:
    K, size = SHAPES[shape]
    R = axis_angle_to_rotmat(torch.tensor([0.4, -0.7, 0.2], dtype=F64))
    t = torch.tensor([0.1, -0.2, 3.0], dtype=F64)
    return Camera(torch.tensor(K, dtype=F64), R, t, size)


def same(found: Camera, expected: Camera) -> None:
    assert found.size == expected.size
    for name in ("K", "R", "t"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name))


# --- Blender --------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [0, 1, 2])
def test_blender_projects_to_the_same_pixels(shape):
    pixels, _ = make_camera(shape).project(POINTS)
    np.testing.assert_allclose(pixels.numpy(), BLENDER[shape], atol=2e-4)


def test_blender_properties():
    """Those that were set in Blender for the figures above."""
    made = [camera_to_blender(make_camera(shape)) for shape in range(3)]
    found = [(b.lens, b.shift_x, b.shift_y, b.pixel_aspect_y) for b in made]
    expected = [
        (37.18384615384616, 0.01673076923076921, 0.015192307692307703, 1.0),
        (45.0, 0.03125, 0.171875, 1.25),
        (33.75, -0.03125, -0.044642857142857144, 0.7142857142857143),
    ]
    np.testing.assert_allclose(found, expected)
    world = made[0].matrix_world
    torch.testing.assert_close(world[:3, 3], make_camera().center)
    ahead = make_camera().rays(torch.tensor([251.3, 247.9], dtype=F64)).directions
    torch.testing.assert_close(-world[:3, 2], ahead)  # Blender's cameras look along −z


@pytest.mark.parametrize("shape", [0, 1, 2])
def test_blender_and_back(shape):
    same(camera_from_blender(camera_to_blender(make_camera(shape), 24.0)), make_camera(shape))


def test_the_synthetic_scenes_of_nerf():
    """Their `camera_angle_x` is the horizontal field of view of a camera without shift."""
    angle, size = 0.6911, (800, 800)
    lens = 18 / math.tan(angle / 2)
    world = torch.eye(4, dtype=F64)
    world[2, 3] = 4.0
    camera = camera_from_blender(BlenderCamera(world, lens, 36.0, 0.0, 0.0, 1.0, size))
    assert float(camera.K[0, 0]) == pytest.approx(400 / math.tan(angle / 2))
    pixels, depth = camera.project(torch.tensor([0.5, 0.25, 0.0], dtype=F64))
    assert float(depth) == 4 and float(pixels[0]) > 400 > float(pixels[1])


# --- OpenGL ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [0, 1, 2])
def test_opengl_window_coordinates(shape):
    """The fixed pipeline: clip, divide, viewport with its origin at the bottom left."""
    camera = make_camera(shape)
    view, projection = camera_to_opengl(camera, 0.1, 10.0)
    homogeneous = torch.cat([POINTS, torch.ones(3, 1, dtype=F64)], 1)
    clip = homogeneous @ view.T @ projection.T
    device = clip[:, :3] / clip[:, 3:]
    height, width = camera.size
    window = (device[:, :2] + 1) / 2 * torch.tensor([width, height])
    pixels, depth = camera.project(POINTS)
    torch.testing.assert_close(window[:, 0], pixels[:, 0])
    torch.testing.assert_close(height - window[:, 1], pixels[:, 1])
    torch.testing.assert_close(clip[:, 3], depth)
    # glFrustum's depth row: −1 on the near plane, 1 on the far one
    ends = torch.tensor([[0, 0, -0.1, 1], [0, 0, -10.0, 1]], dtype=F64) @ projection.T
    torch.testing.assert_close(ends[:, 2] / ends[:, 3], torch.tensor([-1.0, 1.0], dtype=F64))
    eye = POINTS @ view[:3, :3].T + view[:3, 3]
    assert bool((eye[:, 2] < 0).all())


def test_opengl_is_the_frustum_of_the_specification():
    K = torch.tensor([[50.0, 0, 20], [0, 40, 35], [0, 0, 1]], dtype=F64)
    camera = Camera(K, torch.eye(3, dtype=F64), torch.zeros(3, dtype=F64), (60, 80))
    near, far = 0.5, 9.0
    left, right = -20 / 50 * near, 60 / 50 * near
    top, bottom = 35 / 40 * near, -25 / 40 * near
    expected = [
        [2 * near / (right - left), 0, (right + left) / (right - left), 0],
        [0, 2 * near / (top - bottom), (top + bottom) / (top - bottom), 0],
        [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
        [0, 0, -1, 0],
    ]
    view, projection = camera_to_opengl(camera, near, far)
    np.testing.assert_allclose(projection.numpy(), expected, atol=1e-15)
    assert torch.equal(view, torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=F64)))


@pytest.mark.parametrize("shape", [0, 1, 2])
def test_opengl_and_back(shape):
    camera = make_camera(shape)
    skewed = dataclasses.replace(camera, K=camera.K + torch.tensor([[0, 3.0, 0], [0] * 3, [0] * 3]))
    for one in (camera, skewed):
        same(camera_from_opengl(*camera_to_opengl(one, 0.1, 5.0), one.size), one)


# --- PyTorch3D ------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [0, 1, 2])
def test_pytorch3d_by_its_documented_formula(shape):
    """Row vectors X R + T; NDC f x/z + p with x left, y up, ±1 at the ends of the shorter side."""
    camera = make_camera(shape)
    made = camera_to_pytorch3d(camera)
    local = POINTS @ made.R + made.T
    ndc = made.focal_length * local[:, :2] / local[:, 2:] + made.principal_point
    height, width = camera.size
    half = min(height, width) / 2
    pixels, depth = camera.project(POINTS)
    torch.testing.assert_close(width / 2 - half * ndc[:, 0], pixels[:, 0])
    torch.testing.assert_close(height / 2 - half * ndc[:, 1], pixels[:, 1])
    torch.testing.assert_close(local[:, 2], depth)
    assert float(torch.linalg.det(made.R)) == pytest.approx(1)


@pytest.mark.parametrize("shape", [0, 1, 2])
def test_pytorch3d_and_back(shape):
    same(camera_from_pytorch3d(camera_to_pytorch3d(make_camera(shape))), make_camera(shape))


def test_gradients_pass_through():
    base = make_camera()

    def through(K, R, t):
        camera = Camera(K, R, t, base.size)
        made = camera_to_pytorch3d(camera)
        view, projection = camera_to_opengl(camera, 0.1, 5.0)
        return made.R, made.T, made.focal_length, made.principal_point, view, projection

    t = base.t.clone().requires_grad_()
    K = base.K.clone().requires_grad_()
    outputs = through(K, base.R.clone().requires_grad_(), t)
    assert all(o.requires_grad for o in outputs)
    assert torch.autograd.gradcheck(lambda t: through(base.K, base.R, t)[1], (t,))


# --- what cannot be said --------------------------------------------------------------------------


def test_what_has_no_counterpart_is_refused():
    lens = torch.tensor([0.1, 0, 0, 0], dtype=F64)
    camera = make_camera()
    bent = dataclasses.replace(camera, distortion=lens)
    skewed = dataclasses.replace(camera, K=camera.K + torch.tensor([[0, 3.0, 0], [0] * 3, [0] * 3]))
    for convert in (
        camera_to_blender,
        camera_to_pytorch3d,
        lambda c: camera_to_opengl(c, 0.1, 1.0),
    ):
        with pytest.raises(InputError, match="expected a pinhole"):
            convert(bent)
    for convert in (camera_to_blender, camera_to_pytorch3d):
        with pytest.raises(InputError, match="expected no skew, found 3 pixels"):
            convert(skewed)
    for near, far in ((0.0, 1.0), (2.0, 1.0), (math.nan, 1.0)):
        with pytest.raises(InputError, match="0 < near < far"):
            camera_to_opengl(camera, near, far)
    view, projection = camera_to_opengl(camera, 0.1, 1.0)
    with pytest.raises(InputError, match="view: expected a last row"):
        camera_from_opengl(view.T, projection, camera.size)
    with pytest.raises(InputError, match="projection: expected a perspective"):
        camera_from_opengl(view, projection.T, camera.size)
    with pytest.raises(InputError, match="sensor_width"):
        camera_to_blender(camera, 0.0)
    with pytest.raises(InputError, match="lens: expected a number above 0"):
        camera_from_blender(dataclasses.replace(camera_to_blender(camera), lens=0.0))
