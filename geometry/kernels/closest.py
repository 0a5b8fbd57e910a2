"""Warp kernels of the closest surface: one mesh, and the parts of many posed bodies at once."""

from typing import Any, no_type_check

import warp as wp

wp.set_module_options({"enable_backward": False})  # gradients are kernels of their own


@no_type_check
@wp.kernel
def closest_on_mesh(
    start: int,
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    max_distance: float,
    face: wp.array(dtype=wp.int32),
    bary: wp.array(dtype=wp.vec2),
):
    """Face and first two barycentrics of the closest point; face -1 beyond max_distance."""
    i = start + wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], max_distance)
    if query.result:
        face[i] = query.face
        bary[i] = wp.vec2(query.u, query.v)
    else:
        face[i] = -1
        bary[i] = wp.vec2(0.0, 0.0)


@no_type_check
@wp.kernel
def closest_on_parts(
    start: int,
    meshes: wp.array2d(dtype=wp.int64),
    points: wp.array(dtype=wp.vec3),
    body: wp.array(dtype=wp.int32),
    candidates: wp.array(dtype=wp.int32),
    radius: wp.array(dtype=wp.float32),
    face: wp.array2d(dtype=wp.int32),
    bary: wp.array2d(dtype=wp.vec2),
):
    """Per sample and candidate part: face of that part's own mesh within its radius, or -1."""
    i = start + wp.tid()
    p = points[i]
    b = body[i]
    mask = candidates[i]
    for k in range(meshes.shape[1]):
        found = int(-1)
        uv = wp.vec2(0.0, 0.0)
        if (mask >> k) & 1 and meshes[b, k] != wp.int64(0):  # 0: a part without faces
            query = wp.mesh_query_point_no_sign(wp.uint64(meshes[b, k]), p, radius[k])
            if query.result:
                found = query.face
                uv = wp.vec2(query.u, query.v)
        face[k, i] = found
        bary[k, i] = uv


@no_type_check
@wp.func
def blended(table: wp.array2d(dtype=wp.vec4), row: int, v: wp.vec3i, w: wp.vec3):
    """Row ``row`` of the 3x4 affine map of three vertices, mixed with barycentrics."""
    return table[v[0], row] * w[0] + table[v[1], row] * w[1] + table[v[2], row] * w[2]


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
    u = bary[i][0]
    v = bary[i][1]
    w = wp.vec3(u, v, 1.0 - u - v)
    tri = faces[f]
    base = body[s] * num_verts
    posed_tri = wp.vec3i(tri[0] + base, tri[1] + base, tri[2] + base)
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


def mesh(points: Any, faces: Any) -> wp.Mesh:
    """A Warp mesh over torch tensors (vertices V 3 float32, faces F 3 int32), without a copy."""
    return wp.Mesh(
        wp.from_torch(points.detach(), dtype=wp.vec3, requires_grad=False),
        wp.from_torch(faces.reshape(-1), dtype=wp.int32, requires_grad=False),
    )
