"""What the stress of `monopart-bench stability` found in geometry stays mended."""

import pytest
import torch

from monopart.geometry.body import BodyModel
from monopart.geometry.cameras import Camera, Rays
from monopart.geometry.culling import BodyShell
from monopart.geometry.diffused_weights import DiffusedField


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
