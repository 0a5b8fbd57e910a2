"""Rotations: values against float64 loops, gradients at the singular angles, group laws."""

import math

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from monopart.geometry.rotations import (
    axis_angle_to_rotmat,
    quat_wxyz_to_rotmat,
    rotation_angle,
    rotmat_to_axis_angle,
    rotmat_to_quat_wxyz,
)

SPECIAL_ANGLES = [0.0, 1e-9, 1e-4, 0.49, 0.51, 1.0, math.pi - 1e-6, math.pi, 4.0]
BATCHES = [(), (2,), (2, 3), (0,), (2, 0)]

vectors = st.lists(st.floats(-2.5, 2.5, width=32), min_size=3, max_size=3).map(
    lambda v: torch.tensor(v, dtype=torch.float64)
)


def about(angle: float, axis: tuple[float, ...] = (0.36, -0.48, 0.8)) -> Tensor:
    return angle * torch.tensor(axis, dtype=torch.float64)


@pytest.mark.parametrize("batch", BATCHES)
def test_shapes_for_any_batch(batch: tuple[int, ...]) -> None:
    rotmat = axis_angle_to_rotmat(torch.randn(*batch, 3))
    assert rotmat.shape == (*batch, 3, 3)
    assert rotmat_to_axis_angle(rotmat).shape == (*batch, 3)
    quat = rotmat_to_quat_wxyz(rotmat)
    assert quat.shape == (*batch, 4)
    assert quat_wxyz_to_rotmat(quat).shape == (*batch, 3, 3)
    assert rotation_angle(rotmat, rotmat).shape == batch


@pytest.mark.parametrize("angle", SPECIAL_ANGLES)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 3e-16), (torch.float32, 2e-7)])
def test_rotmat_is_that_of_plain_rodrigues(
    angle: float, dtype: torch.dtype, tolerance: float
) -> None:
    vector = about(angle).to(dtype)
    expected = torch.from_numpy(oracles.rodrigues(vector.double().numpy()))
    difference = (axis_angle_to_rotmat(vector).double() - expected).abs().max()
    assert difference <= 2 * tolerance


def test_batch_elements_are_independent() -> None:
    vectors = torch.randn(4, 5, 3, dtype=torch.float64)
    each = torch.stack([axis_angle_to_rotmat(v) for v in vectors.reshape(-1, 3)])
    torch.testing.assert_close(axis_angle_to_rotmat(vectors).reshape(-1, 3, 3), each)


def test_quarter_turn_about_z_takes_x_to_y() -> None:
    turned = axis_angle_to_rotmat(torch.tensor([0.0, 0.0, math.pi / 2]))[:, 0]
    torch.testing.assert_close(turned, torch.tensor([0.0, 1.0, 0.0]), atol=1e-6, rtol=0)


@pytest.mark.parametrize("angle", [a for a in SPECIAL_ANGLES if a <= math.pi])
def test_axis_angle_round_trip(angle: float) -> None:
    vector = about(angle)
    back = rotmat_to_axis_angle(axis_angle_to_rotmat(vector))
    if angle == math.pi:  # either axis is right
        back = back * torch.sign((back * vector).sum())
    torch.testing.assert_close(back, vector, atol=1e-15, rtol=1e-12)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0.8, 0), (-0.6, 0, 0.8)])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.5, math.pi - 1e-6, math.pi])
def test_quaternion_of_every_branch(axis: tuple[float, ...], angle: float) -> None:
    rotmat = axis_angle_to_rotmat(about(angle, axis))
    quat = rotmat_to_quat_wxyz(rotmat)
    expected = torch.tensor([math.cos(angle / 2), *(math.sin(angle / 2) * a for a in axis)])
    sign = torch.sign((quat * expected).sum())
    torch.testing.assert_close(sign * quat, expected.double(), atol=1e-7, rtol=0)
    assert quat[0] >= 0
    torch.testing.assert_close(quat_wxyz_to_rotmat(quat), rotmat, atol=1e-14, rtol=0)


def test_quaternions_need_no_unit_length() -> None:
    quat = torch.randn(20, 4, dtype=torch.float64)
    rotmat = quat_wxyz_to_rotmat(quat)
    torch.testing.assert_close(quat_wxyz_to_rotmat(-3 * quat), rotmat)
    identity = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(rotmat @ rotmat.mT, identity.expand(20, 3, 3))
    torch.testing.assert_close(quat_wxyz_to_rotmat(torch.zeros(4).double()), identity)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.5, 2.0, math.pi - 1e-6, math.pi, 5.0])
@pytest.mark.parametrize("batch", [(), (2,), (2, 3), (0,)])
def test_gradients_of_axis_angle_to_rotmat(angle: float, batch: tuple[int, ...]) -> None:
    vector = about(angle).expand(*batch, 3).clone().requires_grad_()
    assert torch.autograd.gradcheck(axis_angle_to_rotmat, (vector,))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.0])
def test_second_derivatives_of_axis_angle_to_rotmat(angle: float) -> None:
    assert torch.autograd.gradgradcheck(axis_angle_to_rotmat, (about(angle).requires_grad_(),))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.07, 1.0, 3.0, math.pi - 1e-6])
@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
def test_gradients_of_the_logarithm(angle: float, batch: tuple[int, ...]) -> None:
    def there_and_back(v: Tensor) -> Tensor:
        return rotmat_to_axis_angle(axis_angle_to_rotmat(v))

    vector = about(angle).expand(*batch, 3).clone().requires_grad_()
    assert torch.autograd.gradcheck(there_and_back, (vector,), eps=1e-7, atol=1e-5)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, 3.0])
def test_gradients_of_quaternions(angle: float) -> None:
    rotmat = axis_angle_to_rotmat(about(angle))
    assert torch.autograd.gradcheck(rotmat_to_quat_wxyz, (rotmat.requires_grad_(),))
    quat = rotmat_to_quat_wxyz(rotmat).detach().requires_grad_()
    assert torch.autograd.gradcheck(quat_wxyz_to_rotmat, (quat,))


@pytest.mark.parametrize("angle", [a for a in SPECIAL_ANGLES if a <= math.pi])
def test_rotation_angle_value(angle: float) -> None:
    base = axis_angle_to_rotmat(about(1.1, (0.0, 0.6, 0.8)))
    other = base @ axis_angle_to_rotmat(about(angle))
    found = rotation_angle(base, other).item()
    assert found == pytest.approx(angle, abs=5e-16, rel=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("angle", [0.0, 1e-9, math.pi - 1e-6, math.pi])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 0, -1), (0.36, -0.48, 0.8)])
def test_rotation_angle_gradient_is_finite_at_both_ends(
    angle: float, axis: tuple[float, ...], dtype: torch.dtype
) -> None:
    vector = about(angle, axis).to(dtype).requires_grad_()
    identity = torch.eye(3, dtype=dtype)
    rotation_angle(axis_angle_to_rotmat(vector), identity).backward()
    assert vector.grad is not None and vector.grad.isfinite().all()
    assert vector.grad.norm() <= 1 + 1e-4


@pytest.mark.parametrize("angle", [1e-9, 1e-3, 1.0, math.pi - 1e-6])
def test_rotation_angle_gradient_is_the_axis(angle: float) -> None:
    axis = about(1.0)
    vector = about(angle).requires_grad_()
    identity = torch.eye(3, dtype=torch.float64)
    (gradient,) = torch.autograd.grad(
        rotation_angle(identity, axis_angle_to_rotmat(vector)), vector
    )
    torch.testing.assert_close(gradient, axis, atol=1e-6, rtol=0)


def test_rotation_angle_gradcheck() -> None:
    a = axis_angle_to_rotmat(torch.randn(2, 3, 3, dtype=torch.float64)).requires_grad_()
    b = axis_angle_to_rotmat(torch.randn(2, 3, 3, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(rotation_angle, (a, b))


@given(vectors)
def test_result_is_a_rotation(vector: Tensor) -> None:
    rotmat = axis_angle_to_rotmat(vector)
    identity = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(rotmat @ rotmat.mT, identity, atol=1e-14, rtol=0)
    torch.testing.assert_close(torch.linalg.det(rotmat).item(), 1.0)
    torch.testing.assert_close(rotmat @ vector, vector, atol=1e-13, rtol=0)


@given(vectors)
def test_negated_vector_is_the_inverse(vector: Tensor) -> None:
    product = axis_angle_to_rotmat(vector) @ axis_angle_to_rotmat(-vector)
    torch.testing.assert_close(product, torch.eye(3).double(), atol=1e-14, rtol=0)


@given(vectors, st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_turns_about_one_axis_add_up(vector: Tensor, s: float, t: float) -> None:
    product = axis_angle_to_rotmat(s * vector) @ axis_angle_to_rotmat(t * vector)
    torch.testing.assert_close(product, axis_angle_to_rotmat((s + t) * vector), atol=1e-13, rtol=0)


@given(vectors)
def test_round_trips_give_the_same_rotation(vector: Tensor) -> None:
    rotmat = axis_angle_to_rotmat(vector)
    by_vector = axis_angle_to_rotmat(rotmat_to_axis_angle(rotmat))
    by_quat = quat_wxyz_to_rotmat(rotmat_to_quat_wxyz(rotmat))
    torch.testing.assert_close(by_vector, rotmat, atol=1e-12, rtol=0)
    torch.testing.assert_close(by_quat, rotmat, atol=1e-13, rtol=0)
    assert rotmat_to_axis_angle(rotmat).norm() <= math.pi + 1e-12


@given(vectors, vectors, vectors)
def test_rotation_angle_is_a_bi_invariant_metric(a: Tensor, b: Tensor, c: Tensor) -> None:
    ra, rb, rc = (axis_angle_to_rotmat(v) for v in (a, b, c))
    ab = rotation_angle(ra, rb)
    torch.testing.assert_close(rotation_angle(rb, ra), ab, atol=1e-12, rtol=0)
    torch.testing.assert_close(rotation_angle(rc @ ra, rc @ rb), ab, atol=1e-7, rtol=0)
    torch.testing.assert_close(rotation_angle(ra @ rc, rb @ rc), ab, atol=1e-7, rtol=0)
    assert ab <= rotation_angle(ra, rc) + rotation_angle(rc, rb) + 1e-7
    distance = rotmat_to_axis_angle(ra.mT @ rb).norm()
    torch.testing.assert_close(distance, ab, atol=1e-7, rtol=0)


def test_oracle_itself_against_the_exponential_series() -> None:
    v = np.array([0.3, -1.2, 0.7])
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    total, term = np.eye(3), np.eye(3)
    for n in range(1, 30):
        term = term @ cross / n
        total += term
    assert np.abs(oracles.rodrigues(v) - total).max() < 1e-14


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("length", [1e-35, 1e-20, 1e-13, 1.0, 1e20, 1e35])
def test_quaternions_of_any_length(length: float, dtype: torch.dtype) -> None:
    unit = torch.tensor([0.5, -0.1, 0.7, 0.3], dtype=dtype)
    unit = unit / unit.norm()
    quat = (unit * length).requires_grad_()
    rotmat = quat_wxyz_to_rotmat(quat)
    eps = torch.finfo(dtype).eps
    torch.testing.assert_close(rotmat, quat_wxyz_to_rotmat(unit), atol=8 * eps, rtol=0)
    torch.testing.assert_close(rotmat @ rotmat.mT, torch.eye(3, dtype=dtype), atol=8 * eps, rtol=0)
    weights = torch.rand(3, 3, dtype=dtype)
    (slope,) = torch.autograd.grad((rotmat * weights).sum(), quat)
    one = unit.clone().requires_grad_()
    (expected,) = torch.autograd.grad((quat_wxyz_to_rotmat(one) * weights).sum(), one)
    torch.testing.assert_close(slope * length, expected, atol=64 * eps, rtol=1e-3)
    assert abs(float((slope * length) @ unit)) < 64 * eps, "a change of length turns nothing"


def test_quaternions_without_an_answer() -> None:
    zero = torch.zeros(4, requires_grad=True)
    rotmat = quat_wxyz_to_rotmat(zero)
    assert torch.equal(rotmat, torch.eye(3))
    (slope,) = torch.autograd.grad(rotmat.sum(), zero)
    assert torch.equal(slope, torch.zeros(4))
    for bad in (torch.inf, torch.nan):
        assert quat_wxyz_to_rotmat(torch.tensor([1.0, bad, 0.0, 0.0])).isnan().any()
