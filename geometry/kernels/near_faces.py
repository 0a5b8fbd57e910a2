"""Warp kernels of the closest face: lists of the possible faces of every voxel near a surface."""

# ruff: noqa: PLR0911, C901 - one return per region of a triangle; one loop over candidates

from typing import no_type_check

import warp as wp

from .shell import voxel_of

wp.set_module_options({"enable_backward": False})  # the search is piecewise constant


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
    near: wp.array2d(dtype=wp.vec2),
):
    """The faces that can be the closest of any point of a voxel, nearest to its centre first.

    An entry is (distance to the centre, face): side by side, for the look-up waits for memory.
    A row that is not full is complete and ends with face -1; a full row holds the nearest ones.
    """
    i = start + wp.tid()
    c = centre_of(cells[i], lo, dims, voxel)
    query = wp.mesh_query_point_no_sign(mesh, c, 1.0e10)
    limit = gap_to_face(c, tris, query.face) + 1.7321 * voxel + 1.0e-5
    side = wp.vec3(limit, limit, limit)
    boxes = wp.mesh_query_aabb(mesh, c - side, c + side)
    f = int(0)
    count = int(0)
    size = near.shape[1]
    while wp.mesh_query_aabb_next(boxes, f):
        d = gap_to_face(c, tris, f)
        if d <= limit and (count < size or d < near[i, size - 1][0]):
            k = wp.min(count, size - 1)
            while k > 0 and near[i, wp.max(k - 1, 0)][0] > d:
                near[i, k] = near[i, k - 1]
                k -= 1
            near[i, k] = wp.vec2(d, float(f))
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
    near: wp.array2d(dtype=wp.vec2),
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
    slot = int(-1)
    if cell >= 0:
        slot = slots[cell]
    if slot >= 0:
        away = wp.length(p - centre_of(cell, lo, dims, voxel)) + 1.0e-6
        size = near.shape[1]
        k = int(0)
        while k < size and not proven:
            entry = near[slot, k]
            f = int(entry[1])
            if f < 0 or entry[0] - away > best_gap:
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
