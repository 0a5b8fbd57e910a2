"""Warp kernels of inverse skinning: first guesses, and the whole solve of a point in one thread."""

# ruff: noqa: PLR0915, C901 - one kernel holds the loop: a call per step would copy its state

from typing import no_type_check

import warp as wp

from .near_faces import bary_on_triangle, closest_face
from .shell import voxel_of

wp.set_module_options({"enable_backward": False})  # gradients: the implicit function theorem

_KEY = wp.constant(wp.int64(1 << 32))
EMPTY = (1 << 63) - 1
_EMPTY = wp.constant(wp.int64(EMPTY))


@no_type_check
@wp.kernel
def splat_verts(
    start: int,
    verts: wp.array(dtype=wp.vec3),
    frame: wp.array(dtype=wp.float32),
    size: int,
    reach: float,
    nearest: wp.array(dtype=wp.int64),
):
    """Nearest vertex of voxel centres within ``reach`` voxels; keys are (distance, vertex)."""
    i = start + wp.tid()
    lo = wp.vec3(frame[0], frame[1], frame[2])
    p = (verts[i] - lo) / frame[3] - wp.vec3(0.5, 0.5, 0.5)
    x0 = wp.max(int(wp.ceil(p[0] - reach)), 0)
    y0 = wp.max(int(wp.ceil(p[1] - reach)), 0)
    z0 = wp.max(int(wp.ceil(p[2] - reach)), 0)
    x1 = wp.min(int(wp.floor(p[0] + reach)), size - 1)
    y1 = wp.min(int(wp.floor(p[1] + reach)), size - 1)
    z1 = wp.min(int(wp.floor(p[2] + reach)), size - 1)
    for z in range(z0, z1 + 1):
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                d = wp.length_sq(p - wp.vec3(float(x), float(y), float(z)))
                if d <= reach * reach:
                    key = wp.int64(d * 1.0e6) * _KEY + wp.int64(i)
                    wp.atomic_min(nearest, (z * size + y) * size + x, key)


@no_type_check
@wp.kernel
def first_guess(
    start: int,
    points: wp.array(dtype=wp.vec3),
    frame: wp.array(dtype=wp.float32),
    size: int,
    nearest: wp.array(dtype=wp.int64),
    mesh: wp.uint64,
    faces: wp.array(dtype=wp.vec3i),
    max_distance: float,
    rest: wp.array(dtype=wp.vec3),
    skinned: wp.array(dtype=wp.vec3),
    inverse: wp.array2d(dtype=wp.vec3),
    guess: wp.array(dtype=wp.vec3),
):
    """Rest point by the inverse map of the vertex of the voxel, or of the closest face."""
    i = start + wp.tid()
    x = points[i]
    lo = wp.vec3(frame[0], frame[1], frame[2])
    cell = voxel_of(x, lo, wp.vec3i(size, size, size), 1.0 / frame[3])
    v = int(-1)
    if cell >= 0:
        key = nearest[cell]
        if key < _EMPTY:
            v = int(key % _KEY)
    if v < 0:
        query = wp.mesh_query_point_no_sign(mesh, x, max_distance)
        if query.result:
            corner = faces[query.face]
            v = corner[2]
            if query.u >= query.v and query.u >= 1.0 - query.u - query.v:
                v = corner[0]
            elif query.v >= 1.0 - query.u - query.v:
                v = corner[1]
    p = x
    if v >= 0:
        e = x - skinned[v]
        p = rest[v] + wp.vec3(
            wp.dot(inverse[v, 0], e), wp.dot(inverse[v, 1], e), wp.dot(inverse[v, 2], e)
        )
    guess[i] = p


@no_type_check
@wp.func
def bary_gradients(w: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Gradients of the last two barycentrics of the closest point (the first: minus their sum)."""
    gb = wp.vec3(0.0, 0.0, 0.0)
    gc = wp.vec3(0.0, 0.0, 0.0)
    ab = b - a
    ac = c - a
    if w[0] > 0.0 and w[1] > 0.0 and w[2] > 0.0:
        d00 = wp.dot(ab, ab)
        d01 = wp.dot(ab, ac)
        d11 = wp.dot(ac, ac)
        det = wp.max(d00 * d11 - d01 * d01, 1.0e-30)
        gb = (ab * d11 - ac * d01) / det
        gc = (ac * d00 - ab * d01) / det
    elif w[0] > 0.0 and w[1] > 0.0:
        gb = ab / wp.max(wp.dot(ab, ab), 1.0e-30)
    elif w[0] > 0.0 and w[2] > 0.0:
        gc = ac / wp.max(wp.dot(ac, ac), 1.0e-30)
    elif w[1] > 0.0 and w[2] > 0.0:
        bc = c - b
        gc = bc / wp.max(wp.dot(bc, bc), 1.0e-30)
        gb = -gc
    return gb, gc


@no_type_check
@wp.func
def solve_rows(r0: wp.vec3, r1: wp.vec3, r2: wp.vec3, e: wp.vec3):
    """Step of a 3x3 system given by its rows, and its determinant; unscaled where that is 0."""
    c0 = wp.cross(r1, r2)
    det = wp.dot(r0, c0)
    step = c0 * e[0] + wp.cross(r2, r0) * e[1] + wp.cross(r0, r1) * e[2]
    if det != 0.0:
        step = step / det
    return step, det


@no_type_check
@wp.func
def affine(maps: wp.array2d(dtype=wp.vec4), v: int, h: wp.vec4):
    """A point under the map of one vertex."""
    return wp.vec3(wp.dot(maps[v, 0], h), wp.dot(maps[v, 1], h), wp.dot(maps[v, 2], h))


@no_type_check
@wp.func
def blended_row(maps: wp.array2d(dtype=wp.vec4), row: int, v: wp.vec3i, w: wp.vec3):
    """Linear part of row ``row`` of the maps of three vertices, mixed with barycentrics."""
    m = maps[v[0], row] * w[0] + maps[v[1], row] * w[1] + maps[v[2], row] * w[2]
    return wp.vec3(m[0], m[1], m[2])


@no_type_check
@wp.func
def bone_guess(
    x: wp.vec3, rank: int, joints: wp.array(dtype=wp.vec3), bones: wp.array2d(dtype=wp.vec4)
):
    """The point under the inverse of the bone whose joint is the ``rank``-th nearest."""
    floor = float(-1.0)
    chosen = int(0)
    for _ in range(rank + 1):
        best = float(1.0e30)
        for j in range(joints.shape[0]):
            d = wp.length_sq(x - joints[j])
            if d > floor and d < best:
                best = d
                chosen = j
        floor = best
    return affine(bones, chosen, wp.vec4(x[0], x[1], x[2], 1.0))


@no_type_check
@wp.kernel
def solve(
    start: int,
    order: wp.array(dtype=wp.int64),
    points: wp.array(dtype=wp.vec3),
    guess: wp.array(dtype=wp.vec3),
    mesh: wp.uint64,
    tris: wp.array2d(dtype=wp.vec3),
    discs: wp.array2d(dtype=wp.vec4),
    faces: wp.array(dtype=wp.vec3i),
    lo: wp.vec3,
    dims: wp.vec3i,
    voxel: float,
    slots: wp.array(dtype=wp.int32),
    near: wp.array2d(dtype=wp.vec2),
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
    face: wp.array(dtype=wp.int32),
    residual: wp.array(dtype=wp.float32),
    invertible: wp.array(dtype=wp.bool),
):
    """Solve x = A(w(p)) p from a guess: Newton steps, or re-queries where ``gradients`` is 0.

    After a step that did not help, the next one re-queries only. A point that did not arrive starts
    again from the inverse of its nearest bones. ``limits``: residual that ends the iterations,
    residual that ends the starts, smallest determinant, reach of the rest surface.
    """
    i = int(order[start + wp.tid()])
    x = points[i]
    p = guess[i]
    best_p = p
    best_w = wp.vec3(0.0, 0.0, 0.0)
    best_face = int(-1)
    best = float(1.0e30)
    best_ok = bool(False)
    last = float(1.0e30)
    f = int(-1)
    k = int(0)
    attempt = int(0)
    while attempt < starts:
        f = closest_face(p, mesh, tris, discs, lo, dims, voxel, slots, near, f, limits[3])
        over = k >= iterations or f < 0
        k += 1
        if f >= 0:
            a = tris[f, 0]
            b = tris[f, 1]
            c = tris[f, 2]
            w = bary_on_triangle(p, a, b, c)
            v = faces[f]
            h = wp.vec4(p[0], p[1], p[2], 1.0)
            ya = affine(maps, v[0], h)
            yb = affine(maps, v[1], h)
            yc = affine(maps, v[2], h)
            e = x - ya * w[0] - yb * w[1] - yc * w[2]
            r = wp.length(e)
            r0 = blended_row(maps, 0, v, w)
            r1 = blended_row(maps, 1, v, w)
            r2 = blended_row(maps, 2, v, w)
            step, det = solve_rows(r0, r1, r2, e)
            ok = wp.abs(det) > limits[2]
            better = r < last
            last = r
            if r < best:
                best = r
                best_p = p
                best_w = w
                best_face = f
                best_ok = ok
            over = over or r <= limits[0]
            if gradients != 0 and better and not over:
                gb, gc = bary_gradients(w, a, b, c)
                db = yb - ya
                dc = yc - ya
                r0 += gb * db[0] + gc * dc[0]
                r1 += gb * db[1] + gc * dc[1]
                r2 += gb * db[2] + gc * dc[2]
                full, full_det = solve_rows(r0, r1, r2, e)
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
                f = -1
                k = 0
                last = 1.0e30
    rest[i] = best_p
    face[i] = best_face
    residual[i] = best
    invertible[i] = best_ok
    if best_face >= 0:
        v = faces[best_face]
        for j in range(weights.shape[1]):
            blend[i, j] = (
                weights[v[0], j] * best_w[0]
                + weights[v[1], j] * best_w[1]
                + weights[v[2], j] * best_w[2]
            )
