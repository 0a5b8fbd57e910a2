"""Warp kernels of the diffused weights: one sweep of diffusion, and Newton steps in the grid."""

# ruff: noqa: PLR0912, PLR0915, C901 - one kernel holds the loop: a call per step would copy its state

from typing import no_type_check

import warp as wp

from .newton import bone_guess, solve_rows
from .shell import voxel_of

wp.set_module_options({"enable_backward": False})  # gradients: the implicit function theorem


@no_type_check
@wp.kernel
def relax(
    start: int,
    rows: wp.array(dtype=wp.int32),
    neighbours: wp.array2d(dtype=wp.int32),
    weights: wp.array2d(dtype=wp.float32),
):
    """Replace the weights of some nodes, no two of them neighbours, by the mean around them."""
    i = rows[start + wp.tid()]
    count = float(0.0)
    for k in range(6):
        if neighbours[i, k] >= 0:
            count += 1.0
    if count > 0.0:
        scale = 1.0 / count
        for j in range(weights.shape[1]):
            total = float(0.0)
            for k in range(6):
                n = neighbours[i, k]
                if n >= 0:
                    total += weights[n, j]
            weights[i, j] = total * scale


@no_type_check
@wp.func
def corner_weight(q: wp.vec3, c: int):
    """Trilinear weight of corner ``c`` (bit 0: x, 1: y, 2: z) at ``q`` in the unit cell."""
    x = wp.where((c & 1) != 0, q[0], 1.0 - q[0])
    y = wp.where((c & 2) != 0, q[1], 1.0 - q[1])
    z = wp.where((c & 4) != 0, q[2], 1.0 - q[2])
    return x * y * z


@no_type_check
@wp.func
def corner_gradient(q: wp.vec3, c: int):
    """Gradient of `corner_weight` in ``q``."""
    x = wp.where((c & 1) != 0, q[0], 1.0 - q[0])
    y = wp.where((c & 2) != 0, q[1], 1.0 - q[1])
    z = wp.where((c & 4) != 0, q[2], 1.0 - q[2])
    sx = wp.where((c & 1) != 0, 1.0, -1.0)
    sy = wp.where((c & 2) != 0, 1.0, -1.0)
    sz = wp.where((c & 4) != 0, 1.0, -1.0)
    return wp.vec3(sx * y * z, x * sy * z, x * y * sz)


@no_type_check
@wp.func
def in_cell(p: wp.vec3, lo: wp.vec3, inverse_voxel: float):
    """Position of a point in its cell, in [0, 1]."""
    q = (p - lo) * inverse_voxel
    return wp.vec3(q[0] - wp.floor(q[0]), q[1] - wp.floor(q[1]), q[2] - wp.floor(q[2]))


@no_type_check
@wp.kernel
def solve_cells(
    start: int,
    order: wp.array(dtype=wp.int64),
    points: wp.array(dtype=wp.vec3),
    guess: wp.array(dtype=wp.vec3),
    lo: wp.vec3,
    dims: wp.vec3i,
    voxel: float,
    slots: wp.array(dtype=wp.int32),
    cells: wp.array2d(dtype=wp.int32),
    distance: wp.array(dtype=wp.float32),
    maps: wp.array2d(dtype=wp.vec4),
    weights: wp.array2d(dtype=wp.float32),
    joints: wp.array(dtype=wp.vec3),
    bones: wp.array2d(dtype=wp.vec4),
    starts: int,
    iterations: int,
    gradients: int,
    limits: wp.vec4,
    rest: wp.array(dtype=wp.vec3),
    blend: wp.array2d(dtype=wp.float32),
    cell: wp.array(dtype=wp.int32),
    residual: wp.array(dtype=wp.float32),
    invertible: wp.array(dtype=wp.bool),
):
    """Solve x = A(w(p)) p with weights from a grid; starts and ``limits`` as in `newton.solve`."""
    i = int(order[start + wp.tid()])
    x = points[i]
    p = guess[i]
    inverse_voxel = 1.0 / voxel
    best_p = p
    best_cell = int(-1)
    best = float(1.0e30)
    best_ok = bool(False)
    last = float(1.0e30)
    k = int(0)
    attempt = int(0)
    while attempt < starts:
        over = k >= iterations
        k += 1
        f = int(-1)
        at = voxel_of(p, lo, dims, inverse_voxel)
        if at >= 0:
            f = slots[at]
        q = in_cell(p, lo, inverse_voxel)
        if f >= 0:
            gap = float(0.0)
            for c in range(8):
                gap += corner_weight(q, c) * distance[cells[f, c]]
            if gap > limits[3]:
                f = -1
        if f < 0:
            over = True
        if f >= 0:
            h = wp.vec4(p[0], p[1], p[2], 1.0)
            m0 = wp.vec4(0.0, 0.0, 0.0, 0.0)
            m1 = wp.vec4(0.0, 0.0, 0.0, 0.0)
            m2 = wp.vec4(0.0, 0.0, 0.0, 0.0)
            g0 = wp.vec3(0.0, 0.0, 0.0)
            g1 = wp.vec3(0.0, 0.0, 0.0)
            g2 = wp.vec3(0.0, 0.0, 0.0)
            for c in range(8):
                v = cells[f, c]
                a0 = maps[v, 0]
                a1 = maps[v, 1]
                a2 = maps[v, 2]
                w = corner_weight(q, c)
                g = corner_gradient(q, c) * inverse_voxel
                m0 += a0 * w
                m1 += a1 * w
                m2 += a2 * w
                g0 += g * wp.dot(a0, h)
                g1 += g * wp.dot(a1, h)
                g2 += g * wp.dot(a2, h)
            e = x - wp.vec3(wp.dot(m0, h), wp.dot(m1, h), wp.dot(m2, h))
            r = wp.length(e)
            r0 = wp.vec3(m0[0], m0[1], m0[2])
            r1 = wp.vec3(m1[0], m1[1], m1[2])
            r2 = wp.vec3(m2[0], m2[1], m2[2])
            step, det = solve_rows(r0, r1, r2, e)
            ok = wp.abs(det) > limits[2]
            better = r < last
            last = r
            if r < best:
                best = r
                best_p = p
                best_cell = f
                best_ok = ok
            over = over or r <= limits[0]
            if gradients != 0 and better and not over:
                full, full_det = solve_rows(r0 + g0, r1 + g1, r2 + g2, e)
                if wp.abs(full_det) > limits[2]:
                    step = full
                    ok = True
            size = wp.length(step)
            over = over or not ok
            if size > 0.2:
                step = step * (0.2 / size)
            p = p + step
        if over:
            attempt += 1
            if best <= limits[1]:
                attempt = starts
            if attempt < starts:
                p = bone_guess(x, attempt - 1, joints, bones)
                k = 0
                last = 1.0e30
    rest[i] = best_p
    cell[i] = best_cell
    residual[i] = best
    invertible[i] = best_ok
    for j in range(blend.shape[1]):
        blend[i, j] = 0.0
    if best_cell >= 0:
        q = in_cell(best_p, lo, inverse_voxel)
        for c in range(8):
            v = cells[best_cell, c]
            w = corner_weight(q, c)
            for j in range(blend.shape[1]):
                blend[i, j] = blend[i, j] + w * weights[v, j]
