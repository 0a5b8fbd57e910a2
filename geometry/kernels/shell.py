"""Warp kernels of the body shell: voxels near the surface, and ray samples inside them."""

from typing import no_type_check

import warp as wp

wp.set_module_options({"enable_backward": False})  # gradients are kernels of their own


@no_type_check
@wp.func
def voxel_of(p: wp.vec3, lo: wp.vec3, dims: wp.vec3i, inverse_voxel: float):
    """Flat index of the voxel that holds a point, or -1 outside the grid."""
    x = int(wp.floor((p[0] - lo[0]) * inverse_voxel))
    y = int(wp.floor((p[1] - lo[1]) * inverse_voxel))
    z = int(wp.floor((p[2] - lo[2]) * inverse_voxel))
    if x < 0 or y < 0 or z < 0 or x >= dims[0] or y >= dims[1] or z >= dims[2]:
        return -1
    return (z * dims[1] + y) * dims[0] + x


@no_type_check
@wp.kernel
def splat_bodies(
    start: int,
    verts: wp.array2d(dtype=wp.vec3),
    vertex_mask: wp.array(dtype=wp.int32),
    reach: wp.array(dtype=wp.float32),
    lo: wp.array(dtype=wp.vec3),
    dims: wp.array(dtype=wp.vec3i),
    offset: wp.array(dtype=wp.int64),
    voxel: float,
    grid: wp.array(dtype=wp.int32),
    share: int,
):
    """Set the part bits of every voxel whose centre lies within ``reach`` of a vertex.

    An item is ``share`` vertices of a body. On the CPU, where ``atomic_or`` is a plain one, that
    must be all of them, so that no two threads write to the same voxel.
    """
    i = start + wp.tid()
    items = (verts.shape[1] + share - 1) // share
    b = i // items
    first = (i % items) * share
    base = offset[b]
    n = dims[b]
    origin = lo[b]
    inverse = 1.0 / voxel
    for v in range(first, wp.min(first + share, verts.shape[1])):
        p = (verts[b, v] - origin) * inverse - wp.vec3(0.5, 0.5, 0.5)
        r = reach[v] * inverse
        bits = vertex_mask[v]
        z0 = wp.max(int(wp.ceil(p[2] - r)), 0)
        z1 = wp.min(int(wp.floor(p[2] + r)), n[2] - 1)
        for z in range(z0, z1 + 1):
            dz = float(z) - p[2]
            rz = r * r - dz * dz
            if rz >= 0.0:
                ry = wp.sqrt(rz)
                y0 = wp.max(int(wp.ceil(p[1] - ry)), 0)
                y1 = wp.min(int(wp.floor(p[1] + ry)), n[1] - 1)
                for y in range(y0, y1 + 1):
                    dy = float(y) - p[1]
                    rx = wp.sqrt(wp.max(rz - dy * dy, 0.0))
                    x0 = wp.max(int(wp.ceil(p[0] - rx)), 0)
                    x1 = wp.min(int(wp.floor(p[0] + rx)), n[0] - 1)
                    row = base + wp.int64((z * n[1] + y) * n[0])
                    for x in range(x0, x1 + 1):
                        wp.atomic_or(grid, int(row) + x, bits)


@no_type_check
@wp.func
def slab(o: float, d: float, lo: float, hi: float, span: wp.vec2):
    """Clip the interval ``span`` of a ray by one pair of planes."""
    if wp.abs(d) < 1.0e-12:
        if o < lo or o > hi:
            return wp.vec2(1.0, 0.0)
        return span
    a = (lo - o) / d
    b = (hi - o) / d
    return wp.vec2(wp.max(span[0], wp.min(a, b)), wp.min(span[1], wp.max(a, b)))


@no_type_check
@wp.func
def span_of(o: wp.vec3, d: wp.vec3, lo: wp.vec3, n: wp.vec3i, voxel: float):
    """Interval of a ray inside a grid; empty when its end is before its start.

    A ray without a direction, or with one that is NaN, meets nothing: it would never leave.
    """
    if not (wp.dot(d, d) > 1.0e-12):
        return wp.vec2(1.0, 0.0)
    span = wp.vec2(0.0, 1.0e30)
    span = slab(o[0], d[0], lo[0], lo[0] + float(n[0]) * voxel, span)
    span = slab(o[1], d[1], lo[1], lo[1] + float(n[1]) * voxel, span)
    return slab(o[2], d[2], lo[2], lo[2] + float(n[2]) * voxel, span)


@no_type_check
@wp.kernel
def count_samples(
    start: int,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    body: wp.array(dtype=wp.int32),
    jitter: wp.array(dtype=wp.float32),
    step: float,
    lo: wp.array(dtype=wp.vec3),
    dims: wp.array(dtype=wp.vec3i),
    offset: wp.array(dtype=wp.int64),
    voxel: float,
    grid: wp.array(dtype=wp.int32),
    count: wp.array(dtype=wp.int32),
    dense: wp.array(dtype=wp.int32),
):
    """Samples of each ray that lie in occupied voxels, and those that lie in the box at all."""
    i = start + wp.tid()
    b = body[i]
    o = origins[i]
    d = directions[i]
    span = span_of(o, d, lo[b], dims[b], voxel)
    inverse = 1.0 / voxel
    kept = int(0)
    total = int(0)
    if span[1] > span[0]:
        first = int(wp.ceil(span[0] / step - jitter[i]))
        last = int(wp.floor(span[1] / step - jitter[i]))
        total = wp.max(last - first + 1, 0)
        for s in range(first, last + 1):
            t = (float(s) + jitter[i]) * step
            cell = voxel_of(o + d * t, lo[b], dims[b], inverse)
            if cell >= 0:
                if grid[offset[b] + wp.int64(cell)] != 0:
                    kept += 1
    count[i] = kept
    dense[i] = total


@no_type_check
@wp.kernel
def fill_samples(
    start: int,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    body: wp.array(dtype=wp.int32),
    jitter: wp.array(dtype=wp.float32),
    step: float,
    lo: wp.array(dtype=wp.vec3),
    dims: wp.array(dtype=wp.vec3i),
    offset: wp.array(dtype=wp.int64),
    voxel: float,
    grid: wp.array(dtype=wp.int32),
    ray_start: wp.array(dtype=wp.int64),
    points: wp.array(dtype=wp.vec3),
    depth: wp.array(dtype=wp.float32),
    ray: wp.array(dtype=wp.int32),
    sample_body: wp.array(dtype=wp.int32),
    candidates: wp.array(dtype=wp.int32),
):
    """Write the samples that ``count_samples`` counted, front to back, ray after ray."""
    i = start + wp.tid()
    b = body[i]
    o = origins[i]
    d = directions[i]
    span = span_of(o, d, lo[b], dims[b], voxel)
    inverse = 1.0 / voxel
    if span[1] > span[0]:
        at = ray_start[i]
        first = int(wp.ceil(span[0] / step - jitter[i]))
        last = int(wp.floor(span[1] / step - jitter[i]))
        for s in range(first, last + 1):
            t = (float(s) + jitter[i]) * step
            p = o + d * t
            cell = voxel_of(p, lo[b], dims[b], inverse)
            if cell >= 0:
                bits = grid[offset[b] + wp.int64(cell)]
                if bits != 0:
                    points[at] = p
                    depth[at] = t
                    ray[at] = i
                    sample_body[at] = b
                    candidates[at] = bits
                    at += wp.int64(1)


@no_type_check
@wp.func
def cell_at(p: wp.vec3, n: wp.vec3i):
    """Voxel of a point in voxel units, clamped to the grid."""
    return wp.vec3i(
        wp.clamp(int(wp.floor(p[0])), 0, n[0] - 1),
        wp.clamp(int(wp.floor(p[1])), 0, n[1] - 1),
        wp.clamp(int(wp.floor(p[2])), 0, n[2] - 1),
    )


@no_type_check
@wp.func
def exit_of(o: float, d: float, lo: float, voxel: float, cell: int):
    """Distance at which a ray leaves the slab of a voxel along one axis."""
    if wp.abs(d) < 1.0e-12:
        return 1.0e30
    if d > 0.0:
        return (lo + float(cell + 1) * voxel - o) / d
    return (lo + float(cell) * voxel - o) / d


@no_type_check
@wp.func
def axis_of_least(v: wp.vec3):
    """Index of the smallest component, the first of equals."""
    if v[0] <= v[1] and v[0] <= v[2]:
        return 0
    if v[1] <= v[2]:
        return 1
    return 2


@no_type_check
@wp.kernel
def ray_intervals(
    start: int,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    body: wp.array(dtype=wp.int32),
    lo: wp.array(dtype=wp.vec3),
    dims: wp.array(dtype=wp.vec3i),
    offset: wp.array(dtype=wp.int64),
    voxel: float,
    grid: wp.array(dtype=wp.int32),
    near: wp.array(dtype=wp.float32),
    far: wp.array(dtype=wp.float32),
    hit: wp.array(dtype=wp.bool),
):
    """First and last distance at which a ray is inside an occupied voxel, by grid traversal.

    Amanatides and Woo, A Fast Voxel Traversal Algorithm for Ray Tracing, 1987; the planes are
    computed from the voxel's index and not summed up, so that no error accumulates.
    """
    i = start + wp.tid()
    b = body[i]
    o = origins[i]
    d = directions[i]
    n = dims[b]
    corner = lo[b]
    span = span_of(o, d, corner, n, voxel)
    found = bool(False)
    first = float(0.0)
    last = float(0.0)
    if span[1] > span[0]:
        cell = cell_at((o + d * span[0] - corner) / voxel, n)
        leaves = wp.vec3(
            exit_of(o[0], d[0], corner[0], voxel, cell[0]),
            exit_of(o[1], d[1], corner[1], voxel, cell[1]),
            exit_of(o[2], d[2], corner[2], voxel, cell[2]),
        )
        t = span[0]
        inside = bool(True)
        while inside:
            axis = axis_of_least(leaves)
            leave = wp.max(wp.min(leaves[axis], span[1]), t)
            if grid[offset[b] + wp.int64((cell[2] * n[1] + cell[1]) * n[0] + cell[0])] != 0:
                if not found:
                    first = t
                    found = True
                last = leave
            t = leave
            cell[axis] = cell[axis] + wp.where(d[axis] > 0.0, 1, -1)
            leaves[axis] = exit_of(o[axis], d[axis], corner[axis], voxel, cell[axis])
            inside = cell[axis] >= 0 and cell[axis] < n[axis] and t < span[1]
    near[i] = first
    far[i] = last
    hit[i] = found


@no_type_check
@wp.kernel
def look_up(
    start: int,
    points: wp.array(dtype=wp.vec3),
    body: wp.array(dtype=wp.int32),
    lo: wp.array(dtype=wp.vec3),
    dims: wp.array(dtype=wp.vec3i),
    offset: wp.array(dtype=wp.int64),
    voxel: float,
    grid: wp.array(dtype=wp.int32),
    bits: wp.array(dtype=wp.int32),
):
    """Part bits of the voxel of each point, 0 outside."""
    i = start + wp.tid()
    b = body[i]
    cell = voxel_of(points[i], lo[b], dims[b], 1.0 / voxel)
    value = int(0)
    if cell >= 0:
        value = grid[offset[b] + wp.int64(cell)]
    bits[i] = value
