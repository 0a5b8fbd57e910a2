"""Warp kernels of compositing: one thread per ray, forward and backward."""
# a kernel lists its arrays; float() makes Warp variables
# ruff: noqa: PLR1730

from typing import no_type_check

import warp as wp

MAX_SIGMA = wp.constant(1e30)  # as in the torch reference
MAX_OPTICAL = wp.constant(1000.0)


@no_type_check
@wp.func
def _optical(sigma: float, delta: float) -> float:
    """Return sigma * delta up to 1000; comparisons rather than min, so that NaN is seen."""
    s = sigma
    if s > MAX_SIGMA:
        s = MAX_SIGMA
    x = s * delta
    if x > MAX_OPTICAL:
        x = MAX_OPTICAL
    return x


@no_type_check
@wp.func
def _opacity(x: float) -> float:
    """Return 1 - exp(-x) without cancellation."""
    alpha = 1.0 - wp.exp(-x)
    if x < 0.1:
        alpha = x * (
            1.0 - x / 2.0 * (1.0 - x / 3.0 * (1.0 - x / 4.0 * (1.0 - x / 5.0 * (1.0 - x / 6.0))))
        )
    return alpha


@no_type_check
@wp.func
def _add(total: wp.vec2, x: float) -> wp.vec2:
    """Add to a sum and what rounding has added to it too much (Kahan): thousands of terms."""
    y = x - total[1]
    t = total[0] + y
    return wp.vec2(t, (t - total[0]) - y)


@no_type_check
@wp.kernel(enable_backward=False)
def composite_forward(
    start: int,
    sigma: wp.array(dtype=wp.float32),
    color: wp.array(dtype=wp.vec3),
    delta: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
    ray_start: wp.array(dtype=wp.int64),
    stop: float,
    ray_color: wp.array(dtype=wp.vec3),
    ray_opacity: wp.array(dtype=wp.float32),
    ray_depth: wp.array(dtype=wp.float32),
    weights: wp.array(dtype=wp.float32),
    behind: wp.array(dtype=wp.float32),
):
    """Composite a ray front to back; ``behind`` is the transmittance behind each sample."""
    r = start + wp.tid()
    t = float(1.0)
    c = wp.vec3(0.0, 0.0, 0.0)
    lost = wp.vec3(0.0, 0.0, 0.0)
    in_front = wp.vec2(0.0, 0.0)
    o = wp.vec2(0.0, 0.0)
    d = wp.vec2(0.0, 0.0)
    for i in range(int(ray_start[r]), int(ray_start[r + 1])):
        if t <= stop:
            weights[i] = 0.0
            behind[i] = 0.0
        else:
            x = _optical(sigma[i], delta[i])
            w = t * _opacity(x)
            # of the sum, not a product of exponentials, whose roundings would add up
            in_front = _add(in_front, x)
            t = wp.exp(-in_front[0])
            more = w * color[i] - lost
            summed = c + more
            lost = (summed - c) - more
            c = summed
            o = _add(o, w)
            if depth.shape[0] > 0:
                d = _add(d, w * depth[i])
            weights[i] = w
            behind[i] = t
    ray_color[r] = c
    ray_opacity[r] = o[0]
    ray_depth[r] = d[0]


@no_type_check
@wp.kernel(enable_backward=False)
def composite_backward(
    start: int,
    color: wp.array(dtype=wp.vec3),
    depth: wp.array(dtype=wp.float32),
    ray_start: wp.array(dtype=wp.int64),
    weights: wp.array(dtype=wp.float32),
    behind: wp.array(dtype=wp.float32),
    ray_color: wp.array(dtype=wp.vec3),
    ray_opacity: wp.array(dtype=wp.float32),
    ray_depth: wp.array(dtype=wp.float32),
    sample_weights: wp.array(dtype=wp.float32),
    grad_optical: wp.array(dtype=wp.float32),
    grad_color: wp.array(dtype=wp.vec3),
):
    """Gradients in sigma * delta and color from the cotangents of the four results.

    With G_i the cotangent of weight i: dL/dx_i = T_(i+1) G_i - sum over j > i of w_j G_j.
    """
    r = start + wp.tid()
    first = int(ray_start[r])
    last = int(ray_start[r + 1])
    suffix = wp.vec2(0.0, 0.0)
    for n in range(last - first):
        i = last - 1 - n
        w = weights[i]
        g = wp.dot(ray_color[r], color[i]) + ray_opacity[r] + sample_weights[i]
        if depth.shape[0] > 0:
            g += ray_depth[r] * depth[i]
        grad_optical[i] = behind[i] * g - suffix[0]
        grad_color[i] = w * ray_color[r]
        suffix = _add(suffix, w * g)
