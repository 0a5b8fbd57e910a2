"""The Warp kernel that blends splats and their gradients: one thread per tile."""

from typing import no_type_check

import warp as wp

TILE = wp.constant(16)  # these four as in fields.splats
FAINT = wp.constant(1.0 / 255.0)
DENSE = wp.constant(0.99)
SPENT = wp.constant(1e-4)


@no_type_check
@wp.func
def pixels_within(middle: float, half: float, low: int, high: int) -> wp.vec2i:
    """Return the first pixel whose middle is within reach, and the one after the last."""
    first, last = int(wp.ceil(middle - half - 0.5)), int(wp.floor(middle + half - 0.5))
    return wp.vec2i(wp.max(low, first), wp.min(high, last + 1))


@no_type_check
@wp.kernel(enable_backward=False)
def blend(
    start: int,
    tile_start: wp.array(dtype=wp.int32),
    owner: wp.array(dtype=wp.int32),
    means: wp.array(dtype=wp.vec2),
    shapes: wp.array(dtype=wp.vec4),
    colors: wp.array(dtype=wp.vec3),
    height: int,
    width: int,
    image: wp.array(dtype=wp.vec4),
    grad: wp.array(dtype=wp.vec4),
    total: wp.array(dtype=wp.float32),
    d_means: wp.array(dtype=wp.vec2),
    d_shapes: wp.array(dtype=wp.vec4),
    d_colors: wp.array(dtype=wp.vec3),
):
    """Add the splats of a tile, front to back, to ``image``: colour, and the light that is left.

    ``shapes`` holds a, b, c of the inverse covariance ((a, b), (b, c)) and the opacity. Where
    ``grad``, of colour and opacity, is not empty, the picture is blended once more, and gradients
    go to the (tile, splat) pairs; ``total`` is the product of ``grad`` and the finished picture.
    """
    tile, tiles = start + wp.tid(), (width + TILE - 1) // TILE
    top, left = TILE * (tile // tiles), TILE * (tile % tiles)
    bottom, right = wp.min(top + TILE, height), wp.min(left + TILE, width)
    unfinished = (bottom - top) * (right - left)
    for pair in range(tile_start[tile], tile_start[tile + 1]):
        if unfinished == 0:
            break
        mean, shape, color = means[owner[pair]], shapes[owner[pair]], colors[owner[pair]]
        d_mean, d_shape, d_color = wp.vec2(), wp.vec4(), wp.vec3()
        a, b, c, opacity = shape[0], shape[1], shape[2], shape[3]
        reach = 2.0 * wp.log(opacity / FAINT)  # of the ellipse in which the splat is not faint
        rows = pixels_within(mean[1], wp.sqrt(reach * a / (a * c - b * b)), top, bottom)
        for y in range(rows[0], rows[1]):
            dy = float(y) + 0.5 - mean[1]
            square = wp.max(0.0, (b * b - a * c) * dy * dy + a * reach)
            columns = pixels_within(mean[0] - b * dy / a, wp.sqrt(square) / a, left, right)
            for x in range(columns[0], columns[1]):
                at = image[y * width + x]
                if at[3] >= SPENT:
                    dx = float(x) + 0.5 - mean[0]
                    bell = wp.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
                    alpha = wp.min(DENSE, opacity * bell)
                    share = at[3] * alpha
                    rgb, light = wp.vec3(at[0], at[1], at[2]) + share * color, at[3] - share
                    image[y * width + x] = wp.vec4(rgb[0], rgb[1], rgb[2], light)
                    if light < SPENT:
                        unfinished -= 1
                    if grad.shape[0] > 0:
                        g = grad[y * width + x]
                        g_rgb = wp.vec3(g[0], g[1], g[2])
                        d_color += share * g_rgb
                        behind = total[y * width + x] - wp.dot(g_rgb, rgb) - g[3] * (1.0 - light)
                        d_alpha = at[3] * (wp.dot(g_rgb, color) + g[3]) - behind / (1.0 - alpha)
                        if opacity * bell < DENSE:
                            p = -d_alpha * alpha
                            d_shape += p * wp.vec4(0.5 * dx * dx, dx * dy, 0.5 * dy * dy, 0.0)
                            d_shape[3] += d_alpha * bell
                            d_mean -= p * wp.vec2(a * dx + b * dy, b * dx + c * dy)
        if grad.shape[0] > 0:
            d_means[pair] = d_mean
            d_shapes[pair] = d_shape
            d_colors[pair] = d_color
