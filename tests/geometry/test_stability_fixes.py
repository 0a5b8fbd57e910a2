"""What the stress of `monopart-bench stability` found in geometry stays mended."""

import pytest
import torch

from monopart.geometry.body import BodyModel
from monopart.geometry.camera_paths import orbit_cameras, ring_of_cameras
from monopart.geometry.cameras import Camera, Rays
from monopart.geometry.culling import BodyShell
from monopart.geometry.diffused_weights import DiffusedField
from monopart.geometry.errors import InputError
from monopart.geometry.norms import brought_to_one
from monopart.geometry.uv_texture import sample_texture


@pytest.mark.parametrize(("lens", "count"), [("brown", 5), ("brown", 14), ("fisheye", 4)])
def test_lenses_are_finite_for_points_whose_squares_overflow(lens: str, count: int) -> None:
    K = torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    bent = torch.full((count,), 0.01)
    camera = Camera(K, torch.eye(3), torch.zeros(3), (100, 100), bent, lens)
    points = torch.tensor([[1e15, 0.0, 1e-5], [-1e15, 1e15, 2e-5]], requires_grad=True)
    pixels, _ = camera.project(points)
    (gradient,) = torch.autograd.grad(pixels.sum(), points)
    assert pixels.isfinite().all() and gradient.isfinite().all()
    assert bool((pixels[0, 0] > 1e3) & (pixels[1, 0] < -1e3)) or count == 14


@pytest.mark.parametrize("size", [0.0, 1e-13, torch.nan])
def test_a_ray_without_a_direction_meets_nothing(size: float) -> None:
    body = BodyModel.default()
    shell = BodyShell(body.v_template, body.faces, 0.05)
    origins = body.v_template[:4]
    assert bool(shell.occupied(origins).all())
    rays = Rays(origins, torch.full_like(origins, size))
    near, far, hit = shell.intervals(rays)
    assert not hit.any() and not near.any() and not far.any()
    assert len(shell.sample(rays, 0.01).depth) == 0


def test_diffused_weights_of_points_that_are_not_finite_are_zero() -> None:
    field = DiffusedField(BodyModel.default(), voxel=0.05)
    points = torch.tensor([[torch.inf, 0, 0], [torch.nan, 0, 0], [0.0, 0, 0]], requires_grad=True)
    weights = field.weights_at(points)
    (gradient,) = torch.autograd.grad(weights[:, ::2].sum(), points)
    assert not weights[:2].any() and float(weights[2].detach().sum()) == pytest.approx(
        1.0, abs=1e-5
    )
    assert gradient.isfinite().all() and not gradient[:2].any()


@pytest.mark.parametrize("length", [1e-30, 1e-20, 1e25, 3e38])
def test_directions_upwards_may_have_any_length(length: float) -> None:
    up, eye, target = torch.tensor([0.2, 1.0, -0.3]), torch.tensor([0.0, 0, 3]), torch.zeros(3)
    plain, long = (Camera.look_at(eye, target, u, (8, 8), fov=1.0) for u in (up, length * up))
    torch.testing.assert_close(long.R, plain.R, rtol=0, atol=1e-6)
    rings = [ring_of_cameras(target, u, 2.0, 0.3, 3, (8, 8), 1.0) for u in (up, length * up)]
    orbits = [orbit_cameras(plain, target, u, 3) for u in (up, length * up)]
    for one, two in (rings, orbits):
        for a, b in zip(one, two, strict=True):
            torch.testing.assert_close(a.R, b.R, rtol=0, atol=1e-6)
    for made in (orbits[0], rings[0]):
        assert float((made[1].R - made[0].R).norm()) > 1.0  # an axis lost to overflow turns nothing


@pytest.mark.parametrize("up", [0.0, torch.nan, torch.inf])
def test_directions_upwards_that_are_none_are_refused(up: float) -> None:
    eye, wrong = torch.tensor([0.0, 0, 3]), torch.full((3,), up)
    camera = Camera.look_at(eye, torch.zeros(3), torch.tensor([0.0, 1, 0]), (8, 8), fov=1.0)
    with pytest.raises(InputError, match="up"):
        Camera.look_at(eye, torch.zeros(3), wrong, (8, 8), fov=1.0)
    with pytest.raises(InputError, match="up"):
        orbit_cameras(camera, torch.zeros(3), wrong, 3)
    with pytest.raises(InputError, match="up"):
        ring_of_cameras(torch.zeros(3), wrong, 2.0, 0.3, 3, (8, 8), 1.0)


def test_the_first_camera_of_an_orbit_is_the_given_one_anywhere() -> None:
    eye = torch.tensor([0.0, 0, 3])
    camera = Camera.look_at(eye, torch.zeros(3), torch.tensor([0.1, 1, 0]), (8, 8), fov=1.0)
    far = torch.tensor([1e5, 3e4, -2e4])
    assert torch.equal(orbit_cameras(camera, far, torch.tensor([0.3, 1, 0]), 4)[0].t, camera.t)


def test_a_direction_keeps_its_digits_and_its_gradient() -> None:
    vectors = torch.tensor([[3.0, -6, 0.1], [1e-30, 2e-30, 0], [0, 0, 0]], dtype=torch.float64)
    scaled = brought_to_one(vectors)
    factor = scaled[:2, :2] / vectors[:2, :2]
    assert torch.equal(factor[:, 0], factor[:, 1]), "all entries by the same power of two"
    assert torch.equal(factor.log2(), factor.log2().round()) and not scaled[2].any()
    one = vectors[:1].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda v: brought_to_one(v) / brought_to_one(v).norm(), one)


def test_the_forward_field_of_points_that_are_not_finite_has_no_gradient() -> None:
    body = BodyModel.default()
    field = DiffusedField(body, voxel=0.05)
    maps = torch.eye(4).repeat(body.num_joints, 1, 1).requires_grad_()
    points = torch.tensor([[torch.inf, 0, 0], [torch.nan, 0, 0], [0.0, 0, 0]], requires_grad=True)
    cell, found = field.search(points, torch.inf)
    point = field.at(points, cell, field.maps(maps))
    total = torch.where(found[:, None, None], point.jacobian() + point.image[:, None], 0.0).sum()
    for gradient in torch.autograd.grad(total, (points, maps)):
        assert gradient.isfinite().all() and gradient.any()


def test_the_jacobian_of_diffused_weights_keeps_its_digits_far_from_the_origin() -> None:
    body = BodyModel.default()
    far = torch.eye(4, dtype=torch.float64).repeat(body.num_joints, 1, 1)
    turn = torch.linspace(0, 0.5, body.num_joints, dtype=torch.float64)
    far[:, 0, 1], far[:, :3, 3] = turn, 2.0**17  # all maps move by 131 km, which cancels
    field = DiffusedField(body, voxel=0.05)
    points = body.v_template[::40]
    cell, found = field.search(points, torch.inf)
    maps = field.maps(torch.eye(4).repeat(body.num_joints, 1, 1))
    exact = (field.grid.weights.double() @ far[:, :3].flatten(1)).unflatten(1, (3, 4))
    there = field.at(points, cell, exact.to(maps)).jacobian()
    shares, slopes = field.grid.shares(points.double())
    own = exact.to(maps).double()[field.grid.cells[cell]]
    images = (own[..., :3] * points.double()[:, None, None]).sum(-1) + own[..., 3]
    linear = (shares[..., None, None] * own[..., :3]).sum(1)
    wanted = linear + (images[..., None] * slopes[:, :, None]).sum(1)
    assert bool(found.all())
    # the sum of all images would be off by their last place over a voxel: 0.016 / 0.05
    assert float((there.double() - wanted).abs().max()) < 1e-4


@pytest.mark.parametrize("wrong", [torch.nan, torch.inf, -torch.inf])
def test_texture_coordinates_that_are_not_finite_have_no_colour(wrong: float) -> None:
    texture = torch.rand(4, 4, 3, requires_grad=True)
    uv = torch.tensor([[0.4, 0.4], [wrong, 0.5], [0.5, wrong]], requires_grad=True)
    chart, charts = torch.zeros(3, dtype=torch.long), torch.zeros(4, 4, dtype=torch.long)
    found = sample_texture(texture, uv, chart, charts)
    assert found[0].all() and not found[1:].any()
    for gradient in torch.autograd.grad(found.sum(), (texture, uv)):
        assert gradient.isfinite().all()


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_ring_does_not_jump_where_the_axis_is_one_of_the_world(axis, sign):
    """Its start was on the axis of the smallest entry: two of them are equally small there."""
    target, up = torch.zeros(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    up[axis] = sign
    still = ring_of_cameras(target, up, 2.0, 0.3, 3, (8, 8), 1.0)[0].R
    for way in torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64):
        near = ring_of_cameras(target, up + 1e-7 * way, 2.0, 0.3, 3, (8, 8), 1.0)[0].R
        assert float((near - still).abs().max()) < 1e-5
