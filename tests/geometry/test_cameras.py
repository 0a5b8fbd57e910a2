"""Cameras against OpenCV, against themselves after resizing and cropping, and by gradcheck."""

import dataclasses
import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from monopart.geometry.camera_paths import orbit_cameras
from monopart.geometry.cameras import MIN_DEPTH, Camera, Rays
from monopart.geometry.errors import InputError

F64 = torch.float64
COEFFICIENTS = {
    0: [],
    4: [-0.2, 0.03, 0.0006, -0.0004],
    5: [-0.2, 0.03, 0.0006, -0.0004, 0.002],
    8: [-0.2, 0.03, 0.0006, -0.0004, 0.002, 0.05, -0.01, 0.003],
    12: [-0.2, 0.03, 0.0006, -0.0004, 0.002, 0.05, -0.01, 0.003, 0.002, -0.001, 0.0015, 0.0007],
    14: [-0.2, 0.03, 6e-4, -4e-4, 0.002, 0.05, -0.01, 0.003, 0.002, -1e-3, 0.0015, 7e-4, 0.1, -0.2],
}
MATRIX = [[537.1, 0.0, 251.3], [0.0, 536.2, 247.9], [0.0, 0.0, 1.0]]


def make_camera(count: int = 0, dtype: torch.dtype = F64, legacy: bool = False) -> Camera:
    rotation = torch.from_numpy(cv2.Rodrigues(np.array([0.2, -0.5, 0.1]))[0]).to(dtype)
    make = Camera.from_legacy_pixels if legacy else Camera
    t = torch.tensor([0.1, -0.2, 3.0], dtype=dtype)
    K = torch.tensor(MATRIX, dtype=dtype)
    return make(K, rotation, t, (480, 520), torch.tensor(COEFFICIENTS[count], dtype=dtype))


def points_near(count: int = 300, dtype: torch.dtype = F64, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return ((torch.rand(count, 3, generator=generator, dtype=F64) - 0.5) * 2).to(dtype)


def camera_pixels(camera: Camera, count: int = 400, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor([camera.size[1], camera.size[0]])
    return (torch.rand(count, 2, generator=generator, dtype=F64) * size).to(camera.K)


@pytest.mark.parametrize("count", COEFFICIENTS)
@pytest.mark.parametrize(("dtype", "bound"), [(F64, 1e-9), (torch.float32, 1e-3)])
def test_project_agrees_with_opencv(count, dtype, bound):
    points = points_near()
    camera = make_camera(count, legacy=True)
    expected, _ = cv2.projectPoints(
        points.numpy(),
        cv2.Rodrigues(camera.R.numpy())[0],
        camera.t.numpy(),
        np.array(MATRIX),
        np.array(COEFFICIENTS[count] or [0.0] * 4),
    )
    pixels, depth = camera.to(torch.zeros(1, dtype=dtype)).project(points.to(dtype))
    assert pixels.dtype == dtype
    # OpenCV puts pixel centres at whole numbers, the house at +½
    assert np.abs(pixels.numpy() - 0.5 - expected[:, 0]).max() <= bound
    local = points @ camera.R.T + camera.t
    torch.testing.assert_close(depth.to(F64), local[:, 2], rtol=0, atol=bound)


def test_pixel_slopes_are_those_of_project():
    camera = make_camera()
    skewed = dataclasses.replace(
        camera, K=camera.K + torch.tensor([[0.0, 7, 0], [0, 0, 0], [0] * 3])
    )
    points = points_near(40)
    for one in (camera, skewed):
        expected = torch.func.vmap(torch.func.jacrev(lambda p, c=one: c.project(p)[0]))(points)
        torch.testing.assert_close(one.pixel_slopes(points), expected, rtol=1e-10, atol=1e-8)
    assert torch.autograd.gradcheck(camera.pixel_slopes, points[:4].clone().requires_grad_())


def test_pixel_slopes_before_the_nearest_depth_are_finite():
    camera = Camera(torch.eye(3), torch.eye(3), torch.zeros(3), (4, 4))
    points = torch.tensor([[0.0, 0.0, -1.0], [0.5, 0.0, 0.0]])
    assert camera.pixel_slopes(points).isfinite().all()
    at_one = torch.tensor([[1.0, 0, 0], [0, 1, 0]])
    torch.testing.assert_close(camera.pixel_slopes(points[0], nearest=1.0), at_one)


def test_pixel_slopes_of_a_lens_are_refused():
    with pytest.raises(InputError, match="without_lens"):
        make_camera(4).pixel_slopes(points_near(2))


def test_legacy_pixels_move_centres_by_half():
    K = torch.tensor([[100.0, 0, 7], [0, 100, 5], [0, 0, 1]])
    camera = Camera.from_legacy_pixels(K, torch.eye(3), torch.zeros(3), (11, 15))
    pixels, _ = camera.project(torch.tensor([0.0, 0.0, 1.0]))
    assert pixels.tolist() == [7.5, 5.5]
    assert camera.pixel_grid()[5, 7].tolist() == [7.5, 5.5]
    assert camera.distortion.shape == (0,)


def test_pixel_grid_is_pixel_centres_as_x_y():
    grid = make_camera().pixel_grid()
    assert grid.shape == (480, 520, 2)
    assert grid.dtype == F64
    assert grid[3, 9].tolist() == [9.5, 3.5]


@pytest.mark.parametrize("count", COEFFICIENTS)
@pytest.mark.parametrize(("dtype", "bound"), [(F64, 1e-9), (torch.float32, 1e-5)])
def test_world_pixel_ray_world(count, dtype, bound):
    camera = make_camera(count, dtype)
    points = points_near(dtype=dtype)
    pixels, _ = camera.project(points)
    rays, valid = camera.rays_with_mask(pixels)
    assert bool(valid.all())
    assert rays.directions.dtype == dtype
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(300, dtype=dtype))
    distance = (points - camera.center).norm(dim=-1)
    assert float((rays.at(distance) - points).abs().max()) <= bound


@pytest.mark.parametrize("shape", [(), (0,), (2, 3), (2, 0, 4)])
def test_any_leading_batch(shape):
    camera = make_camera(5)
    pixels, depth = camera.project(torch.zeros(*shape, 3, dtype=F64))
    assert pixels.shape == (*shape, 2)
    assert depth.shape == shape
    rays, valid = camera.rays_with_mask(pixels)
    assert rays.origins.shape == rays.directions.shape == (*shape, 3)
    assert valid.shape == camera.visible(rays.origins).shape == shape


def test_dtype_follows_the_points():
    camera = make_camera(5)
    pixels, depth = camera.project(points_near(dtype=torch.float32))
    assert pixels.dtype == depth.dtype == camera.rays(pixels).directions.dtype == torch.float32
    assert camera.to(pixels).K.dtype == torch.float32
    assert camera.to(torch.zeros(1, dtype=F64)) is camera


@pytest.mark.parametrize("count", [0, 5])
@given(scale=st.one_of(st.floats(0.05, 3.0), st.tuples(st.integers(1, 900), st.integers(1, 900))))
@settings(max_examples=25, deadline=None)
def test_project_then_resize_is_resize_then_project(count, scale):
    camera = make_camera(count)
    small = camera.resized(scale)
    ratio = torch.tensor([small.size[1] / 520, small.size[0] / 480], dtype=F64)
    pixels, _ = camera.project(points_near(50))
    torch.testing.assert_close(small.project(points_near(50))[0], pixels * ratio)


def test_resized_is_the_camera_of_the_area_average():
    # a scene that is linear in x/z and y/z has images whose block means are exact
    camera = make_camera()

    def image(view: Camera) -> torch.Tensor:
        local = view.rays(view.pixel_grid()).directions @ view.R.T
        return 3 * local[..., 0] / local[..., 2] - 2 * local[..., 1] / local[..., 2]

    mean = torch.nn.functional.avg_pool2d(image(camera)[None], (4, 2))[0]
    torch.testing.assert_close(image(camera.resized((120, 260))), mean, rtol=0, atol=1e-12)


@given(x=st.integers(-50, 500), y=st.integers(-50, 500), w=st.integers(1, 99), h=st.integers(1, 99))
@settings(max_examples=25, deadline=None)
def test_cropped_moves_pixels(x, y, w, h):
    camera = make_camera(5)
    crop = camera.cropped((x, y, x + w, y + h))
    assert crop.size == (h, w)
    pixels, _ = camera.project(points_near(20))
    moved = pixels - torch.tensor([x, y], dtype=F64)
    torch.testing.assert_close(crop.project(points_near(20))[0], moved)


def test_crop_sees_the_rays_of_its_pixels():
    camera = make_camera(5)
    crop = camera.cropped((100, 50, 130, 90))
    full = camera.rays(camera.pixel_grid()[50:90, 100:130])
    torch.testing.assert_close(crop.rays(crop.pixel_grid()).directions, full.directions)


@pytest.mark.parametrize("count", [0, 5, 12])
@pytest.mark.parametrize("dtype", [F64, torch.float32])
def test_points_behind_or_at_the_camera_stay_finite(count, dtype):
    base = make_camera(count, dtype)
    camera = dataclasses.replace(base, R=torch.eye(3, dtype=dtype), t=torch.zeros(3, dtype=dtype))
    depths = torch.tensor([-3.0, -1e-8, 0.0, 1e-9, 1e-5, 1e-3, 2.0], dtype=dtype)
    points = torch.tensor([[0.0, 0.0, 1.0], [4.0, -3.0, 1.0], [0.1, 0.0, 1.0]], dtype=dtype)
    points = (points[:, None] * torch.stack([torch.ones(7), torch.ones(7), depths], -1)).to(dtype)
    points.requires_grad_()
    pixels, depth = camera.project(points)
    assert bool(torch.isfinite(pixels).all())
    pixels.sum().backward()
    assert points.grad is not None
    assert bool(torch.isfinite(points.grad).all())
    behind = depth <= MIN_DEPTH
    assert behind.sum() == 12
    assert bool((pixels[behind] < 0).all())
    assert not bool(camera.visible(points)[behind].any())
    assert bool(camera.visible(points)[0, -1])


def test_visible_means_front_frame_and_fold():
    eye, zero = torch.eye(3, dtype=F64), torch.zeros(3, dtype=F64)
    barrel = torch.tensor([-0.2, 0.003, 0.0006, -0.0004], dtype=F64)
    camera = dataclasses.replace(make_camera(), R=eye, t=zero, distortion=barrel)
    assert 1.25 < camera.fold_radius < 1.33
    wide = camera.cropped((-2000, -2000, 2500, 2500))
    x = torch.linspace(0, 8, 400, dtype=F64)
    points = torch.stack([x, 0 * x, 0 * x + 1], -1)
    assert bool((wide.visible(points) == (x < camera.fold_radius)).all())
    pixels, _ = camera.project(points)
    inside = (pixels[:, 0] >= 0) & (pixels[:, 0] < 520)
    assert bool((camera.visible(points) == inside).all())
    # beyond the fold the lens formula turns back into the image; ours keeps going out
    assert bool((pixels[1:, 0] > pixels[:-1, 0]).all())


@pytest.mark.parametrize("count", [0, 5, 12])
def test_gradients_of_project_and_rays(count):
    camera = make_camera(count)

    def project(points, K, R, t, distortion):
        pixels, depth = Camera(K, R, t, (480, 520), distortion).project(points)
        return pixels, depth

    def rays(pixels, K, R, t, distortion):
        result = Camera(K, R, t, (480, 520), distortion).rays(pixels)
        return result.origins, result.directions

    inputs = [camera.K, camera.R, camera.t, camera.distortion]
    inputs = [x.clone().requires_grad_(x.numel() > 0 and x is not camera.K) for x in inputs]
    points = points_near(2).requires_grad_()
    assert torch.autograd.gradcheck(project, (points, *inputs), atol=1e-4, rtol=1e-5)
    pixels = camera_pixels(camera, 2).requires_grad_()
    assert torch.autograd.gradcheck(rays, (pixels, *inputs), atol=1e-6, rtol=1e-5)


def test_gradients_of_the_intrinsics():
    K = torch.tensor(MATRIX, dtype=F64, requires_grad=True)
    camera = dataclasses.replace(make_camera(5), K=K)
    pixels, _ = camera.project(points_near(4))
    camera.rays(pixels.detach()).directions[:, 0].sum().backward()
    assert K.grad is not None
    assert float(K.grad[:2, 2].abs().min()) > 0


def test_undistorted_without_distortion_changes_nothing():
    for camera in (
        make_camera(0),
        dataclasses.replace(make_camera(), distortion=torch.zeros(5, dtype=F64)),
    ):
        ideal, source = camera.undistorted()
        assert ideal is camera
        assert bool((source == camera.pixel_grid()).all())


def test_undistorted_map_names_the_source_pixel_of_the_same_ray():
    camera = make_camera(12)
    ideal, source = camera.undistorted()
    assert not ideal.is_distorted
    rays, valid = camera.rays_with_mask(source)
    assert bool(valid.all())
    error = rays.directions - ideal.rays(ideal.pixel_grid()).directions
    assert float(error.abs().max()) <= 1e-12


def test_undistorted_map_minus_half_feeds_remap():
    camera = make_camera(5)

    def image(view: Camera) -> np.ndarray:
        local = view.rays(view.pixel_grid()).directions @ view.R.T
        plane = local[..., :2] / local[..., 2:]
        return (torch.sin(5 * plane[..., 0]) + torch.cos(4 * plane[..., 1])).float().numpy()

    ideal, source = camera.undistorted()
    maps = (source - 0.5).float().numpy()
    found = cv2.remap(image(camera), maps, None, cv2.INTER_LINEAR, borderValue=math.nan)
    error = np.abs(found - image(ideal))[2:-2, 2:-2]
    # half a pixel of offset would cost 5e-3; bilinear taps are rounded to 1/32 px
    assert np.nanmax(error) < 5e-4
    assert np.isfinite(error).mean() > 0.9


def test_look_at_puts_target_in_the_middle_and_up_on_top():
    eye, target = torch.tensor([3.0, -2.0, 1.5]), torch.tensor([0.1, 0.2, 0.9])
    up = torch.tensor([0.0, 0.0, 2.0])
    camera = Camera.look_at(eye, target, up, (200, 300), fov=math.radians(40))
    torch.testing.assert_close(camera.center, eye)
    pixels, depth = camera.project(torch.stack([target, target + 0.1 * up]))
    torch.testing.assert_close(pixels[0], torch.tensor([150.0, 100.0]))
    assert float(pixels[1, 1]) < 100
    assert abs(float(pixels[1, 0]) - 150) < 1e-3
    assert float(depth[0]) == pytest.approx(float((target - eye).norm()))
    top = camera.rays(torch.tensor([150.0, 0.0])).directions
    angle = math.acos(float(top @ (target - eye) / (target - eye).norm()))
    assert angle == pytest.approx(math.radians(20), abs=1e-5)
    torch.testing.assert_close(torch.linalg.det(camera.R), torch.tensor(1.0))


@pytest.mark.parametrize("count", [1, 4, 7])
def test_orbit_keeps_the_axis_where_it_is_in_the_image(count):
    camera = make_camera(5)
    center, up = torch.tensor([0.1, 0.2, 0.3]), torch.tensor([0.1, 0.0, 3.0])
    cameras = orbit_cameras(camera, center, up, count)
    assert len(cameras) == count
    torch.testing.assert_close(cameras[0].R, camera.R)
    torch.testing.assert_close(cameras[0].t, camera.t)
    axis = center.to(F64) + torch.linspace(-1, 1, 5, dtype=F64)[:, None] * up.to(F64) / 3
    for other in cameras:
        torch.testing.assert_close(other.project(axis)[0], camera.project(axis)[0])
    arms = torch.stack([c.center for c in cameras]) - center.to(F64)
    unit = up.to(F64) / up.to(F64).norm()
    torch.testing.assert_close(arms @ unit, (arms[0] @ unit).expand(count))
    flat = arms - (arms @ unit)[:, None] * unit
    if count > 1:
        turn = torch.linalg.cross(flat[0], flat[1]) @ unit / (flat[0].norm() * flat[1].norm())
        assert float(turn) == pytest.approx(math.sin(2 * math.pi / count))


def test_rays_at():
    rays = Rays(torch.ones(2, 3), torch.tensor([[0.0, 0, 1], [1, 0, 0]]))
    found = rays.at(torch.tensor([2.0, -1.0]))
    assert found.tolist() == [[1, 1, 3], [0, 1, 1]]


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"K": torch.eye(4)}, "K: expected shape"),
        ({"K": 2 * torch.eye(3)}, "K: expected"),
        ({"K": torch.tensor([[-9.0, 0, 1], [0, 9, 1], [0, 0, 1]])}, "positive fx"),
        ({"K": torch.eye(3).long()}, "K: expected finite floats"),
        ({"K": torch.full((3, 3), math.nan)}, "K: expected finite floats"),
        ({"R": torch.eye(3) * 1.01}, "R: expected a rotation"),
        ({"R": torch.diag(torch.tensor([1.0, 1, -1]))}, "R: expected a rotation"),
        ({"R": torch.eye(3, dtype=F64)}, "R: expected torch.float32"),
        ({"t": torch.zeros(3, 1)}, "t: expected shape"),
        ({"t": torch.tensor([0.0, math.inf, 0])}, "t: expected finite"),
        ({"size": (0, 4)}, "size: expected positive"),
        ({"size": (4, -1)}, "size: expected positive"),
        ({"distortion": torch.zeros(3)}, "distortion: expected"),
        ({"distortion": torch.zeros(13)}, "distortion: expected"),
        ({"lens": "pinhole"}, "lens: expected brown or fisheye"),
        ({"lens": "fisheye", "distortion": torch.zeros(5)}, "distortion: expected"),
        ({"distortion": torch.zeros(5, 1)}, "distortion: expected shape"),
    ],
)
def test_bad_cameras_are_refused_in_one_line(change, word):
    good = {"K": torch.eye(3), "R": torch.eye(3), "t": torch.zeros(3), "size": (4, 4)}
    Camera(**good)
    with pytest.raises(InputError, match=word) as caught:
        Camera(**{**good, **change})
    assert "\n" not in str(caught.value)


def test_bad_requests_are_refused():
    camera, one = make_camera(), torch.ones(3)
    zero = torch.zeros(3)
    for call in (
        lambda: camera.resized(0.0),
        lambda: camera.resized(1e-9),
        lambda: camera.resized(math.nan),
        lambda: camera.cropped((4, 4, 4, 9)),
        lambda: Camera.look_at(zero, one, one, (4, 4), fov=1.0),
        lambda: Camera.look_at(one, one, one, (4, 4), fov=1.0),
        lambda: Camera.look_at(zero, one, torch.eye(3)[0], (4, 4)),
        lambda: Camera.look_at(zero, one, torch.eye(3)[0], (4, 4), fov=60.0),
        lambda: orbit_cameras(camera, zero, zero, 4),
        lambda: orbit_cameras(camera, zero, one, 0),
        lambda: Camera.from_legacy_pixels(torch.eye(4), torch.eye(3), zero, (4, 4)),
    ):
        with pytest.raises(InputError):
            call()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_cuda_agrees_with_the_cpu():
    camera = make_camera(12)
    there = camera.to(camera.K.to("cuda"))
    pixels, _ = there.project(points_near().to("cuda"))
    torch.testing.assert_close(pixels.cpu(), camera.project(points_near())[0])
    found = there.rays(pixels).directions.cpu()
    torch.testing.assert_close(found, camera.rays(pixels.cpu()).directions)
