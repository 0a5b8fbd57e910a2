"""Warp kernels of inverse skinning: first guesses, and the whole solve of a point in one thread."""

# ruff: noqa: PLR0912, PLR0915, C901 - one kernel holds the loop: a call per step would copy its state

from typing import no_type_check

import warp as wp

from .face_tree import bary_on_triangle, closest_in_leaf, closest_in_tree
from .shell import voxel_of

wp.set_module_options({"enable_backward": False})  # gradients: the implicit function theorem

# three rows mixed into one: whole rows at a time become vector instructions
_MIX = """
    const int count = weights.shape[1];
    const float* a = weights.data + (long long)v[0] * count;
    const float* b = weights.data + (long long)v[1] * count;
    const float* c = weights.data + (long long)v[2] * count;
    float* to = blend.data + (long long)row * count;
    for (int j = 0; j < count; j++) to[j] = w[0] * a[j] + w[1] * b[j] + w[2] * c[j];
"""

_KEY = wp.constant(wp.int64(1 << 32))
EMPTY = (1 << 63) - 1
ROUGH_STEPS = wp.constant(1)  # a second one costs more than it saves (measured)
_EMPTY = wp.constant(wp.int64(EMPTY))


@no_type_check
@wp.func_native(_MIX)
def mix_rows(
    weights: wp.array2d(dtype=wp.float32),
    v: wp.vec3i,
    w: wp.vec3,
    blend: wp.array2d(dtype=wp.float32),
    row: int,
) -> None:
    """Write row ``row`` of ``blend``: weights of three vertices mixed with barycentrics."""
    ...


@no_type_check
@wp.func
def affine(maps: wp.array2d(dtype=wp.vec4), v: int, h: wp.vec4):
    """A point under the map of one vertex."""
    return wp.vec3(wp.dot(maps[v, 0], h), wp.dot(maps[v, 1], h), wp.dot(maps[v, 2], h))


@no_type_check
@wp.kernel
def skin_verts(
    start: int,
    rest: wp.array(dtype=wp.vec3),
    maps: wp.array2d(dtype=wp.vec4),
    min_det: float,
    skinned: wp.array(dtype=wp.vec3),
    inverse: wp.array2d(dtype=wp.vec3),
):
    """Posed vertices, and the inverse of the linear part of their maps (zero where singular)."""
    i = start + wp.tid()
    m0 = maps[i, 0]
    m1 = maps[i, 1]
    m2 = maps[i, 2]
    p = rest[i]
    skinned[i] = affine(maps, i, wp.vec4(p[0], p[1], p[2], 1.0))
    r0 = wp.vec3(m0[0], m0[1], m0[2])
    r1 = wp.vec3(m1[0], m1[1], m1[2])
    r2 = wp.vec3(m2[0], m2[1], m2[2])
    c0 = wp.cross(r1, r2)
    c1 = wp.cross(r2, r0)
    c2 = wp.cross(r0, r1)
    det = wp.dot(r0, c0)
    scale = float(0.0)
    if wp.abs(det) > min_det:
        scale = 1.0 / det
    inverse[i, 0] = wp.vec3(c0[0], c1[0], c2[0]) * scale
    inverse[i, 1] = wp.vec3(c0[1], c1[1], c2[1]) * scale
    inverse[i, 2] = wp.vec3(c0[2], c1[2], c2[2]) * scale


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
    layout: wp.array2d(dtype=wp.int64),
    boxes: wp.array2d(dtype=wp.float32),
    tris: wp.array2d(dtype=wp.float32),
    slots: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    max_distance: float,
    rest: wp.array(dtype=wp.vec3),
    skinned: wp.array(dtype=wp.vec3),
    inverse: wp.array2d(dtype=wp.vec3),
    some_face: wp.array(dtype=wp.int32),
    guess: wp.array(dtype=wp.vec3),
    hint: wp.array(dtype=wp.int32),
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
        f = closest_in_tree(
            x, layout, boxes, tris, slots, 0, wp.int64(0), max_distance * max_distance
        )
        if f >= 0:
            corner = faces[f]
            w = bary_on_triangle(x, skinned[corner[0]], skinned[corner[1]], skinned[corner[2]])
            v = corner[2]
            if w[0] >= w[1] and w[0] >= w[2]:
                v = corner[0]
            elif w[1] >= w[2]:
                v = corner[1]
    p = x
    hint[i] = -1
    if v >= 0:
        hint[i] = some_face[v]
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
def rows_of(maps: wp.array2d(dtype=wp.vec4), v: int):
    """The three rows of the map of one vertex."""
    return maps[v, 0], maps[v, 1], maps[v, 2]


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
@wp.func
def closest_from(
    p: wp.vec3,
    hint: int,
    layout: wp.array2d(dtype=wp.int64),
    boxes: wp.array2d(dtype=wp.float32),
    tris: wp.array2d(dtype=wp.float32),
    slots: wp.array(dtype=wp.int32),
    verts: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    max_distance: float,
):
    """Closest face, from a face that is probably near; -1 beyond the reach."""
    limit = max_distance * max_distance
    known = int(-1)
    if hint >= 0:
        v = faces[hint]
        w = bary_on_triangle(p, verts[v[0]], verts[v[1]], verts[v[2]])
        d = wp.length_sq(p - verts[v[0]] * w[0] - verts[v[1]] * w[1] - verts[v[2]] * w[2])
        if d < limit:
            limit = d * (1.0 + 1.0e-6) + 1.0e-18  # the tree decides between equals
            known = hint
    f = closest_in_tree(p, layout, boxes, tris, slots, 0, wp.int64(0), limit)
    return wp.where(f >= 0, f, known)


@no_type_check
@wp.kernel
def solve(
    start: int,
    order: wp.array(dtype=wp.int64),
    points: wp.array(dtype=wp.vec3),
    guess: wp.array(dtype=wp.vec3),
    hint: wp.array(dtype=wp.int32),
    places: wp.array(dtype=wp.int32),
    layout: wp.array2d(dtype=wp.int64),
    boxes: wp.array2d(dtype=wp.float32),
    tris: wp.array2d(dtype=wp.float32),
    slots: wp.array(dtype=wp.int32),
    verts: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
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

    The first steps of a guess with a hint take the weights of the hint's leaf, which are cheap and
    near enough to step by; only residuals with the closest face count.
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
    rough = int(0)
    if hint[i] >= 0 and iterations > 0:
        rough = ROUGH_STEPS
    while attempt < starts:
        over = bool(False)
        if rough > 0:
            f = closest_in_leaf(p, layout, tris, slots, places, hint[i])
        else:
            f = closest_from(p, f, layout, boxes, tris, slots, verts, faces, limits[3])
            over = k >= iterations or f < 0
            k += 1
        if f >= 0:
            v = faces[f]
            a = verts[v[0]]
            b = verts[v[1]]
            c = verts[v[2]]
            w = bary_on_triangle(p, a, b, c)
            h = wp.vec4(p[0], p[1], p[2], 1.0)
            a0, a1, a2 = rows_of(maps, v[0])
            b0, b1, b2 = rows_of(maps, v[1])
            c0, c1, c2 = rows_of(maps, v[2])
            m0 = a0 * w[0] + b0 * w[1] + c0 * w[2]
            m1 = a1 * w[0] + b1 * w[1] + c1 * w[2]
            m2 = a2 * w[0] + b2 * w[1] + c2 * w[2]
            e = x - wp.vec3(wp.dot(m0, h), wp.dot(m1, h), wp.dot(m2, h))
            r = wp.length(e)
            r0 = wp.vec3(m0[0], m0[1], m0[2])
            r1 = wp.vec3(m1[0], m1[1], m1[2])
            r2 = wp.vec3(m2[0], m2[1], m2[2])
            step, det = solve_rows(r0, r1, r2, e)
            ok = wp.abs(det) > limits[2]
            better = r < last
            if rough == 0:
                last = r
            if r < best and rough == 0:
                best = r
                best_p = p
                best_w = w
                best_face = f
                best_ok = ok
            over = over or (r <= limits[0] and rough == 0)
            if gradients != 0 and better and not over:
                gb, gc = bary_gradients(w, a, b, c)
                r0 += gb * wp.dot(b0 - a0, h) + gc * wp.dot(c0 - a0, h)
                r1 += gb * wp.dot(b1 - a1, h) + gc * wp.dot(c1 - a1, h)
                r2 += gb * wp.dot(b2 - a2, h) + gc * wp.dot(c2 - a2, h)
                full, full_det = solve_rows(r0, r1, r2, e)
                if wp.abs(full_det) > limits[2]:
                    step = full
                    ok = True
            size = wp.length(step)
            over = over or not ok
            if size > 0.2:
                step = step * (0.2 / size)
            p = p + step
        rough = wp.max(rough - 1, 0)
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
        mix_rows(weights, faces[best_face], best_w, blend, i)
    else:
        for j in range(blend.shape[1]):
            blend[i, j] = 0.0
