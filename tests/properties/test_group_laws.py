"""Rotations and affine maps are groups, and their coordinates lead there and back."""

import math

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from motions import Motion, close, motions, normal, rotations, seeds
from torch import Tensor

from monopart.geometry.rigid import invert_affine, rigid, transform_points
from monopart.geometry.rotations import (
    axis_angle_to_rotmat,
    quat_wxyz_to_rotmat,
    rotation_angle,
    rotmat_to_axis_angle,
    rotmat_to_quat_wxyz,
)

EXACT = 2e-15  # a few roundings of float64 at numbers of size one
HALF_TURN = 3e-8  # next to a half turn the axis is the root of a rounding


def product(p: Tensor, q: Tensor) -> Tensor:
    """Hamilton's product, w first."""
    w = p[0] * q[0] - p[1:] @ q[1:]
    return torch.cat([w[None], p[0] * q[1:] + q[0] * p[1:] + torch.linalg.cross(p[1:], q[1:])])


@given(rotations())
def test_a_rotation_is_orthogonal_and_proper(v: Tensor) -> None:
    rotmat = axis_angle_to_rotmat(v)
    close(rotmat.mT @ rotmat, torch.eye(3, dtype=v.dtype), EXACT)
    assert abs(float(torch.linalg.det(rotmat)) - 1) <= EXACT


@given(rotations())
def test_the_opposite_vector_is_the_inverse(v: Tensor) -> None:
    close(axis_angle_to_rotmat(-v), axis_angle_to_rotmat(v).mT, EXACT)


@given(rotations(), st.floats(-3, 3), st.floats(-3, 3))
def test_turns_about_one_axis_add_up(v: Tensor, a: float, b: float) -> None:
    both = axis_angle_to_rotmat(a * v) @ axis_angle_to_rotmat(b * v)
    close(axis_angle_to_rotmat((a + b) * v), both, 1e-14)


@given(rotations(), rotations())
def test_a_turned_axis_is_the_conjugate(v: Tensor, w: Tensor) -> None:
    turn = axis_angle_to_rotmat(w)
    close(axis_angle_to_rotmat(turn @ v), turn @ axis_angle_to_rotmat(v) @ turn.mT, 5e-15)


@given(rotations(math.pi - 1e-3))
def test_axis_angle_to_matrix_and_back(v: Tensor) -> None:
    close(rotmat_to_axis_angle(axis_angle_to_rotmat(v)), v, 1e-12)


@given(rotations(20.0))
def test_matrix_to_axis_angle_and_back(v: Tensor) -> None:
    rotmat = axis_angle_to_rotmat(v)
    back = rotmat_to_axis_angle(rotmat)
    assert float(back.norm()) <= math.pi + 1e-12
    close(axis_angle_to_rotmat(back), rotmat, HALF_TURN)


@given(rotations(20.0))
def test_matrix_to_quaternion_and_back(v: Tensor) -> None:
    rotmat = axis_angle_to_rotmat(v)
    quat = rotmat_to_quat_wxyz(rotmat)
    assert abs(float(quat.norm()) - 1) <= EXACT and float(quat[0]) >= 0
    close(quat_wxyz_to_rotmat(quat), rotmat, EXACT)
    close(quat_wxyz_to_rotmat(-3 * quat), rotmat, EXACT)
    close(quat_wxyz_to_rotmat(quat * torch.tensor([1, -1, -1, -1])), rotmat.mT, EXACT)


@given(rotations(20.0), rotations(20.0))
def test_products_of_quaternions_are_products_of_matrices(v: Tensor, w: Tensor) -> None:
    a, b = axis_angle_to_rotmat(v), axis_angle_to_rotmat(w)
    both = product(rotmat_to_quat_wxyz(a), rotmat_to_quat_wxyz(b))
    close(quat_wxyz_to_rotmat(both), a @ b, 5e-15)
    close(quat_wxyz_to_rotmat(rotmat_to_quat_wxyz(a @ b)), a @ b, 5e-15)


@given(rotations(), rotations(), rotations())
def test_the_angle_is_a_distance_that_turning_keeps(u: Tensor, v: Tensor, w: Tensor) -> None:
    a, b, c = (axis_angle_to_rotmat(x) for x in (u, v, w))
    apart = rotation_angle(a, b)
    close(rotation_angle(b, a), apart, 1e-13)
    close(rotation_angle(c @ a, c @ b), apart, HALF_TURN)
    close(rotation_angle(a @ c, b @ c), apart, HALF_TURN)
    assert float(apart) <= float(rotation_angle(a, c) + rotation_angle(c, b)) + HALF_TURN
    close(rotation_angle(a, a @ b), v.norm(), HALF_TURN)


@settings(max_examples=30)
@given(motions(), motions(), motions(), seeds)
def test_rigid_motions_are_a_group(a: Motion, b: Motion, c: Motion, seed: int) -> None:
    points = normal(seed, 5, 3)
    ma, mb, mc = (m.matrix(points) for m in (a, b, c))
    each = (ma @ mb).expand(len(points), 4, 4)
    close(transform_points(each, points), a(b(points)), 5e-14)
    close((ma @ mb) @ mc, ma @ (mb @ mc), 5e-14)
    inverse, valid = invert_affine(ma @ mb)
    assert bool(valid)
    close(inverse, invert_affine(mb)[0] @ invert_affine(ma)[0], 5e-14)
    close(transform_points(inverse.expand_as(each), a(b(points))), points, 5e-14)


@settings(max_examples=30)
@given(seeds, st.floats(0.3, 3.0), motions())
def test_affine_maps_that_are_not_rigid_are_inverted_too(
    seed: int, scale: float, motion: Motion
) -> None:
    linear = scale * (motion.rotmat + 0.1 * normal(seed, 3, 3))
    transform = rigid(linear, motion.shift)
    inverse, valid = invert_affine(transform)
    if not bool(valid):  # refused, and so the identity
        assert abs(float(torch.linalg.det(linear))) <= 1e-2
        close(inverse, torch.eye(4, dtype=linear.dtype), 0)
        return
    bound = 1e-14 * float(torch.linalg.cond(linear)) ** 2
    close(inverse @ transform, torch.eye(4, dtype=linear.dtype), bound)
    close(transform @ inverse, torch.eye(4, dtype=linear.dtype), bound)
