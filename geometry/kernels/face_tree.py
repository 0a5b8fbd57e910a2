"""Warp kernels of the 8-wide face tree: refit, and the search that all closest-surface queries use.

The search is C++ inside a Warp function: its loops over 8 lanes become vector instructions on the
CPU, and the same text compiles for CUDA. Layout of the arrays: see `monopart.geometry.face_tree`.
"""

# pyright: reportInvalidTypeForm=false

from typing import Any, no_type_check

import warp as wp

wp.set_module_options({"enable_backward": False})  # the search is piecewise constant

FAR = 1e15  # coordinate of what is not there: its squared distance is finite and beyond any limit
LANES = 8  # children of a node, faces of a leaf: one vector of 8 floats
BOX_ROWS = 6  # rows of a node: lower x y z and upper x y z of the boxes of its children
FACE_ROWS = 14  # rows of a leaf: see `FaceTrees.tris`
LAYOUT = 6  # numbers that describe the tree of one group
_FAR = wp.constant(FAR)
_FACE_ROWS = wp.constant(FACE_ROWS)

# Squared distances d[8] of a point p to the faces of a leaf t, each in its own frame: x along the
# first edge, y in the plane, z off it. An orthonormal frame turns, it does not stretch: a needle
# keeps its digits, where determinants of its edges would cancel to nothing.
_LEAF = """
    for (int k = 0; k < 8; k++) {
        const float px = p[0] - t[k], py = p[1] - t[8 + k], pz = p[2] - t[16 + k];
        const float ux = t[24 + k], uy = t[32 + k], uz = t[40 + k];
        const float vx = t[48 + k], vy = t[56 + k], vz = t[64 + k];
        const float bx = t[72 + k], cx = t[80 + k], cy = t[88 + k];
        const float x = ux * px + uy * py + uz * pz;
        const float y = vx * px + vy * py + vz * pz;
        const float z = (uy * vz - uz * vy) * px + (uz * vx - ux * vz) * py
            + (ux * vy - uy * vx) * pz;
        const float ex = cx - bx, qx = x - bx;
        float s = x;
        float u = (x * cx + y * cy) * t[96 + k];
        float q = (qx * ex + y * cy) * t[104 + k];
        s = s < 0.0f ? 0.0f : (s > bx ? bx : s);
        u = u < 0.0f ? 0.0f : (u > 1.0f ? 1.0f : u);
        q = q < 0.0f ? 0.0f : (q > 1.0f ? 1.0f : q);
        const float on_b = (x - s) * (x - s) + y * y;
        const float cu = x - u * cx, cv = y - u * cy;
        const float on_c = cu * cu + cv * cv;
        const float au = qx - q * ex, av = y - q * cy;
        const float on_a = au * au + av * av;
        float edge = on_b < on_c ? on_b : on_c;
        edge = edge < on_a ? edge : on_a;
        const bool is_in = y >= 0.0f && cy * x >= cx * y && ex * y >= cy * qx && cy > 0.0f;
        d[k] = z * z + (is_in ? 0.0f : edge);
    }
"""

# Branch and bound with the nearest child first. A stack of 64 holds 9 levels: 8^9 leaves.
_SEARCH = """
    const long long* at = layout.data + 6 * (long long)group;
    const float* box = boxes.data + 8 * (at[0] + body * at[1]);
    const float* tri = tris.data + 8 * (at[2] + body * at[3]);
    const int first_leaf = (int)at[4];
    int waiting[64];
    float gap[64];
    float d[8];
    int top = 0;
    int node = 0;
    int slot = -1;
    float best = best_sq;
    if (first_leaf < 0) return -1;
    for (;;) {
        if (node >= first_leaf) {
            const float* t = tri + (long long)(node - first_leaf) * 112;
            LEAF
            for (int k = 0; k < 8; k++)
                if (d[k] < best) { best = d[k]; slot = (node - first_leaf) * 8 + k; }
        } else {
            const float* b = box + (long long)node * 48;
            for (int k = 0; k < 8; k++) {
                const float x0 = b[k] - p[0], x1 = p[0] - b[24 + k];
                const float y0 = b[8 + k] - p[1], y1 = p[1] - b[32 + k];
                const float z0 = b[16 + k] - p[2], z1 = p[2] - b[40 + k];
                float x = x0 > x1 ? x0 : x1; x = x > 0.0f ? x : 0.0f;
                float y = y0 > y1 ? y0 : y1; y = y > 0.0f ? y : 0.0f;
                float z = z0 > z1 ? z0 : z1; z = z > 0.0f ? z : 0.0f;
                d[k] = x * x + y * y + z * z;
            }
            const int base = top;
            for (int k = 0; k < 8; k++) {
                const float dk = d[k];
                if (dk < best) {
                    int j = top++;
                    while (j > base && gap[j - 1] < dk) {
                        gap[j] = gap[j - 1]; waiting[j] = waiting[j - 1]; j--;
                    }
                    gap[j] = dk; waiting[j] = 8 * node + 1 + k;
                }
            }
        }
        do {
            if (top == 0) return slot < 0 ? -1 : faces.data[at[5] + slot];
            --top;
        } while (gap[top] >= best);
        node = waiting[top];
    }
""".replace("LEAF", _LEAF)

_SEARCH_LEAF = """
    const long long* at = layout.data;
    const int place = places.data[face];
    const float* t = tris.data + 8 * at[2] + (long long)(place / 8) * 112;
    float d[8];
    LEAF
    int best = 0;
    for (int k = 1; k < 8; k++) best = d[k] < d[best] ? k : best;
    return faces.data[at[5] + place - place % 8 + best];
""".replace("LEAF", _LEAF)


@no_type_check  # here, not on the functions, where it would hide the return type from Warp
def _search() -> tuple[Any, Any]:
    @wp.func_native(_SEARCH)
    def closest_in_tree(
        p: wp.vec3,
        layout: wp.array2d(dtype=wp.int64),
        boxes: wp.array2d(dtype=wp.float32),
        tris: wp.array2d(dtype=wp.float32),
        faces: wp.array(dtype=wp.int32),
        group: int,
        body: wp.int64,
        best_sq: float,
    ) -> int: ...

    @wp.func_native(_SEARCH_LEAF)
    def closest_in_leaf(
        p: wp.vec3,
        layout: wp.array2d(dtype=wp.int64),
        tris: wp.array2d(dtype=wp.float32),
        faces: wp.array(dtype=wp.int32),
        places: wp.array(dtype=wp.int32),
        face: int,
    ) -> int: ...

    return closest_in_tree, closest_in_leaf


closest_in_tree, closest_in_leaf = _search()
# the first: closest face of one group of one body nearer than sqrt(best_sq), or -1;
# the second: closest of the faces that share the leaf of a face, in a tree of one group and body


@no_type_check
@wp.func
def bary_on_triangle(p: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Barycentrics of the nearest point of a triangle; exact zeros on edges and corners.

    In an orthogonal basis of the plane, as in the search: a needle keeps its digits.
    """
    ab = b - a
    ac = c - a
    ap = p - a
    d00 = wp.dot(ab, ab)
    d11 = wp.dot(ac, ac)
    over = 1.0 / wp.max(d00, 1.0e-30)
    g = wp.dot(ab, ac) * over
    s = wp.dot(ab, ap) * over
    h = ac - g * ab
    hh = wp.dot(h, h)
    w = wp.dot(h, ap - s * ab) / wp.max(hh, 1.0e-30)
    v = s - w * g
    if v >= 0.0 and w >= 0.0 and v + w <= 1.0 and hh > 1.0e-12 * d11:
        return wp.vec3(1.0 - v - w, v, w)
    bc = c - b
    bp = p - b
    s = wp.clamp(s, 0.0, 1.0)
    u = wp.clamp(wp.dot(ac, ap) / wp.max(d11, 1.0e-30), 0.0, 1.0)
    q = wp.clamp(wp.dot(bc, bp) / wp.max(wp.dot(bc, bc), 1.0e-30), 0.0, 1.0)
    on_b = wp.length_sq(ap - s * ab)
    on_c = wp.length_sq(ap - u * ac)
    on_a = wp.length_sq(bp - q * bc)
    if on_b <= on_c and on_b <= on_a:
        return wp.vec3(1.0 - s, s, 0.0)
    if on_c <= on_a:
        return wp.vec3(1.0 - u, 0.0, u)
    return wp.vec3(0.0, 1.0 - q, q)


@no_type_check
@wp.func
def put_box(
    boxes: wp.array2d(dtype=wp.float32), first: wp.int64, node: int, low: wp.vec3, high: wp.vec3
):
    """Write the box of a node into the record of its parent."""
    up = wp.int64((node - 1) // 8)
    lane = (node - 1) % 8
    row = int(first + wp.int64(6) * up)
    for axis in range(3):
        boxes[row + axis, lane] = low[axis]
        boxes[row + 3 + axis, lane] = high[axis]


@no_type_check
@wp.func
def frame_of(ab: wp.vec3, ac: wp.vec3):
    """Unit vectors along the first edge and in the plane across it, and the height of the face.

    A face without area has height 0 and any direction across.
    """
    u = wp.vec3(1.0, 0.0, 0.0)
    if wp.length_sq(ab) > 0.0:
        u = wp.normalize(ab)
    elif wp.length_sq(ac) > 0.0:
        u = wp.normalize(ac)
    v = ac - wp.dot(u, ac) * u
    v = v - wp.dot(u, v) * u
    height = wp.length(v)
    if height <= 1.0e-6 * wp.length(ac):
        height = 0.0
        v = wp.vec3(0.0, 1.0, 0.0)
        if wp.abs(u[1]) > 0.7:
            v = wp.vec3(0.0, 0.0, 1.0)
        v = v - wp.dot(u, v) * u
    v = wp.normalize(v)
    v = wp.normalize(v - wp.dot(u, v) * u)  # across to the last digit, for needles
    return u, v, height


@no_type_check
@wp.kernel
def refit_leaves(
    start: int,
    verts: wp.array2d(dtype=wp.vec3),
    corners: wp.array2d(dtype=wp.int32),
    faces: wp.array(dtype=wp.int32),
    layout: wp.array2d(dtype=wp.int64),
    group: int,
    leaves: int,
    boxes: wp.array2d(dtype=wp.float32),
    tris: wp.array2d(dtype=wp.float32),
):
    """Write the triangles of one leaf of one body, and its box into its parent."""
    i = start + wp.tid()
    body = i // leaves
    leaf = i % leaves
    first_leaf = int(layout[group, 4])
    row = int(layout[group, 2] + wp.int64(body) * layout[group, 3]) + leaf * _FACE_ROWS
    slot = int(layout[group, 5]) + leaf * 8
    low = wp.vec3(_FAR, _FAR, _FAR)
    high = wp.vec3(-_FAR, -_FAR, -_FAR)
    for k in range(8):
        f = faces[slot + k]
        a = wp.vec3(_FAR, _FAR, _FAR)
        ab = wp.vec3(0.0, 0.0, 0.0)
        ac = wp.vec3(0.0, 0.0, 0.0)
        if f >= 0:
            a = verts[body, corners[f, 0]]
            b = verts[body, corners[f, 1]]
            c = verts[body, corners[f, 2]]
            ab = b - a
            ac = c - a
            low = wp.min(low, wp.min(a, wp.min(b, c)))
            high = wp.max(high, wp.max(a, wp.max(b, c)))
        u, v, height = frame_of(ab, ac)
        along = wp.vec3(wp.dot(u, ab), wp.dot(u, ac), height)
        for axis in range(3):
            tris[row + axis, k] = a[axis]
            tris[row + 3 + axis, k] = u[axis]
            tris[row + 6 + axis, k] = v[axis]
            tris[row + 9 + axis, k] = along[axis]
        gap = along[1] - along[0]
        tris[row + 12, k] = 1.0 / wp.max(along[1] * along[1] + height * height, 1.0e-30)
        tris[row + 13, k] = 1.0 / wp.max(gap * gap + height * height, 1.0e-30)
    if first_leaf > 0:
        first = layout[group, 0] + wp.int64(body) * layout[group, 1]
        put_box(boxes, first, first_leaf + leaf, low, high)


@no_type_check
@wp.kernel
def refit_nodes(
    start: int,
    layout: wp.array2d(dtype=wp.int64),
    group: int,
    first_node: int,
    nodes: int,
    boxes: wp.array2d(dtype=wp.float32),
):
    """Write the box of one inner node of one body into its parent, from those of its children."""
    i = start + wp.tid()
    body = i // nodes
    node = first_node + i % nodes
    first = layout[group, 0] + wp.int64(body) * layout[group, 1]
    row = int(first) + 6 * node
    low = wp.vec3(_FAR, _FAR, _FAR)
    high = wp.vec3(-_FAR, -_FAR, -_FAR)
    for k in range(8):
        low = wp.min(low, wp.vec3(boxes[row, k], boxes[row + 1, k], boxes[row + 2, k]))
        high = wp.max(high, wp.vec3(boxes[row + 3, k], boxes[row + 4, k], boxes[row + 5, k]))
    put_box(boxes, first, node, low, high)


@no_type_check
@wp.kernel
def closest_hits(
    start: int,
    points: wp.array(dtype=wp.vec3),
    verts: wp.array(dtype=wp.vec3),
    corners: wp.array2d(dtype=wp.int32),
    layout: wp.array2d(dtype=wp.int64),
    boxes: wp.array2d(dtype=wp.float32),
    tris: wp.array2d(dtype=wp.float32),
    faces: wp.array(dtype=wp.int32),
    reach: float,
    limit: float,
    face: wp.array(dtype=wp.int64),
    bary: wp.array(dtype=wp.vec3),
    point: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=wp.float32),
    found: wp.array(dtype=wp.bool),
):
    """Closest face of each point, and barycentrics, surface point and distance on it.

    The search goes to ``reach``; a face is found where the evaluated distance is at most ``limit``.
    """
    i = start + wp.tid()
    p = points[i]
    f = closest_in_tree(p, layout, boxes, tris, faces, 0, wp.int64(0), reach * reach)
    on = wp.max(f, 0)
    a = verts[corners[on, 0]]
    b = verts[corners[on, 1]]
    c = verts[corners[on, 2]]
    w = bary_on_triangle(p, a, b, c)
    q = a + (b - a) * w[1] + (c - a) * w[2]
    d = wp.length(p - q)
    ok = f >= 0 and d <= limit
    face[i] = wp.int64(wp.where(ok, on, 0))
    bary[i] = w
    point[i] = q
    distance[i] = wp.where(ok, d, wp.inf)
    found[i] = ok


@no_type_check
@wp.kernel
def closest_faces(
    start: int,
    points: wp.array(dtype=wp.vec3),
    layout: wp.array2d(dtype=wp.int64),
    boxes: wp.array2d(dtype=wp.float32),
    tris: wp.array2d(dtype=wp.float32),
    faces: wp.array(dtype=wp.int32),
    limit: float,
    face: wp.array(dtype=wp.int32),
):
    """Closest face of each point, -1 beyond the limit."""
    i = start + wp.tid()
    face[i] = closest_in_tree(points[i], layout, boxes, tris, faces, 0, wp.int64(0), limit * limit)
