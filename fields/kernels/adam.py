"""Warp kernel of Adam over the table rows that received a gradient, one pass over memory."""

import functools
from typing import Any, no_type_check

import warp as wp

_ROW = {1: wp.float32, 2: wp.vec2, 3: wp.vec3, 4: wp.vec4}
# Most rows are only looked at, eight at a time (a cache line of pairs); what a group 16 ahead will
# need is asked for early, since the touched rows lie scattered over memory.
_NEXT = """
    const unsigned* g = (const unsigned*)grad.data;
    while (i < end) {
        if (i % 8 == 0) {
            if (i + 136 <= end) {
                unsigned ahead = 0;
                for (unsigned f = 0; f < 8 * FEATURES; ++f) ahead |= g[(i + 128) * FEATURES + f];
                if (ahead << 1) {
                    PREFETCH
                }
            }
            if (i + 8 <= end) {
                unsigned bits = 0;
                for (unsigned f = 0; f < 8 * FEATURES; ++f) bits |= g[i * FEATURES + f];
                if (!(bits << 1)) { i += 8; continue; }
            }
        }
        unsigned own = 0;
        for (unsigned f = 0; f < FEATURES; ++f) own |= g[i * FEATURES + f];
        if (own << 1) break;
        ++i;
    }
    return i;
"""
_PREFETCH = """
#if !defined(__CUDA_ARCH__)
                    __builtin_prefetch(table.data + i + 128, 1);
                    __builtin_prefetch(mean.data + i + 128, 1);
                    __builtin_prefetch(square.data + i + 128, 1);
                    __builtin_prefetch(seen.data + i + 128, 1);
#endif
"""


@no_type_check  # here, not on fetch, where it would hide the return type from Warp
@functools.cache
def _row_functions(features: int) -> tuple[Any, ...]:
    """Build what finds, reads, writes and computes rows of ``features`` columns."""
    row = _ROW[features]
    snippet = _NEXT.replace("FEATURES", str(features)).replace("PREFETCH", _PREFETCH)

    @wp.func_native(snippet)
    def next_touched(
        grad: wp.array(dtype=row),  # pyright: ignore
        table: wp.array(dtype=row),  # pyright: ignore
        mean: wp.array(dtype=row),  # pyright: ignore
        square: wp.array(dtype=row),  # pyright: ignore
        seen: wp.array(dtype=wp.int32),  # pyright: ignore
        i: int,
        end: int,
    ) -> int: ...

    @wp.func_native("return a.data[j];")
    def fetch(a: wp.array(dtype=row), j: int) -> row: ...  # pyright: ignore

    @no_type_check
    @wp.func_native("a.data[j] = value;")
    def put(a: wp.array(dtype=row), j: int, value: row): ...

    @no_type_check
    @wp.func
    def ratio(m: row, s: row, root: float, eps: float) -> row:
        """Return mean / (root mean square + eps) by component, 0 where nothing was seen."""
        if wp.static(features == 1):
            return m / (wp.sqrt(s) * root + eps)
        else:
            out = row()
            for f in range(wp.static(features)):
                out[f] = m[f] / (wp.sqrt(s[f]) * root + eps)
            return out

    @no_type_check
    @wp.func
    def squared(g: row) -> row:
        if wp.static(features == 1):
            return g * g
        else:
            return wp.cw_mul(g, g)

    return next_touched, fetch, put, ratio, squared


@functools.cache
def row_adam_kernel(features: int) -> Any:
    """Build the step for tables of ``features`` columns, 1 to 4.

    ``decay[gap]`` holds, for a row that rested ``gap`` steps, the factors of its two moments and
    the sum of the movements it missed, in units of rate · mean / root mean square.
    """
    row = _ROW[features]
    next_touched, fetch, put, ratio, squared = _row_functions(features)

    @no_type_check
    @wp.kernel(enable_backward=False, module="unique")
    def row_adam(
        start: int,
        rows: int,
        block: int,
        now: int,
        rate: float,
        root: float,
        eps: float,
        beta1: float,
        beta2: float,
        decay: wp.array(dtype=wp.vec3),
        grad: wp.array(dtype=row),
        table: wp.array(dtype=row),
        mean: wp.array(dtype=row),
        square: wp.array(dtype=row),
        seen: wp.array(dtype=wp.int32),
    ):
        first = (start + wp.tid()) * block
        end = wp.min(first + block, rows)
        i = next_touched(grad, table, mean, square, seen, first, end)
        while i < end:
            gap = wp.min(now - seen[i] - 1, decay.shape[0] - 1)
            seen[i] = now
            g = fetch(grad, i)
            m = fetch(mean, i)
            s = fetch(square, i)
            p = fetch(table, i)
            if gap > 0:
                past = decay[gap]
                p = p - (rate * past[2]) * ratio(m, s, root, eps)
                m = past[0] * m
                s = past[1] * s
            m = beta1 * m + (1.0 - beta1) * g
            s = beta2 * s + (1.0 - beta2) * squared(g)
            put(table, i, p - rate * ratio(m, s, root, eps))
            put(mean, i, m)
            put(square, i, s)
            put(grad, i, 0.0 * p)
            i = next_touched(grad, table, mean, square, seen, i + 1, end)

    return row_adam
