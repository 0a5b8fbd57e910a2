"""Warp kernels of forward kinematics: one item per body, its joints in order, root first.

Transforms and their gradients are rows of four floats, four rows per joint; the linear part is kept
in columns of a 3×3 matrix, the translation in the last column.
"""

from typing import no_type_check

import warp as wp

wp.set_module_options({"enable_backward": False})  # gradients are kernels of their own


@no_type_check
@wp.func
def _linear(rows: wp.array(dtype=wp.vec4), j: int) -> wp.mat33:
    a = rows[4 * j]
    b = rows[4 * j + 1]
    c = rows[4 * j + 2]
    return wp.mat33(a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2])


@no_type_check
@wp.func
def _shift(rows: wp.array(dtype=wp.vec4), j: int) -> wp.vec3:
    return wp.vec3(rows[4 * j][3], rows[4 * j + 1][3], rows[4 * j + 2][3])


@no_type_check
@wp.func
def _store(rows: wp.array(dtype=wp.vec4), j: int, m: wp.mat33, t: wp.vec3, last: float):
    rows[4 * j] = wp.vec4(m[0, 0], m[0, 1], m[0, 2], t[0])
    rows[4 * j + 1] = wp.vec4(m[1, 0], m[1, 1], m[1, 2], t[1])
    rows[4 * j + 2] = wp.vec4(m[2, 0], m[2, 1], m[2, 2], t[2])
    rows[4 * j + 3] = wp.vec4(0.0, 0.0, 0.0, last)


@no_type_check
@wp.func
def _rotation(rotmats: wp.array(dtype=wp.vec3), j: int) -> wp.mat33:
    a = rotmats[3 * j]
    b = rotmats[3 * j + 1]
    c = rotmats[3 * j + 2]
    return wp.mat33(a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2])


@no_type_check
@wp.kernel
def chain(
    start: int,
    rotmats: wp.array(dtype=wp.vec3),
    joints: wp.array(dtype=wp.vec3),
    parents: wp.array(dtype=wp.int32),
    transforms: wp.array(dtype=wp.vec4),
):
    """Transforms of one body: T_j = T_parent · (x → R_j (x − j_j) + j_j)."""
    num_joints = parents.shape[0]
    first = (start + wp.tid()) * num_joints
    for k in range(num_joints):
        j = first + k
        turn = _rotation(rotmats, j)
        # x → R_j (x − j_j) + j_j fixes the joint: offsets stay small, so float32 loses little
        offset = joints[j] - turn * joints[j]
        if k > 0:
            above = first + parents[k]
            up = _linear(transforms, above)
            offset = up * offset + _shift(transforms, above)
            turn = up * turn
        _store(transforms, j, turn, offset, 1.0)


@no_type_check
@wp.kernel
def chain_gradient(
    start: int,
    rotmats: wp.array(dtype=wp.vec3),
    joints: wp.array(dtype=wp.vec3),
    parents: wp.array(dtype=wp.int32),
    transforms: wp.array(dtype=wp.vec4),
    cotangent: wp.array(dtype=wp.vec4),
    grad_rotmats: wp.array(dtype=wp.vec3),
    grad_joints: wp.array(dtype=wp.vec3),
):
    """Gradients of one body, children before parents; ``cotangent`` is added to on the way."""
    num_joints = parents.shape[0]
    first = (start + wp.tid()) * num_joints
    for back in range(num_joints):
        k = num_joints - 1 - back
        j = first + k
        turn = _rotation(rotmats, j)
        joint = joints[j]
        grad_turn = _linear(cotangent, j)
        grad_offset = _shift(cotangent, j)
        if k > 0:
            above = first + parents[k]
            up = _linear(transforms, above)
            offset = joint - turn * joint
            grad_up = grad_turn * wp.transpose(turn) + wp.outer(grad_offset, offset)
            _store(
                cotangent,
                above,
                _linear(cotangent, above) + grad_up,
                _shift(cotangent, above) + grad_offset,
                0.0,
            )
            grad_turn = wp.transpose(up) * grad_turn
            grad_offset = wp.transpose(up) * grad_offset
        grad_turn -= wp.outer(grad_offset, joint)
        grad_joints[j] = grad_offset - wp.transpose(turn) * grad_offset
        for r in range(3):
            grad_rotmats[3 * j + r] = wp.vec3(grad_turn[r, 0], grad_turn[r, 1], grad_turn[r, 2])
