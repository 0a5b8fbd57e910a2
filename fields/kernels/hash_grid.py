"""Warp kernels of the multiresolution hash grid.

One thread per point, levels looped inside. Tables, outputs and cotangents are read as vectors
of ``features`` floats. A mask of 0 marks a level that is stored densely. The time goes into waiting
for memory, so a thread asks for the rows of a level two levels before it needs them.
"""
# a kernel lists its arrays and is one body; int() and float() make Warp variables
# ruff: noqa: PLR0915

import functools
from typing import Any, no_type_check

import warp as wp

PRIME_Y = wp.constant(wp.uint32(2654435761))
PRIME_Z = wp.constant(wp.uint32(805459861))

_PREFETCH = """
#if !defined(__CUDA_ARCH__)
    __builtin_prefetch(table.data + j);
#endif
"""
_ROW = {1: wp.float32, 2: wp.vec2, 4: wp.vec4}


@no_type_check
@wp.func
def _clamp01(p: wp.vec3) -> wp.vec3:
    return wp.vec3(wp.clamp(p[0], 0.0, 1.0), wp.clamp(p[1], 0.0, 1.0), wp.clamp(p[2], 0.0, 1.0))


@no_type_check
@wp.func
def _part_of(part: wp.array(dtype=wp.int32), i: int, parts: int) -> int:
    """Return the part of point i; no part array means part 0."""
    k = int(0)
    if part.shape[0] > 0:
        k = wp.clamp(part[i], 0, parts - 1)
    return k


@no_type_check
@wp.struct
class Corners:
    """The table rows of a cell (named by z, y; x is a or b) and the position in the cell."""

    a00: int
    b00: int
    a01: int
    b01: int
    a10: int
    b10: int
    a11: int
    b11: int
    u: float
    v: float
    w: float


@no_type_check
@wp.func
def _corners(p: wp.vec3, res: int, mask: int, offset: int) -> Corners:
    px = p[0] * float(res)
    py = p[1] * float(res)
    pz = p[2] * float(res)
    # the last vertex belongs to the last cell; the clamp also keeps NaN inside the table
    x = wp.clamp(int(px), 0, res - 1)
    y = wp.clamp(int(py), 0, res - 1)
    z = wp.clamp(int(pz), 0, res - 1)
    c = Corners()
    c.u = px - float(x)
    c.v = py - float(y)
    c.w = pz - float(z)
    if mask == 0:
        n = res + 1
        n2 = n * n
        c.a00 = offset + x + y * n + z * n2
        c.a01 = c.a00 + n
        c.a10 = c.a00 + n2
        c.a11 = c.a10 + n
        c.b00 = c.a00 + 1
        c.b01 = c.a01 + 1
        c.b10 = c.a10 + 1
        c.b11 = c.a11 + 1
    else:
        m = wp.uint32(mask)
        x0 = wp.uint32(x)
        x1 = wp.uint32(x + 1)
        y0 = wp.uint32(y) * PRIME_Y
        y1 = y0 + PRIME_Y
        z0 = wp.uint32(z) * PRIME_Z
        z1 = z0 + PRIME_Z
        h00 = y0 ^ z0
        h01 = y1 ^ z0
        h10 = y0 ^ z1
        h11 = y1 ^ z1
        c.a00 = offset + int((x0 ^ h00) & m)
        c.b00 = offset + int((x1 ^ h00) & m)
        c.a01 = offset + int((x0 ^ h01) & m)
        c.b01 = offset + int((x1 ^ h01) & m)
        c.a10 = offset + int((x0 ^ h10) & m)
        c.b10 = offset + int((x1 ^ h10) & m)
        c.a11 = offset + int((x0 ^ h11) & m)
        c.b11 = offset + int((x1 ^ h11) & m)
    return c


@no_type_check
@wp.func
def _level(
    p: wp.vec3,
    k: int,
    l: int,
    offsets: wp.array2d(dtype=wp.int32),
    masks: wp.array2d(dtype=wp.int32),
    resolutions: wp.array2d(dtype=wp.int32),
) -> Corners:
    """Return the corners of point p in level l, or in the last level beyond it."""
    m = wp.min(l, offsets.shape[1] - 1)
    return _corners(p, resolutions[k, m], masks[k, m], offsets[k, m])


@no_type_check  # here, not on fetch, where it would hide the return type from Warp
@functools.cache
def _row_functions(features: int) -> tuple[Any, Any]:
    """Build ``fetch(table, row)`` and ``ask_ahead(table, corners)`` for contiguous tables."""
    row = _ROW[features]

    @wp.func_native("return table.data[j];")  # the generic access multiplies by a stride
    def fetch(table: wp.array(dtype=row), j: int) -> row: ...  # pyright: ignore

    @no_type_check
    @wp.func_native(_PREFETCH)
    def prefetch(table: wp.array(dtype=row), j: int): ...

    @no_type_check
    @wp.func
    def ask_ahead(table: wp.array(dtype=row), c: Corners):
        # x neighbours mostly share a cache line
        prefetch(table, c.a00)
        prefetch(table, c.a01)
        prefetch(table, c.a10)
        prefetch(table, c.a11)

    return fetch, ask_ahead


@functools.cache
def forward_kernel(features: int) -> Any:
    """Build the look-up for tables of ``features`` columns (1, 2 or 4)."""
    row = _ROW[features]
    fetch, ask_ahead = _row_functions(features)

    @no_type_check
    @wp.kernel(enable_backward=False, module="unique")
    def hash_grid_forward(
        start: int,
        points: wp.array(dtype=wp.vec3),
        part: wp.array(dtype=wp.int32),
        table: wp.array(dtype=row),
        offsets: wp.array2d(dtype=wp.int32),
        masks: wp.array2d(dtype=wp.int32),
        resolutions: wp.array2d(dtype=wp.int32),
        out: wp.array2d(dtype=row),
    ):
        i = start + wp.tid()
        p = _clamp01(points[i])
        k = _part_of(part, i, offsets.shape[0])
        c = _level(p, k, 0, offsets, masks, resolutions)
        c1 = _level(p, k, 1, offsets, masks, resolutions)
        for l in range(offsets.shape[1]):
            c2 = _level(p, k, l + 2, offsets, masks, resolutions)
            ask_ahead(table, c2)
            u = c.u
            s = 1.0 - u
            out[i, l] = (1.0 - c.w) * (
                (1.0 - c.v) * (s * fetch(table, c.a00) + u * fetch(table, c.b00))
                + c.v * (s * fetch(table, c.a01) + u * fetch(table, c.b01))
            ) + c.w * (
                (1.0 - c.v) * (s * fetch(table, c.a10) + u * fetch(table, c.b10))
                + c.v * (s * fetch(table, c.a11) + u * fetch(table, c.b11))
            )
            c = c1
            c1 = c2

    return hash_grid_forward


@functools.cache
def table_kernel(features: int, atomic: bool) -> Any:
    """Build the scatter of a cotangent into the table, for the levels first, first + step, ... .

    Without ``atomic`` (CPU) launches side by side must have disjoint levels: the sum is then taken
    in the order of the points, whatever the number of threads.
    """
    row = _ROW[features]
    _, ask_ahead = _row_functions(features)

    @no_type_check
    @wp.func_native("table.data[j] += value;")
    def add_plain(table: wp.array(dtype=row), j: int, value: row): ...

    @no_type_check
    @wp.func
    def add(table: wp.array(dtype=row), j: int, value: row):
        if wp.static(atomic):
            wp.atomic_add(table, j, value)
        else:
            add_plain(table, j, value)

    @no_type_check
    @wp.kernel(enable_backward=False, module="unique")
    def hash_grid_table_gradient(
        start: int,
        points: wp.array(dtype=wp.vec3),
        part: wp.array(dtype=wp.int32),
        offsets: wp.array2d(dtype=wp.int32),
        masks: wp.array2d(dtype=wp.int32),
        resolutions: wp.array2d(dtype=wp.int32),
        cotangent: wp.array2d(dtype=row),
        first: int,
        step: int,
        grad: wp.array(dtype=row),
    ):
        i = start + wp.tid()
        p = _clamp01(points[i])
        k = _part_of(part, i, offsets.shape[0])
        c = _level(p, k, first, offsets, masks, resolutions)
        c1 = _level(p, k, first + step, offsets, masks, resolutions)
        for l in range(first, offsets.shape[1], step):
            c2 = _level(p, k, l + 2 * step, offsets, masks, resolutions)
            ask_ahead(grad, c2)
            g = cotangent[i, l]
            g0 = (1.0 - c.w) * g
            g1 = c.w * g
            g00 = (1.0 - c.v) * g0
            g01 = c.v * g0
            g10 = (1.0 - c.v) * g1
            g11 = c.v * g1
            add(grad, c.a00, (1.0 - c.u) * g00)
            add(grad, c.b00, c.u * g00)
            add(grad, c.a01, (1.0 - c.u) * g01)
            add(grad, c.b01, c.u * g01)
            add(grad, c.a10, (1.0 - c.u) * g10)
            add(grad, c.b10, c.u * g10)
            add(grad, c.a11, (1.0 - c.u) * g11)
            add(grad, c.b11, c.u * g11)
            c = c1
            c1 = c2

    return hash_grid_table_gradient


@functools.cache
def points_kernel(features: int) -> Any:
    """Build the gradient of the look-up in the points."""
    row = _ROW[features]
    fetch, ask_ahead = _row_functions(features)

    @no_type_check
    @wp.func
    def dot(a: row, b: row) -> float:
        if wp.static(features == 1):
            return a * b
        else:
            return wp.dot(a, b)

    @no_type_check
    @wp.kernel(enable_backward=False, module="unique")
    def hash_grid_points_gradient(
        start: int,
        points: wp.array(dtype=wp.vec3),
        part: wp.array(dtype=wp.int32),
        table: wp.array(dtype=row),
        offsets: wp.array2d(dtype=wp.int32),
        masks: wp.array2d(dtype=wp.int32),
        resolutions: wp.array2d(dtype=wp.int32),
        cotangent: wp.array2d(dtype=row),
        grad: wp.array(dtype=wp.vec3),
    ):
        i = start + wp.tid()
        raw = points[i]
        p = _clamp01(raw)
        k = _part_of(part, i, offsets.shape[0])
        gx = float(0.0)
        gy = float(0.0)
        gz = float(0.0)
        c = _level(p, k, 0, offsets, masks, resolutions)
        c1 = _level(p, k, 1, offsets, masks, resolutions)
        for l in range(offsets.shape[1]):
            c2 = _level(p, k, l + 2, offsets, masks, resolutions)
            ask_ahead(table, c2)
            g = cotangent[i, l]
            a00 = dot(fetch(table, c.a00), g)
            b00 = dot(fetch(table, c.b00), g)
            a01 = dot(fetch(table, c.a01), g)
            b01 = dot(fetch(table, c.b01), g)
            a10 = dot(fetch(table, c.a10), g)
            b10 = dot(fetch(table, c.b10), g)
            a11 = dot(fetch(table, c.a11), g)
            b11 = dot(fetch(table, c.b11), g)
            u = c.u
            v = c.v
            w = c.w
            s = 1.0 - u
            t = 1.0 - v
            r = 1.0 - w
            e00 = s * a00 + u * b00
            e01 = s * a01 + u * b01
            e10 = s * a10 + u * b10
            e11 = s * a11 + u * b11
            scale = float(resolutions[k, l])
            gx += scale * (
                r * (t * (b00 - a00) + v * (b01 - a01)) + w * (t * (b10 - a10) + v * (b11 - a11))
            )
            gy += scale * (r * (e01 - e00) + w * (e11 - e10))
            gz += scale * (t * (e10 - e00) + v * (e11 - e01))
            c = c1
            c1 = c2
        # outside [0, 1] the look-up is constant
        if raw[0] < 0.0 or raw[0] > 1.0:
            gx = 0.0
        if raw[1] < 0.0 or raw[1] > 1.0:
            gy = 0.0
        if raw[2] < 0.0 or raw[2] > 1.0:
            gz = 0.0
        grad[i] = wp.vec3(gx, gy, gz)

    return hash_grid_points_gradient
