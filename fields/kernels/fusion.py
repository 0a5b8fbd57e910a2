"""Warp kernels of the attention of samples over the codes of their part.

One thread per sample, heads inside. On the CPU eight codes make one vector; the backward pass makes
the weights again, relative to the best score as the forward pass does: the logarithm of their sum
would be rounded like a score. Keys and values are [part, head, d, code]. Codes are padded to a
multiple of 16; the bias of a padded code is so low that its weight counts for nothing.
"""
# a kernel lists its arrays and is one body; Warp reads the annotations

# pyright: reportInvalidTypeForm=false

import functools
from typing import Any, no_type_check

import warp as wp

_SHARED = """
#if defined(__CUDA_ARCH__)
    typedef float V;  // a GPU has lanes of its own
    const int W = 1;
    #define FUSION_INT(x) ((int)(x))
    #define FUSION_FLOAT(n) ((float)(n))
    #define FUSION_POWER(n) __int_as_float(((n) + 127) << 23)
    #define FUSION_SUM(x) (x)
    #define FUSION_ADD(to, x) atomicAdd(to, x)
#else
    typedef float V __attribute__((vector_size(32), aligned(4), may_alias));
    typedef int N __attribute__((vector_size(32)));
    const int W = 8;
    #define FUSION_INT(x) __builtin_convertvector(x, N)
    #define FUSION_FLOAT(n) __builtin_convertvector(n, V)
    #define FUSION_POWER(n) ((V)(((n) + 127) << 23))
    #define FUSION_SUM(x) ((x[0] + x[4]) + (x[1] + x[5]) + ((x[2] + x[6]) + (x[3] + x[7])))
    #define FUSION_ADD(to, x) *(V*)(to) += x
#endif
    // exp: 2^n by the bits of the exponent, the rest by a polynomial on ±ln 2 / 2
    #define FUSION_EXP(p, x) { \\
        V t = (x) * 1.44269504f; \\
        t = t < -126.0f ? t * 0.0f - 126.0f : t; \\
        const auto whole_t = FUSION_INT(t - 0.5f); \\
        const V f = (t - FUSION_FLOAT(whole_t)) * 0.693147181f; \\
        p = 1.0f + f * (1.0f + f * (0.5f + f * (0.166666667f + f * (0.0416666667f \\
            + f * (0.00833333333f + f * 0.00138888889f))))); \\
        p *= FUSION_POWER(whole_t); }
    int k = 0;
    while (i >= ends.data[k]) k++;
"""
_SCORES = """
        const long long set = (long long)(k * HEADS + h) * CODES;
        const long long row = ((long long)i * HEADS + h) * DIM;
        const float* __restrict__ kt = keys_by_d.data + set * DIM;
        const float* __restrict__ vt = values_by_d.data + set * DIM;
        float q[DIM];
        for (int d = 0; d < DIM; d++) q[d] = query.data[row + d] * scale;
"""
_FORWARD = (
    _SHARED
    + "    for (int h = 0; h < HEADS; h++) {"
    + _SCORES
    + """
        V s[CODES / W], best = *(const V*)bias.data * 0.0f - 1e30f;
        for (int b = 0; b < CODES; b += W) {
            V sum = *(const V*)(bias.data + b);
            for (int d = 0; d < DIM; d++) sum += q[d] * *(const V*)(kt + d * CODES + b);
            s[b / W] = sum;
            best = best < sum ? sum : best;
        }
        float top = ((const float*)&best)[0];
        for (int j = 1; j < W; j++) {
            const float other = ((const float*)&best)[j];
            top = other > top ? other : top;
        }
        V total_of = best * 0.0f, found[DIM];
        for (int d = 0; d < DIM; d++) found[d] = total_of;
        for (int b = 0; b < CODES; b += W) {
            V p;
            FUSION_EXP(p, s[b / W] - top)
            total_of += p;
            for (int d = 0; d < DIM; d++) found[d] += p * *(const V*)(vt + d * CODES + b);
        }
        const float sum = FUSION_SUM(total_of), share = 1.0f / sum;
        for (int d = 0; d < DIM; d++) out.data[row + d] = FUSION_SUM(found[d]) * share;
        total.data[2 * ((long long)i * HEADS + h)] = top;
        total.data[2 * ((long long)i * HEADS + h) + 1] = share;
    }
"""
)
_BACKWARD = (
    _SHARED
    + "    for (int h = first; h < HEADS; h += step) {"
    + _SCORES
    + """
        float* __restrict__ gk = grad_keys.data + set * DIM;
        float* __restrict__ gv = grad_values.data + set * DIM;
        const float top = total.data[2 * ((long long)i * HEADS + h)];
        const float share = total.data[2 * ((long long)i * HEADS + h) + 1];
        float o[DIM], mean[DIM];
        for (int d = 0; d < DIM; d++) {
            o[d] = cotangent.data[row + d];
            mean[d] = out.data[row + d];
        }
        V to[DIM];
        for (int d = 0; d < DIM; d++) to[d] = *(const V*)bias.data * 0.0f;
        // two vectors of codes side by side share the numbers that are the same for all lanes
        for (int b = 0; b < CODES; b += 2 * W) {
            V p[2], slope[2];
            for (int n = 0; n < 2; n++) {
                p[n] = *(const V*)(bias.data + b + n * W);
                slope[n] = p[n] * 0.0f;
            }
            for (int d = 0; d < DIM; d++)
                for (int n = 0; n < 2; n++) {
                    p[n] += q[d] * *(const V*)(kt + d * CODES + b + n * W);
                    slope[n] += o[d] * (*(const V*)(vt + d * CODES + b + n * W) - mean[d]);
                }
            for (int n = 0; n < 2; n++) {
                FUSION_EXP(p[n], p[n] - top)
                p[n] *= share;
                slope[n] *= p[n];
            }
            for (int d = 0; d < DIM; d++)
                for (int n = 0; n < 2; n++) {
                    const int c = d * CODES + b + n * W;
                    to[d] += slope[n] * *(const V*)(kt + c);
                    FUSION_ADD(gk + c, slope[n] * q[d]);
                    FUSION_ADD(gv + c, p[n] * o[d]);
                }
        }
        for (int d = 0; d < DIM; d++) grad_query.data[row + d] = FUSION_SUM(to[d]) * scale;
    }
"""
)


def _native(text: str, heads: int, dim: int, codes: int) -> str:
    text = text.replace("HEADS", str(heads))
    return text.replace("DIM", str(dim)).replace("CODES", str(codes))


@no_type_check
@functools.cache
def attention_kernel(heads: int, dim: int, codes: int) -> Any:
    """Build the attention for heads of ``dim`` numbers over ``codes`` codes, a multiple of 16."""

    @no_type_check
    @wp.func_native(_native(_FORWARD, heads, dim, codes))
    def attend(
        i: int,
        scale: float,
        ends: wp.array(dtype=wp.int32),
        query: wp.array(dtype=wp.float32),
        keys_by_d: wp.array(dtype=wp.float32),
        values_by_d: wp.array(dtype=wp.float32),
        bias: wp.array(dtype=wp.float32),
        out: wp.array(dtype=wp.float32),
        total: wp.array(dtype=wp.float32),
    ): ...

    @no_type_check
    @wp.kernel(enable_backward=False, module="unique")
    def attention_forward(
        start: int,
        scale: float,
        ends: wp.array(dtype=wp.int32),
        query: wp.array(dtype=wp.float32),
        keys_by_d: wp.array(dtype=wp.float32),
        values_by_d: wp.array(dtype=wp.float32),
        bias: wp.array(dtype=wp.float32),
        out: wp.array(dtype=wp.float32),
        total: wp.array(dtype=wp.float32),
    ):
        i = start + wp.tid()
        attend(i, scale, ends, query, keys_by_d, values_by_d, bias, out, total)

    return attention_forward


@no_type_check
@functools.cache
def attention_gradient_kernel(heads: int, dim: int, codes: int) -> Any:
    """Build the gradients of the attention, for the heads first, first + step, ... .

    On the CPU launches side by side must have disjoint heads: the sums over samples are then taken
    in their order, whatever the number of threads. On CUDA they are atomic.
    """

    @no_type_check
    @wp.func_native(_native(_BACKWARD, heads, dim, codes))
    def gradients(
        i: int,
        scale: float,
        ends: wp.array(dtype=wp.int32),
        query: wp.array(dtype=wp.float32),
        keys_by_d: wp.array(dtype=wp.float32),
        values_by_d: wp.array(dtype=wp.float32),
        bias: wp.array(dtype=wp.float32),
        out: wp.array(dtype=wp.float32),
        total: wp.array(dtype=wp.float32),
        cotangent: wp.array(dtype=wp.float32),
        first: int,
        step: int,
        grad_query: wp.array(dtype=wp.float32),
        grad_keys: wp.array(dtype=wp.float32),
        grad_values: wp.array(dtype=wp.float32),
    ): ...

    @no_type_check
    @wp.kernel(enable_backward=False, module="unique")
    def attention_backward(
        start: int,
        scale: float,
        ends: wp.array(dtype=wp.int32),
        query: wp.array(dtype=wp.float32),
        keys_by_d: wp.array(dtype=wp.float32),
        values_by_d: wp.array(dtype=wp.float32),
        bias: wp.array(dtype=wp.float32),
        out: wp.array(dtype=wp.float32),
        total: wp.array(dtype=wp.float32),
        cotangent: wp.array(dtype=wp.float32),
        first: int,
        step: int,
        grad_query: wp.array(dtype=wp.float32),
        grad_keys: wp.array(dtype=wp.float32),
        grad_values: wp.array(dtype=wp.float32),
    ):
        i = start + wp.tid()
        gradients(
            i,
            scale,
            ends,
            query,
            keys_by_d,
            values_by_d,
            bias,
            out,
            total,
            cotangent,
            first,
            step,
            grad_query,
            grad_keys,
            grad_values,
        )

    return attention_backward
