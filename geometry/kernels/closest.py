"""Warp kernels of the parts of many posed bodies: closest surface, and the way to rest space."""

from typing import no_type_check

import warp as wp

from .face_tree import bary_on_triangle, closest_in_tree

wp.set_module_options({"enable_backward": False})  # gradients are kernels of their own


@no_type_check
@wp.kernel
def closest_on_parts(
    start: int,
    layout: wp.array2d(dtype=wp.int64),
    boxes: wp.array2d(dtype=wp.float32),
    tris: wp.array2d(dtype=wp.float32),
    slots: wp.array(dtype=wp.int32),
    verts: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    points: wp.array(dtype=wp.vec3),
    body: wp.array(dtype=wp.int32),
    candidates: wp.array(dtype=wp.int32),
    radius: wp.array(dtype=wp.float32),
    face: wp.array2d(dtype=wp.int32),
    bary: wp.array2d(dtype=wp.vec2),
):
    """Per sample and candidate part: closest face of that part within its radius, or -1."""
    i = start + wp.tid()
    p = points[i]
    b = body[i]
    mask = candidates[i]
    for k in range(layout.shape[0]):
        found = int(-1)
        uv = wp.vec2(0.0, 0.0)
        if (mask >> k) & 1:
            found = closest_in_tree(
                p, layout, boxes, tris, slots, k, wp.int64(b), radius[k] * radius[k]
            )
            if found >= 0:
                tri = faces[found]
                w = bary_on_triangle(p, verts[b, tri[0]], verts[b, tri[1]], verts[b, tri[2]])
                uv = wp.vec2(w[0], w[1])
        face[k, i] = found
        bary[k, i] = uv


@no_type_check
@wp.func
def blended(table: wp.array2d(dtype=wp.vec4), row: int, v: wp.vec3i, w: wp.vec3):
    """Row ``row`` of the 3x4 affine map of three vertices, mixed with barycentrics."""
    return table[v[0], row] * w[0] + table[v[1], row] * w[1] + table[v[2], row] * w[2]


@no_type_check
@wp.func
def of_body(corners: wp.vec3i, first: int):
    """The corners of a face among the vertices of all bodies, where those of its body begin."""
    return wp.vec3i(corners[0] + first, corners[1] + first, corners[2] + first)


@no_type_check
@wp.func
def all_three(bary: wp.vec2):
    """All barycentrics from the first two."""
    return wp.vec3(bary[0], bary[1], 1.0 - bary[0] - bary[1])


@no_type_check
@wp.kernel
def unskin_pairs(
    start: int,
    sample: wp.array(dtype=wp.int64),
    points: wp.array(dtype=wp.vec3),
    body: wp.array(dtype=wp.int32),
    face: wp.array(dtype=wp.int64),
    bary: wp.array(dtype=wp.vec2),
    faces: wp.array(dtype=wp.vec3i),
    corner_uv: wp.array2d(dtype=wp.vec2),
    posed_maps: wp.array2d(dtype=wp.vec4),
    canonical_maps: wp.array2d(dtype=wp.vec4),
    num_verts: int,
    min_det: float,
    canonical: wp.array(dtype=wp.vec3),
    uv: wp.array(dtype=wp.vec2),
    valid: wp.array(dtype=wp.bool),
):
    """Canonical point B(w) A(w)^-1 p, weights interpolated on the face, and the UV of the hit.

    The blended maps are linear in the weights and the weights are linear on a face, so that mixing
    the maps of the three corners is exact.
    """
    i = start + wp.tid()
    s = sample[i]
    f = int(face[i])
    w = all_three(bary[i])
    tri = faces[f]
    posed_tri = of_body(tri, body[s] * num_verts)
    a0 = blended(posed_maps, 0, posed_tri, w)
    a1 = blended(posed_maps, 1, posed_tri, w)
    a2 = blended(posed_maps, 2, posed_tri, w)
    r0 = wp.vec3(a0[0], a0[1], a0[2])
    r1 = wp.vec3(a1[0], a1[1], a1[2])
    r2 = wp.vec3(a2[0], a2[1], a2[2])
    q = points[s] - wp.vec3(a0[3], a1[3], a2[3])
    c0 = wp.cross(r1, r2)
    c1 = wp.cross(r2, r0)
    c2 = wp.cross(r0, r1)
    det = wp.dot(r0, c0)
    ok = wp.abs(det) > min_det
    if not ok:
        det = 1.0
    rest = (c0 * q[0] + c1 * q[1] + c2 * q[2]) / det
    h = wp.vec4(rest[0], rest[1], rest[2], 1.0)
    canonical[i] = wp.vec3(
        wp.dot(blended(canonical_maps, 0, tri, w), h),
        wp.dot(blended(canonical_maps, 1, tri, w), h),
        wp.dot(blended(canonical_maps, 2, tri, w), h),
    )
    uv[i] = corner_uv[f, 0] * w[0] + corner_uv[f, 1] * w[1] + corner_uv[f, 2] * w[2]
    valid[i] = ok


@no_type_check
@wp.kernel
def interpolate_rows(
    start: int,
    table: wp.array2d(dtype=wp.vec4),
    body: wp.array(dtype=wp.int64),
    face: wp.array(dtype=wp.int64),
    bary: wp.array(dtype=wp.vec2),
    faces: wp.array(dtype=wp.vec3i),
    num_verts: int,
    out: wp.array2d(dtype=wp.vec4),
):
    """Values of the vertices of many bodies, four numbers at a time, on points of their faces."""
    i = start + wp.tid()
    w = all_three(bary[i])
    corners = of_body(faces[int(face[i])], int(body[i]) * num_verts)
    for k in range(out.shape[1]):
        out[i, k] = blended(table, k, corners, w)
