"""Warp kernels of linear blend skinning with sparse weights, forward and backward.

Transforms are read as rows of four floats, four rows per joint. The weights are lists: entries
``starts[v] … starts[v + 1]`` belong to vertex v. For the gradient of the transforms the same pairs
are sorted by joint and cut into short runs, so that every sum has one owner and one order: no
atomics, the same result for any number of threads, and little rounding.
"""

from typing import no_type_check

import warp as wp

wp.set_module_options({"enable_backward": False})  # gradients are kernels of their own


@no_type_check
@wp.func
def blended(
    rows: wp.array(dtype=wp.vec4),
    starts: wp.array(dtype=wp.int32),
    joints: wp.array(dtype=wp.int32),
    weights: wp.array(dtype=wp.float32),
    num_joints: int,
    i: int,
):
    """Upper rows of the blended map of item ``i``, a vertex of a body."""
    num_verts = starts.shape[0] - 1
    body = i // num_verts
    v = i - body * num_verts
    first = body * num_joints
    a = wp.vec4(0.0, 0.0, 0.0, 0.0)
    b = wp.vec4(0.0, 0.0, 0.0, 0.0)
    c = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for e in range(starts[v], starts[v + 1]):
        row = 4 * (first + joints[e])
        w = weights[e]
        a += w * rows[row]
        b += w * rows[row + 1]
        c += w * rows[row + 2]
    return a, b, c


@no_type_check
@wp.kernel
def skin_points(
    start: int,
    points: wp.array(dtype=wp.vec3),
    rows: wp.array(dtype=wp.vec4),
    starts: wp.array(dtype=wp.int32),
    joints: wp.array(dtype=wp.int32),
    weights: wp.array(dtype=wp.float32),
    num_joints: int,
    posed: wp.array(dtype=wp.vec3),
):
    """Posed vertices x = Σ_j w_j (R_j p + t_j); one item per body and vertex."""
    i = start + wp.tid()
    a, b, c = blended(rows, starts, joints, weights, num_joints, i)
    p = points[i]
    q = wp.vec4(p[0], p[1], p[2], 1.0)
    posed[i] = wp.vec3(wp.dot(a, q), wp.dot(b, q), wp.dot(c, q))


@no_type_check
@wp.kernel
def points_gradient(
    start: int,
    cotangent: wp.array(dtype=wp.vec3),
    rows: wp.array(dtype=wp.vec4),
    starts: wp.array(dtype=wp.int32),
    joints: wp.array(dtype=wp.int32),
    weights: wp.array(dtype=wp.float32),
    num_joints: int,
    grad: wp.array(dtype=wp.vec3),
):
    """Gradient of the rest vertices Σ_j w_j R_jᵀ g; one item per body and vertex."""
    i = start + wp.tid()
    a, b, c = blended(rows, starts, joints, weights, num_joints, i)
    g = cotangent[i]
    total = a * g[0] + b * g[1] + c * g[2]
    grad[i] = wp.vec3(total[0], total[1], total[2])


@no_type_check
@wp.kernel
def run_sums(
    start: int,
    cotangent: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
    run_starts: wp.array(dtype=wp.int32),
    verts: wp.array(dtype=wp.int32),
    weights: wp.array(dtype=wp.float32),
    num_verts: int,
    sums: wp.array(dtype=wp.vec4),
):
    """Sum of w g (p, 1)ᵀ over one run of pairs of one joint; one item per body and run."""
    i = start + wp.tid()
    num_runs = run_starts.shape[0] - 1
    body = i // num_runs
    run = i - body * num_runs
    first = body * num_verts
    a = wp.vec4(0.0, 0.0, 0.0, 0.0)
    b = wp.vec4(0.0, 0.0, 0.0, 0.0)
    c = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for e in range(run_starts[run], run_starts[run + 1]):
        v = first + verts[e]
        g = weights[e] * cotangent[v]
        p = points[v]
        q = wp.vec4(p[0], p[1], p[2], 1.0)
        a += g[0] * q
        b += g[1] * q
        c += g[2] * q
    sums[3 * i] = a
    sums[3 * i + 1] = b
    sums[3 * i + 2] = c


@no_type_check
@wp.kernel
def transforms_gradient(
    start: int,
    sums: wp.array(dtype=wp.vec4),
    joint_runs: wp.array(dtype=wp.int32),
    num_runs: int,
    grad: wp.array(dtype=wp.vec4),
):
    """Gradient of the joint transforms: the sum of a joint's runs; one item per body and joint."""
    i = start + wp.tid()
    num_joints = joint_runs.shape[0] - 1
    body = i // num_joints
    joint = i - body * num_joints
    a = wp.vec4(0.0, 0.0, 0.0, 0.0)
    b = wp.vec4(0.0, 0.0, 0.0, 0.0)
    c = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for run in range(joint_runs[joint], joint_runs[joint + 1]):
        s = 3 * (body * num_runs + run)
        a += sums[s]
        b += sums[s + 1]
        c += sums[s + 2]
    grad[4 * i] = a
    grad[4 * i + 1] = b
    grad[4 * i + 2] = c
    grad[4 * i + 3] = wp.vec4(0.0, 0.0, 0.0, 0.0)
