"""Warp kernels of inverse skinning: near-face lists, first guesses, and the whole solve of a point in one thread."""

from typing import no_type_check

import warp as wp

from .shell import voxel_of

wp.set_module_options(
    {"enable_backward": False}
)  # gradients come from the implicit function theorem

_KEY = wp.constant(wp.int64(1 << 32))
EMPTY = (1 << 63) - 1
_EMPTY = wp.constant(wp.int64(EMPTY))


@no_type_check
@wp.func
def bary_on_triangle(p: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Barycentrics of the nearest point of a triangle; exact zeros on edges and corners.

    C. Ericson, Real-Time Collision Detection, 2005, ch. 5.1.5: at most one division.
    """
    ab = b - a
    ac = c - a
    ap = p - a
    d1 = wp.dot(ab, ap)
    d2 = wp.dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return wp.vec3(1.0, 0.0, 0.0)
    d00 = wp.dot(ab, ab)
    d01 = wp.dot(ab, ac)
    d11 = wp.dot(ac, ac)
    d3 = d1 - d00
    d4 = d2 - d01
    if d3 >= 0.0 and d4 <= d3:
        return wp.vec3(0.0, 1.0, 0.0)
    d5 = d1 - d01
    d6 = d2 - d11
    if d6 >= 0.0 and d5 <= d6:
        return wp.vec3(0.0, 0.0, 1.0)
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        t = d1 / wp.max(d00, 1.0e-30)
        return wp.vec3(1.0 - t, t, 0.0)
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        t = d2 / wp.max(d11, 1.0e-30)
        return wp.vec3(1.0 - t, 0.0, t)
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        t = (d4 - d3) / wp.max((d4 - d3) + (d5 - d6), 1.0e-30)
        return wp.vec3(0.0, 1.0 - t, t)
    scale = 1.0 / wp.max(va + vb + vc, 1.0e-30)
    v = vb * scale
    w = vc * scale
    return wp.vec3(1.0 - v - w, v, w)


@no_type_check
@wp.func
def gap_to_face(p: wp.vec3, tris: wp.array2d(dtype=wp.vec3), f: int):
    """Distance to one triangle."""
    a = tris[f, 0]
    b = tris[f, 1]
    c = tris[f, 2]
    w = bary_on_triangle(p, a, b, c)
    return wp.length(p - a * w[0] - b * w[1] - c * w[2])


@no_type_check
@wp.func
def centre_of(cell: int, lo: wp.vec3, dims: wp.vec3i, voxel: float):
    """Centre of a voxel."""
    x = cell % dims[0]
    y = (cell // dims[0]) % dims[1]
    z = cell // (dims[0] * dims[1])
    return lo + wp.vec3(float(x) + 0.5, float(y) + 0.5, float(z) + 0.5) * voxel


@no_type_check
@wp.kernel
def mark_near(
    start: int,
    mesh: wp.uint64,
    lo: wp.vec3,
    dims: wp.vec3i,
    voxel: float,
    reach: float,
    near: wp.array(dtype=wp.bool),
):
    """Voxels whose centre is within ``reach`` of the surface."""
    i = start + wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, centre_of(i, lo, dims, voxel), reach)
    near[i] = query.result


@no_type_check
@wp.kernel
def list_faces(
    start: int,
    mesh: wp.uint64,
    tris: wp.array2d(dtype=wp.vec3),
    cells: wp.array(dtype=wp.int32),
    lo: wp.vec3,
    dims: wp.vec3i,
    voxel: float,
    face: wp.array2d(dtype=wp.int32),
    gap: wp.array2d(dtype=wp.float32),
):
    """The faces that can be the closest of any point of a voxel, nearest to its centre first.

    A row that is not full is complete and ends with -1; a full row holds the nearest ones.
    """
    i = start + wp.tid()
    c = centre_of(cells[i], lo, dims, voxel)
    query = wp.mesh_query_point_no_sign(mesh, c, 1.0e10)
    limit = gap_to_face(c, tris, query.face) + 1.7321 * voxel + 1.0e-5
    side = wp.vec3(limit, limit, limit)
    boxes = wp.mesh_query_aabb(mesh, c - side, c + side)
    f = int(0)
    count = int(0)
    size = face.shape[1]
    while wp.mesh_query_aabb_next(boxes, f):
        d = gap_to_face(c, tris, f)
        if d <= limit and (count < size or d < gap[i, size - 1]):
            k = wp.min(count, size - 1)
            while k > 0 and gap[i, wp.max(k - 1, 0)] > d:
                gap[i, k] = gap[i, k - 1]
                face[i, k] = face[i, k - 1]
                k -= 1
            gap[i, k] = d
            face[i, k] = f
            count += 1


@no_type_check
@wp.func
def out_of_reach(p: wp.vec3, discs: wp.array2d(dtype=wp.vec4), f: int, best: float):
    """Whether a face is certainly farther than ``best``: by the disc around it, in its plane."""
    disc = discs[f, 0]
    normal = discs[f, 1]
    q = p - wp.vec3(disc[0], disc[1], disc[2])
    h = wp.dot(q, wp.vec3(normal[0], normal[1], normal[2]))
    rest = best * best - h * h
    if rest < -1.0e-12:
        return True
    reach = disc[3] + wp.sqrt(wp.max(rest, 0.0))
    return wp.dot(q, q) - h * h > reach * reach


@no_type_check
@wp.func
def closest_face(
    p: wp.vec3,
    mesh: wp.uint64,
    tris: wp.array2d(dtype=wp.vec3),
    discs: wp.array2d(dtype=wp.vec4),
    lo: wp.vec3,
    dims: wp.vec3i,
    voxel: float,
    slots: wp.array(dtype=wp.int32),
    near_face: wp.array2d(dtype=wp.int32),
    near_gap: wp.array2d(dtype=wp.float32),
    hint: int,
    max_distance: float,
):
    """Closest face by the list of the voxel, exact by the triangle inequality; else by the tree."""
    best = int(-1)
    best_gap = max_distance
    if hint >= 0:
        d = gap_to_face(p, tris, hint)
        if d < best_gap:
            best_gap = d
            best = hint
    proven = bool(False)
    cell = voxel_of(p, lo, dims, 1.0 / voxel)
    if cell >= 0:
        slot = slots[cell]
        if slot >= 0:
            away = wp.length(p - centre_of(cell, lo, dims, voxel)) + 1.0e-6
            size = near_face.shape[1]
            k = int(0)
            while k < size and not proven:
                f = near_face[slot, k]
                if f < 0 or near_gap[slot, k] - away > best_gap:
                    proven = True
                elif not out_of_reach(p, discs, f, best_gap):
                    d = gap_to_face(p, tris, f)
                    if d < best_gap:
                        best_gap = d
                        best = f
                k += 1
    if not proven:
        query = wp.mesh_query_point_no_sign(mesh, p, best_gap)
        if query.result:
            best = query.face
    return best


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
    """Nearest vertex of every voxel centre within ``reach`` voxels; the key is (distance, vertex)."""
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
    """Rest point by the local inverse of the vertex that the voxel names, or of the closest face."""
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
    """Gradients of the last two barycentrics of the closest point (the first is minus their sum)."""
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
def bone_guess(x: wp.vec3, rank: int, joints: wp.array(dtype=wp.vec3), bones: wp.array2d(dtype=wp.vec4)):
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
    near_face: wp.array2d(dtype=wp.int32),
    near_gap: wp.array2d(dtype=wp.float32),
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

    A point that did not arrive starts again from the inverse of its nearest bones. ``limits`` are: residual
    that ends the iterations, residual that ends the starts, smallest determinant, reach of the rest surface.
    """
    i = start + wp.tid()
    x = points[i]
    p = guess[i]
    best_p = p
    best_w = wp.vec3(0.0, 0.0, 0.0)
    best_face = int(-1)
    best = float(1.0e30)
    best_ok = bool(False)
    f = int(-1)
    k = int(0)
    attempt = int(0)
    while attempt < starts:
        f = closest_face(
            p, mesh, tris, discs, lo, dims, voxel, slots, near_face, near_gap, f, limits[3]
        )
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
            if r < best:
                best = r
                best_p = p
                best_w = w
                best_face = f
                best_ok = ok
            over = over or r <= limits[0]
            if gradients != 0 and not over:
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
