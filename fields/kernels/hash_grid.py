"""Warp kernels of the multiresolution hash grid.

One thread per point, levels inside. Tables, outputs and cotangents are read as rows of ``features``
floats. A mask of 0 marks a level that is stored densely. The rows of all levels of a point are
computed before the first one is read: that loop becomes vector instructions, and the loads of all
levels wait for memory at the same time.
"""
# a kernel lists its arrays and is one body; int() and float() make Warp variables

# pyright: reportInvalidTypeForm=false

import functools
from typing import Any, no_type_check

import warp as wp

# Rows of all levels of a point first, then the look-ups: the loop over levels becomes vector
# instructions on the CPU, and every load is known before the first one is waited for.
_ROWS = """
#if defined(__CUDA_ARCH__)
    const int W = 1;  // a GPU keeps one level in registers
#else
    const int W = 16;
#endif
    const int levels = offsets.shape[1];
    const int* offset_of = offsets.data + k * levels;
    const int* mask_of = masks.data + k * levels;
    const int* cells_of = resolutions.data + k * levels;
    int row[8][W];
    float u[W], v[W], w[W];
    int at[W], mask[W], cells[W];
    for (int begin = first; begin < levels; begin += W * step) {
        int n = 0;
        for (int l = begin; l < levels && n < W; l += step, n++) {
            at[n] = offset_of[l]; mask[n] = mask_of[l]; cells[n] = cells_of[l];
        }
        for (int j = 0; j < n; j++) {
            const int last = cells[j] - 1;
            const float px = p[0] * (float)cells[j];
            const float py = p[1] * (float)cells[j];
            const float pz = p[2] * (float)cells[j];
            int x = (int)px, y = (int)py, z = (int)pz;
            // the last vertex belongs to the last cell; the clamp also keeps NaN inside the table
            x = x > last ? last : x; x = x < 0 ? 0 : x;
            y = y > last ? last : y; y = y < 0 ? 0 : y;
            z = z > last ? last : z; z = z < 0 ? 0 : z;
            u[j] = px - (float)x; v[j] = py - (float)y; w[j] = pz - (float)z;
            const unsigned m = (unsigned)mask[j];
            const unsigned x0 = (unsigned)x, x1 = x0 + 1u;
            const unsigned y0 = (unsigned)y * 2654435761u, y1 = y0 + 2654435761u;
            const unsigned z0 = (unsigned)z * 805459861u, z1 = z0 + 805459861u;
            const int side = cells[j] + 1;
            const int d = x + side * (y + side * z);
            const int dz = side * side;
            const bool dense = mask[j] == 0;
            row[0][j] = at[j] + (dense ? d : (int)((x0 ^ y0 ^ z0) & m));
            row[1][j] = at[j] + (dense ? d + 1 : (int)((x1 ^ y0 ^ z0) & m));
            row[2][j] = at[j] + (dense ? d + side : (int)((x0 ^ y1 ^ z0) & m));
            row[3][j] = at[j] + (dense ? d + side + 1 : (int)((x1 ^ y1 ^ z0) & m));
            row[4][j] = at[j] + (dense ? d + dz : (int)((x0 ^ y0 ^ z1) & m));
            row[5][j] = at[j] + (dense ? d + dz + 1 : (int)((x1 ^ y0 ^ z1) & m));
            row[6][j] = at[j] + (dense ? d + dz + side : (int)((x0 ^ y1 ^ z1) & m));
            row[7][j] = at[j] + (dense ? d + dz + side + 1 : (int)((x1 ^ y1 ^ z1) & m));
        }
        for (int j = 0; j < n; j++) {
            const long long place = ((long long)i * levels + begin + j * step) * FEATURES;
            const float s = 1.0f - u[j], t = 1.0f - v[j], r = 1.0f - w[j];
            LEVEL
        }
    }
"""
_LOOK_UP = """
            const float* from = (const float*)table.data;
            float* to = (float*)out.data + place;
            const float* c0 = from + (long long)row[0][j] * FEATURES;
            const float* c1 = from + (long long)row[1][j] * FEATURES;
            const float* c2 = from + (long long)row[2][j] * FEATURES;
            const float* c3 = from + (long long)row[3][j] * FEATURES;
            const float* c4 = from + (long long)row[4][j] * FEATURES;
            const float* c5 = from + (long long)row[5][j] * FEATURES;
            const float* c6 = from + (long long)row[6][j] * FEATURES;
            const float* c7 = from + (long long)row[7][j] * FEATURES;
            for (int f = 0; f < FEATURES; f++) {
                const float e00 = s * c0[f] + u[j] * c1[f], e01 = s * c2[f] + u[j] * c3[f];
                const float e10 = s * c4[f] + u[j] * c5[f], e11 = s * c6[f] + u[j] * c7[f];
                to[f] = r * (t * e00 + v[j] * e01) + w[j] * (t * e10 + v[j] * e11);
            }
"""
_SCATTER = """
            const float* g = (const float*)cotangent.data + place;
            float* to = (float*)grad.data;
            const float share[8] = {
                s * t * r, u[j] * t * r, s * v[j] * r, u[j] * v[j] * r,
                s * t * w[j], u[j] * t * w[j], s * v[j] * w[j], u[j] * v[j] * w[j]};
            for (int c = 0; c < 8; c++) {
                float* q = to + (long long)row[c][j] * FEATURES;
                for (int f = 0; f < FEATURES; f++) {
#if defined(__CUDA_ARCH__)
                    atomicAdd(q + f, share[c] * g[f]);
#else
                    q[f] += share[c] * g[f];
#endif
                }
            }
"""
_SLOPE = """
            const float* g = (const float*)cotangent.data + place;
            const float* from = (const float*)table.data;
            float a[8];
            for (int c = 0; c < 8; c++) {
                const float* q = from + (long long)row[c][j] * FEATURES;
                float dot = 0.0f;
                for (int f = 0; f < FEATURES; f++) dot += q[f] * g[f];
                a[c] = dot;
            }
            const float scale = (float)cells[j];
            const float e00 = s * a[0] + u[j] * a[1], e01 = s * a[2] + u[j] * a[3];
            const float e10 = s * a[4] + u[j] * a[5], e11 = s * a[6] + u[j] * a[7];
            gx += scale * (r * (t * (a[1] - a[0]) + v[j] * (a[3] - a[2]))
                + w[j] * (t * (a[5] - a[4]) + v[j] * (a[7] - a[6])));
            gy += scale * (r * (e01 - e00) + w[j] * (e11 - e10));
            gz += scale * (t * (e10 - e00) + v[j] * (e11 - e01));
"""
_SLOPES = (
    "float gx = 0.0f, gy = 0.0f, gz = 0.0f;"
    + _ROWS.replace("LEVEL", _SLOPE)
    + "return wp::vec_t<3, float>(gx, gy, gz);"
)
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


def _native(text: str, features: int) -> str:
    return text.replace("FEATURES", str(features))


@no_type_check
@functools.cache
def forward_kernel(features: int) -> Any:
    """Build the look-up for tables of ``features`` columns (1, 2 or 4)."""
    row = _ROW[features]

    @no_type_check
    @wp.func_native(_native(_ROWS.replace("LEVEL", _LOOK_UP), features))
    def look_up(
        p: wp.vec3,
        k: int,
        i: int,
        first: int,
        step: int,
        table: wp.array(dtype=row),
        offsets: wp.array2d(dtype=wp.int32),
        masks: wp.array2d(dtype=wp.int32),
        resolutions: wp.array2d(dtype=wp.int32),
        out: wp.array2d(dtype=row),
    ): ...

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
        look_up(p, k, i, 0, 1, table, offsets, masks, resolutions, out)

    return hash_grid_forward


@no_type_check
@functools.cache
def table_kernel(features: int) -> Any:
    """Build the scatter of a cotangent into the table, for the levels first, first + step, ... .

    On the CPU launches side by side must have disjoint levels: the sum is then taken in the order
    of the points, whatever the number of threads. On CUDA the sums are atomic.
    """
    row = _ROW[features]

    @no_type_check
    @wp.func_native(_native(_ROWS.replace("LEVEL", _SCATTER), features))
    def scatter(
        p: wp.vec3,
        k: int,
        i: int,
        first: int,
        step: int,
        grad: wp.array(dtype=row),
        offsets: wp.array2d(dtype=wp.int32),
        masks: wp.array2d(dtype=wp.int32),
        resolutions: wp.array2d(dtype=wp.int32),
        cotangent: wp.array2d(dtype=row),
    ): ...

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
        scatter(p, k, i, first, step, grad, offsets, masks, resolutions, cotangent)

    return hash_grid_table_gradient


@no_type_check
@functools.cache
def points_kernel(features: int) -> Any:
    """Build the gradient of the look-up in the points."""
    row = _ROW[features]

    @wp.func_native(_native(_SLOPES, features))
    def slopes(
        p: wp.vec3,
        k: int,
        i: int,
        first: int,
        step: int,
        table: wp.array(dtype=row),
        offsets: wp.array2d(dtype=wp.int32),
        masks: wp.array2d(dtype=wp.int32),
        resolutions: wp.array2d(dtype=wp.int32),
        cotangent: wp.array2d(dtype=row),
    ) -> wp.vec3: ...

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
        g = slopes(p, k, i, 0, 1, table, offsets, masks, resolutions, cotangent)
        # outside [0, 1] the look-up is constant
        for axis in range(3):
            if raw[axis] < 0.0 or raw[axis] > 1.0:
                g[axis] = 0.0
        grad[i] = g

    return hash_grid_points_gradient
