"""Affine transforms: inverse with a mask, no NaN in value or gradient."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from monopart.geometry.rigid import (
    append_last_row,
    apply_linear,
    invert_affine,
    invert_linear,
    rigid,
    transform_points,
)
from monopart.geometry.rotations import axis_angle_to_rotmat

BATCHES = [(), (2,), (2, 3), (0,)]


def random_affine(*batch: int) -> torch.Tensor:
    linear = axis_angle_to_rotmat(torch.randn(*batch, 3, dtype=torch.float64))
    linear = linear + 0.15 * torch.rand(*batch, 3, 3, dtype=torch.float64)
    return rigid(linear, torch.randn(*batch, 3, dtype=torch.float64))


@pytest.mark.parametrize("batch", BATCHES)
def test_rigid_maps_points(batch: tuple[int, ...]) -> None:
    rotmat = axis_angle_to_rotmat(torch.randn(*batch, 3))
    shift, points = torch.randn(*batch, 3), torch.randn(*batch, 3)
    transforms = rigid(rotmat, shift)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(*batch, 4)
    assert transforms.shape == (*batch, 4, 4) and torch.equal(transforms[..., 3, :], last)
    expected = (rotmat @ points[..., None])[..., 0] + shift
    torch.testing.assert_close(transform_points(transforms, points), expected)
    torch.testing.assert_close(apply_linear(rotmat, points), expected - shift, atol=1e-6, rtol=0)
    assert torch.equal(append_last_row(transforms[..., :3, :]), transforms)


@pytest.mark.parametrize("batch", BATCHES)
def test_inverse_is_that_of_linalg(batch: tuple[int, ...]) -> None:
    transforms = random_affine(*batch)
    inverse, valid = invert_affine(transforms)
    assert valid.shape == batch and valid.all()
    torch.testing.assert_close(inverse, torch.linalg.inv(transforms))
    linear, valid = invert_linear(transforms[..., :3, :3])
    assert valid.all()
    torch.testing.assert_close(linear, torch.linalg.inv(transforms[..., :3, :3]))


def test_far_translation_does_not_spoil_the_inverse() -> None:
    transforms = random_affine(50).float()
    transforms[:, :3, 3] *= 1e3
    inverse, _ = invert_affine(transforms)
    exact = torch.linalg.inv(transforms[:, :3, :3].double())
    torch.testing.assert_close(inverse[:, :3, :3].double(), exact, atol=3e-6, rtol=0)


@pytest.mark.parametrize("bad", ["zero", "rank_two", "flat", "nan", "inf", "nan_shift"])
def test_singular_elements_are_masked_with_finite_values_and_gradients(bad: str) -> None:
    transforms = random_affine(3)
    if bad == "zero":
        transforms[1, :3, :3] = 0
    elif bad == "rank_two":
        transforms[1, 2, :3] = transforms[1, 0, :3]
    elif bad == "flat":
        transforms[1, :3, :3] = torch.diag(torch.tensor([1.0, 1.0, 0.009]))
    elif bad == "nan_shift":
        transforms[1, 0, 3] = float("nan")
    else:
        transforms[1, 0, 0] = float(bad)
    transforms.requires_grad_()
    inverse, valid = invert_affine(transforms)
    assert valid.tolist() == [True, False, True]
    assert torch.equal(inverse[1], torch.eye(4, dtype=torch.float64))
    inverse.square().sum().backward()
    assert transforms.grad is not None and transforms.grad.isfinite().all()
    assert (transforms.grad[1] == 0).all() and (transforms.grad[0] != 0).any()


def test_min_det_is_the_threshold() -> None:
    transform = rigid(torch.diag(torch.tensor([1.0, 1.0, 0.05])), torch.zeros(3))
    assert invert_affine(transform)[1]
    assert not invert_affine(transform, min_det=0.06)[1]


def test_gradients() -> None:
    transforms = random_affine(2, 2).requires_grad_()
    assert torch.autograd.gradcheck(lambda t: invert_affine(t)[0], (transforms,))
    points = torch.randn(2, 2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(transform_points, (transforms, points))


@given(st.integers(0, 10_000))
def test_inverse_undoes_and_inverts_back(seed: int) -> None:
    torch.manual_seed(seed)
    transforms, points = random_affine(4), torch.randn(4, 3, dtype=torch.float64)
    inverse, valid = invert_affine(transforms)
    back = transform_points(inverse, transform_points(transforms, points))
    torch.testing.assert_close(back[valid], points[valid], atol=1e-11, rtol=0)
    torch.testing.assert_close(invert_affine(inverse, 0.0)[0][valid], transforms[valid])
