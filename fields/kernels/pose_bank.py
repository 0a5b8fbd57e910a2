"""Warp kernels of the pose bank: points looked up on weighted means of lines of key poses.

One thread per point, axes and key poses inside. Lines are [part, key pose, axis, knot, channel]; a
key pose of weight 0 is not read.
"""
# a kernel lists its arrays and is one body; Warp reads the annotations

# pyright: reportInvalidTypeForm=false

import functools
from typing import Any, no_type_check

import warp as wp

_WALK = """
    const int k = part.data[i], count = rows.shape[1], knots = shape.data[1];
    const long long line = (long long)knots * CHANNELS;
    const long long owner = (long long)body.data[i] * shape.data[2] + k;
    for (int a = 0; a < 3; a++) {
        const float at = place.data[3 * (long long)i + a];
        int cell = (int)at;
        cell = cell > knots - 2 ? knots - 2 : cell;
        cell = cell < 0 ? 0 : cell;  // NaN stays inside the line
        const float far = at - (float)cell;
        const long long to = (3 * (long long)i + a) * CHANNELS;
        BEGIN
        for (int m = 0; m < count; m++) {
            const int pose = rows.data[owner * count + m];
            const float share = weights.data[owner * count + m];
            if (share == 0.0f SKIP) continue;
            const long long from = ((long long)(k * shape.data[0] + pose) * 3 + a) * line
                + (long long)cell * CHANNELS;
            STEP
        }
        END
    }
"""
_LOOK_UP = {
    "BEGIN": "float found[CHANNELS]; for (int c = 0; c < CHANNELS; c++) found[c] = 0.0f;",
    "SKIP": "",
    "STEP": """
            const float* __restrict__ near = lines.data + from;
            for (int c = 0; c < CHANNELS; c++)
                found[c] += share * (near[c] + far * (near[c + CHANNELS] - near[c]));
    """,
    "END": "for (int c = 0; c < CHANNELS; c++) out.data[to + c] = found[c];",
}
_SCATTER = {
    "BEGIN": "const float* __restrict__ g = cotangent.data + to;",
    "SKIP": "|| pose % step != first",
    "STEP": """
            float* __restrict__ q = grad.data + from;
            const float more = share * far, less = share - more;
            for (int c = 0; c < CHANNELS; c++) {
#if defined(__CUDA_ARCH__)
                atomicAdd(q + c, less * g[c]);
                atomicAdd(q + c + CHANNELS, more * g[c]);
#else
                q[c] += less * g[c];
                q[c + CHANNELS] += more * g[c];
#endif
            }
    """,
    "END": "",
}


def _native(inserts: dict[str, str], channels: int) -> str:
    text = _WALK
    for name, insert in inserts.items():
        text = text.replace(name, insert)
    return text.replace("CHANNELS", str(channels))


@no_type_check
@functools.cache
def bank_kernel(channels: int) -> Any:
    """Build the look-up on lines of ``channels`` features; shape is (poses, knots, parts)."""

    @no_type_check
    @wp.func_native(_native(_LOOK_UP, channels))
    def look_up(
        i: int,
        place: wp.array(dtype=wp.float32),
        part: wp.array(dtype=wp.int32),
        body: wp.array(dtype=wp.int32),
        rows: wp.array2d(dtype=wp.int32),
        weights: wp.array(dtype=wp.float32),
        shape: wp.array(dtype=wp.int32),
        lines: wp.array(dtype=wp.float32),
        out: wp.array(dtype=wp.float32),
    ): ...

    @no_type_check
    @wp.kernel(enable_backward=False, module="unique")
    def pose_bank_forward(
        start: int,
        place: wp.array(dtype=wp.float32),
        part: wp.array(dtype=wp.int32),
        body: wp.array(dtype=wp.int32),
        rows: wp.array2d(dtype=wp.int32),
        weights: wp.array(dtype=wp.float32),
        shape: wp.array(dtype=wp.int32),
        lines: wp.array(dtype=wp.float32),
        out: wp.array(dtype=wp.float32),
    ):
        look_up(start + wp.tid(), place, part, body, rows, weights, shape, lines, out)

    return pose_bank_forward


@no_type_check
@functools.cache
def bank_gradient_kernel(channels: int) -> Any:
    """Build the scatter into the lines, for the key poses first, first + step, ... .

    On the CPU launches side by side must have disjoint key poses: the sum is then taken in the
    order of the points, whatever the number of threads. On CUDA the sums are atomic.
    """

    @no_type_check
    @wp.func_native(_native(_SCATTER, channels))
    def scatter(
        i: int,
        place: wp.array(dtype=wp.float32),
        part: wp.array(dtype=wp.int32),
        body: wp.array(dtype=wp.int32),
        rows: wp.array2d(dtype=wp.int32),
        weights: wp.array(dtype=wp.float32),
        shape: wp.array(dtype=wp.int32),
        cotangent: wp.array(dtype=wp.float32),
        first: int,
        step: int,
        grad: wp.array(dtype=wp.float32),
    ): ...

    @no_type_check
    @wp.kernel(enable_backward=False, module="unique")
    def pose_bank_gradient(
        start: int,
        place: wp.array(dtype=wp.float32),
        part: wp.array(dtype=wp.int32),
        body: wp.array(dtype=wp.int32),
        rows: wp.array2d(dtype=wp.int32),
        weights: wp.array(dtype=wp.float32),
        shape: wp.array(dtype=wp.int32),
        cotangent: wp.array(dtype=wp.float32),
        first: int,
        step: int,
        grad: wp.array(dtype=wp.float32),
    ):
        i = start + wp.tid()
        scatter(i, place, part, body, rows, weights, shape, cotangent, first, step, grad)

    return pose_bank_gradient
