"""The fisheye lens and the tilted sensor: against OpenCV, by gradcheck and at their limits."""

import dataclasses
import math

import cv2
import numpy as np
import pytest
import torch

from monopart.geometry.cameras import Camera
from monopart.geometry.distortion import distort, distortion_jacobian, fold_radius, undistort
from monopart.geometry.errors import InputError
from monopart.geometry.fisheye import (
    fisheye_distort,
    fisheye_fold_radius,
    fisheye_jacobian,
    fisheye_undistort,
)
from monopart.geometry.tilt import HORIZON, map_plane, tilt_matrix

F64 = torch.float64
FISHEYES = {
    "equidistant": [],
    "action camera": [0.06, -0.02, 0.01, -0.003],
    "strong": [-0.2, 0.05, -0.01, 0.002],
    "folding": [-0.4, 0.0, 0.0, 0.0],
}
K = [[310.0, 3.0, 255.0], [0.0, 305.0, 240.0], [0.0, 0.0, 1.0]]


def lens(name: str, dtype: torch.dtype = F64) -> torch.Tensor:
    return torch.tensor(FISHEYES[name], dtype=dtype)


def disc(radius: float, count: int = 500, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    r, a = torch.rand(2, count, generator=generator, dtype=F64)
    return radius * torch.stack([r * (6.3 * a).cos(), r * (6.3 * a).sin()], -1)


def make_camera(name: str, dtype: torch.dtype = F64) -> Camera:
    R = torch.from_numpy(cv2.Rodrigues(np.array([0.2, -0.5, 0.1]))[0]).to(dtype)
    t = torch.tensor([0.1, -0.2, 1.0], dtype=dtype)
    matrix = torch.tensor(K, dtype=dtype)
    return Camera.from_legacy_pixels(matrix, R, t, (480, 520), lens(name, dtype), "fisheye")


def points_near(count: int = 300) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return (torch.rand(count, 3, generator=generator, dtype=F64) - 0.5) * 1.4


@pytest.mark.parametrize("name", ["equidistant", "action camera", "strong"])
@pytest.mark.parametrize(("dtype", "bound"), [(F64, 1e-9), (torch.float32, 1e-3)])
def test_project_agrees_with_opencv(name, dtype, bound):
    camera = make_camera(name)
    rvec, alpha = cv2.Rodrigues(camera.R.numpy())[0], K[0][1] / K[0][0]
    k = np.array(FISHEYES[name] or [0.0] * 4)
    points = points_near()
    flat = np.array(K)
    flat[0, 1] = 0  # OpenCV takes the skew as a ratio beside K
    expected, _ = cv2.fisheye.projectPoints(
        points.numpy()[:, None], rvec, camera.t.numpy(), flat, k, alpha=alpha
    )
    pixels, depth = camera.to(torch.zeros(1, dtype=dtype)).project(points.to(dtype))
    assert bool((depth > 0).all())
    assert np.abs(pixels.numpy() - 0.5 - expected[:, 0]).max() <= bound


@pytest.mark.parametrize("name", ["action camera", "strong"])
def test_rays_agree_with_opencv(name):
    camera = make_camera(name)
    flat = np.array(K)
    flat[0, 1] = 0
    straight = dataclasses.replace(
        camera, K=torch.from_numpy(flat) + camera.K - torch.tensor(K, dtype=F64)
    )
    local = straight.to_camera(points_near())
    # OpenCV's ten steps do not arrive for rays near 90 degrees
    usual = points_near()[local[:, :2].norm(dim=-1) < 3 * local[:, 2]]
    pixels, _ = straight.project(usual)
    plane = cv2.fisheye.undistortPoints(
        pixels.numpy()[:, None] - 0.5, flat, np.array(FISHEYES[name])
    )
    local = straight.rays(pixels).directions @ straight.R.T
    # OpenCV stops its iteration at 1e-8
    np.testing.assert_allclose((local[:, :2] / local[:, 2:]).numpy(), plane[:, 0], atol=1e-6)


@pytest.mark.parametrize("name", FISHEYES)
@pytest.mark.parametrize(("dtype", "bound"), [(F64, 1e-10), (torch.float32, 1e-5)])
def test_world_pixel_ray_world(name, dtype, bound):
    camera = make_camera(name, dtype)
    points = points_near().to(dtype)
    points = points[
        camera.to_camera(points)[:, :2].norm(dim=-1)
        < 0.95 * camera.fold_radius * camera.to_camera(points)[:, 2]
    ]
    assert len(points) > 100
    rays, valid = camera.rays_with_mask(camera.project(points)[0])
    assert bool(valid.all())
    distance = (points - camera.center).norm(dim=-1)
    assert float((rays.at(distance) - points).abs().max()) <= bound


@pytest.mark.parametrize("name", FISHEYES)
def test_undistort_has_a_small_residual_or_no_mask(name):
    target = torch.cartesian_prod(*[torch.linspace(-2, 2, 81, dtype=F64)] * 2)
    ideal, valid = fisheye_undistort(target, lens(name))
    assert bool(torch.isfinite(ideal).all())
    residual = (fisheye_distort(ideal, lens(name)) - target).norm(dim=-1)
    assert float(residual[valid].max()) < 1e-12
    fold = fisheye_fold_radius(lens(name))
    edge = float(fisheye_distort(torch.tensor([fold, 0.0], dtype=F64), lens(name))[0])
    assert bool(valid[target.norm(dim=-1) < 0.999 * edge].all())
    assert not bool(valid[target.norm(dim=-1) > edge].any())


@pytest.mark.parametrize("name", FISHEYES)
def test_fold_radius_is_where_the_image_stops_growing(name):
    fold = math.atan(fisheye_fold_radius(lens(name)))
    theta = torch.linspace(0, math.atan(1e3), 200001, dtype=F64)
    image = fisheye_distort(torch.stack([theta.tan(), 0 * theta], -1), lens(name))[:, 0]
    falling = (image[1:] <= image[:-1]).nonzero()
    first = float(theta[int(falling[0])]) if len(falling) else math.atan(1e3)
    assert fold == pytest.approx(first, abs=2e-5)


def test_known_angles():
    points = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, -math.sqrt(3)]], dtype=F64)
    found = fisheye_distort(points, torch.zeros(0, dtype=F64))
    expected = torch.tensor([[0, 0], [math.pi / 4, 0], [0, -math.pi / 3]], dtype=F64)
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("name", FISHEYES)
def test_jacobian_is_the_derivative_also_at_the_axis(name):
    points = torch.cat([disc(0.9, 20), disc(1.2e-3, 20), torch.zeros(1, 2, dtype=F64)])
    each = torch.func.vmap(torch.func.jacrev(lambda p: fisheye_distort(p, lens(name))))
    torch.testing.assert_close(fisheye_jacobian(points, lens(name)), each(points))


@pytest.mark.parametrize("radius", [0.0, 1e-4, 0.7])
def test_gradients_of_distort_and_undistort(radius):
    coefficients = lens("action camera").requires_grad_()
    points = disc(radius, 4).requires_grad_()
    assert torch.autograd.gradcheck(fisheye_distort, (points, coefficients))
    target = fisheye_distort(points, coefficients).detach().requires_grad_()
    fold = fisheye_fold_radius(coefficients)
    assert torch.autograd.gradcheck(
        lambda p, k: fisheye_undistort(p, k, fold)[0], (target, coefficients), atol=1e-6
    )


def test_gradients_of_the_camera():
    camera = make_camera("action camera")

    def rays(pixels, k):
        return dataclasses.replace(camera, distortion=k).rays(pixels).directions

    def project(points, k):
        return dataclasses.replace(camera, distortion=k).project(points)

    k = camera.distortion.clone().requires_grad_()
    assert torch.autograd.gradcheck(project, (points_near(2).requires_grad_(), k), atol=1e-4)
    pixels = camera.project(points_near(2))[0].requires_grad_()
    assert torch.autograd.gradcheck(rays, (pixels, k), atol=1e-6)


def test_gradients_stay_finite_where_no_ray_exists():
    coefficients = lens("folding").requires_grad_()
    target = torch.tensor([[3.0, 4.0], [0.0, 0.0], [0.1, 0.1]], dtype=F64, requires_grad=True)
    ideal, valid = fisheye_undistort(target, coefficients)
    assert valid.tolist() == [False, True, True]
    ideal.sum().backward()
    assert target.grad is not None and coefficients.grad is not None
    assert bool(torch.isfinite(target.grad).all() and torch.isfinite(coefficients.grad).all())
    assert target.grad[0].tolist() == [0, 0] and target.grad[1].tolist() == [1, 1]


def test_a_fisheye_without_coefficients_is_distorted():
    camera = make_camera("equidistant")
    assert camera.is_distorted and camera.distortion.shape == (0,)
    ideal, source = camera.undistorted()
    assert ideal.lens == "brown" and not ideal.is_distorted and torch.equal(ideal.K, camera.K)
    rays, valid = camera.rays_with_mask(source)
    assert bool(valid.all())
    torch.testing.assert_close(rays.directions, ideal.rays(ideal.pixel_grid()).directions)
    assert camera.resized(0.5).lens == camera.cropped((1, 2, 30, 40)).lens == "fisheye"


def test_points_at_the_rim_stay_outside():
    camera = make_camera("folding")
    plain = dataclasses.replace(camera, R=torch.eye(3, dtype=F64), t=torch.zeros(3, dtype=F64))
    x = torch.linspace(0, 1e5, 500, dtype=F64).requires_grad_()
    pixels, _ = plain.project(torch.stack([x, 0 * x, 0 * x + 1], -1))
    assert bool((pixels[1:, 0] > pixels[:-1, 0]).all())
    pixels.sum().backward()
    assert x.grad is not None and bool(torch.isfinite(x.grad).all())


def test_empty_and_wrong_inputs():
    empty = torch.zeros(0, 2, dtype=F64)
    assert fisheye_distort(empty, lens("strong")).shape == (0, 2)
    ideal, valid = fisheye_undistort(empty, lens("strong"))
    assert ideal.shape == (0, 2) and valid.shape == (0,)
    with pytest.raises(InputError, match="expected the 4 coefficients"):
        fisheye_distort(empty, torch.zeros(5, dtype=F64))


# --- the tilted sensor ----------------------------------------------------------------------------

TILT = [-0.1, 0.01, 1e-3, 2e-3, 0.0, 0.0, 0.0, 0.0, 0.01, -2e-3, 4e-3, 1e-3, 0.25, -0.3]


def test_the_tilt_is_that_of_opencv():
    points = torch.cat([disc(0.6, 200), torch.ones(200, 1, dtype=F64)], -1)
    expected = cv2.projectPoints(
        points.numpy(), np.zeros(3), np.zeros(3), np.eye(3), np.array(TILT)
    )
    found = distort(points[:, :2], torch.tensor(TILT, dtype=F64))
    np.testing.assert_allclose(found.numpy(), expected[0][:, 0], atol=1e-13)


def test_a_tilt_is_undone_exactly():
    k = torch.tensor(TILT, dtype=F64)
    points = disc(min(0.9 * fold_radius(k), 1.5))
    ideal, valid = undistort(distort(points, k), k)
    assert bool(valid.all()) and float((ideal - points).abs().max()) < 1e-11
    each = torch.func.vmap(torch.func.jacrev(lambda p: distort(p, k)))
    torch.testing.assert_close(distortion_jacobian(points, k), each(points))


def test_beyond_the_horizon_there_is_no_image():
    H = tilt_matrix(torch.tensor([0.0, 1.0], dtype=F64))
    x = torch.linspace(-30, 30, 601, dtype=F64)
    points = torch.stack([x, 0 * x], -1).requires_grad_()
    moved, valid = map_plane(points, H)
    below = points.detach() @ H[2, :2] + H[2, 2]
    assert torch.equal(valid, below > HORIZON) and 0 < int(valid.sum()) < 601
    moved.sum().backward()
    assert bool(torch.isfinite(moved).all())
    assert points.grad is not None and bool(torch.isfinite(points.grad).all())
    k = torch.tensor([0.0] * 12 + [0.0, 1.0], dtype=F64)
    ideal, exists = undistort(torch.stack([x, 0 * x], -1), k)
    assert bool(torch.isfinite(ideal).all()) and not bool(exists.all()) and bool(exists[300])
    residual = (distort(ideal, k) - torch.stack([x, 0 * x], -1)).abs()
    assert float(residual[exists].max()) < 1e-9


def test_gradients_of_the_tilt():
    angles = torch.tensor([0.2, -0.1], dtype=F64, requires_grad=True)
    points = disc(0.5, 3).requires_grad_()
    assert torch.autograd.gradcheck(lambda p, a: map_plane(p, tilt_matrix(a))[0], (points, angles))


def test_a_camera_does_not_see_beyond_the_horizon_of_its_tilt():
    k = torch.tensor([0.0] * 12 + [0.0, 0.5], dtype=F64)
    radius = fold_radius(k)  # the horizon lies at 1 / tan 0.5, and 72 directions are searched
    assert 0.97 / math.tan(0.5) < radius < 1 / math.tan(0.5)
    K = torch.tensor([[100.0, 0, 0], [0, 100, 0], [0, 0, 1]], dtype=F64)
    size, zero = (10**6, 10**6), torch.zeros(3, dtype=F64)
    camera = Camera(K, torch.eye(3, dtype=F64), zero, size, k).cropped((-(10**5), -(10**5), *size))
    x = torch.linspace(-4, 4, 801, dtype=F64)
    points = torch.stack([x, 0 * x, 0 * x + 1], -1)
    assert torch.equal(camera.visible(points), x.abs() < radius)
    assert bool(torch.isfinite(camera.project(points)[0]).all())
