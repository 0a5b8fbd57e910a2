"""Skinning against float64 loops, its inverse, and its gradients."""

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from monopart.geometry.rigid import rigid
from monopart.geometry.rotations import axis_angle_to_rotmat
from monopart.geometry.skinning import blend_transforms, skin, unskin


def random_weights(num_points: int, num_joints: int) -> torch.Tensor:
    weights = torch.rand(num_points, num_joints, dtype=torch.float64)
    return weights / weights.sum(-1, keepdim=True)


def random_transforms(*batch: int, spread: float = 1.0) -> torch.Tensor:
    axis_angle = spread * torch.randn(*batch, 3, dtype=torch.float64)
    return rigid(axis_angle_to_rotmat(axis_angle), torch.randn(*batch, 3, dtype=torch.float64))


@pytest.mark.parametrize("batch", [(), (2,), (2, 3), (0,)])
def test_against_the_loop(batch: tuple[int, ...]) -> None:
    weights, transforms = random_weights(6, 4), random_transforms(*batch, 4)
    points = torch.randn(*batch, 6, 3, dtype=torch.float64)
    blended = blend_transforms(transforms, weights)
    assert blended.shape == (*batch, 6, 4, 4)
    posed = skin(points, blended)
    cases = (posed.reshape(-1, 6, 3), points.reshape(-1, 6, 3), transforms.reshape(-1, 4, 4, 4))
    for found, p, t in zip(*cases, strict=True):
        expected = oracles.linear_blend_skinning(p.numpy(), weights.numpy(), t.numpy())
        np.testing.assert_allclose(found.numpy(), expected, atol=1e-13)


def test_blend_is_the_weighted_sum() -> None:
    weights, transforms = random_weights(6, 4), random_transforms(4)
    expected = torch.einsum("nj,jrc->nrc", weights, transforms)
    torch.testing.assert_close(blend_transforms(transforms, weights), expected)


def test_no_points() -> None:
    blended = blend_transforms(random_transforms(2, 4), torch.zeros(0, 4, dtype=torch.float64))
    points, valid = unskin(torch.zeros(2, 0, 3, dtype=torch.float64), blended)
    assert points.shape == (2, 0, 3) and valid.shape == (2, 0)


@given(st.integers(0, 10_000))
def test_unskin_undoes_skin(seed: int) -> None:
    torch.manual_seed(seed)
    blended = blend_transforms(random_transforms(3, 4, spread=0.6), random_weights(6, 4))
    points = torch.randn(3, 6, 3, dtype=torch.float64)
    back, valid = unskin(skin(points, blended), blended)
    torch.testing.assert_close(back[valid], points[valid], atol=1e-11, rtol=0)
    assert torch.equal(valid, torch.linalg.det(blended[..., :3, :3]).abs() > 1e-2)


def test_unskin_keeps_its_digits_far_from_the_origin() -> None:
    transforms = random_transforms(500).float()
    points = torch.randn(500, 3)
    transforms[:, :3, 3] *= 100
    posed = skin(points, transforms)
    back, valid = unskin(posed, transforms)
    exact = (posed.double() - transforms[:, :3, 3].double())[:, None] @ transforms[
        :, :3, :3
    ].double()
    assert valid.all()
    assert (back.double() - exact[:, 0]).abs().max() < 2e-6 + 1e-6  # no term of the size of t · eps


def test_opposite_rotations_blend_to_a_masked_singular_map() -> None:
    half_turn = rigid(torch.diag(torch.tensor([-1.0, -1.0, 1.0])), torch.ones(3))
    transforms = torch.stack((rigid(torch.eye(3), torch.ones(3)), half_turn)).requires_grad_()
    weights = torch.tensor([[0.5, 0.5], [1.0, 0.0]], requires_grad=True)
    points = torch.ones(2, 3, requires_grad=True)
    rest, valid = unskin(points, blend_transforms(transforms, weights))
    assert valid.tolist() == [False, True]
    assert rest.isfinite().all()
    rest.square().sum().backward()
    for tensor in (transforms, weights, points):
        assert tensor.grad is not None and tensor.grad.isfinite().all()


def test_transform_that_is_not_finite_is_masked() -> None:
    blended = random_transforms(2)
    blended[0, 1, 3] = float("nan")
    rest, valid = unskin(torch.ones(2, 3, dtype=torch.float64), blended)
    assert valid.tolist() == [False, True] and rest.isfinite().all()


def test_gradients() -> None:
    transforms = random_transforms(3, spread=0.5).requires_grad_()
    weights = random_weights(3, 3).requires_grad_()
    points = torch.randn(3, 3, dtype=torch.float64, requires_grad=True)

    def forward(t: torch.Tensor, w: torch.Tensor, p: torch.Tensor) -> torch.Tensor:
        return skin(p, blend_transforms(t, w))

    def backward(t: torch.Tensor, w: torch.Tensor, p: torch.Tensor) -> torch.Tensor:
        return unskin(p, blend_transforms(t, w))[0]

    assert torch.autograd.gradcheck(forward, (transforms, weights, points))
    assert torch.autograd.gradcheck(backward, (transforms, weights, points))
