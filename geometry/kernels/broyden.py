"""Warp kernel of inverse skinning for the few points that Newton's steps do not bring home."""

# ruff: noqa: C901, PLR0915 - one kernel holds the loop: a call per step would copy its state

from typing import no_type_check

import warp as wp

from .face_tree import bary_on_triangle
from .newton import bone_guess, closest_from, mix_rows, rows_of

wp.set_module_options({"enable_backward": False})  # gradients: the implicit function theorem


@no_type_check
@wp.func
def mixed(maps: wp.array2d(dtype=wp.vec4), v: wp.vec3i, w: wp.vec3, p: wp.vec3):
    """A point under the mixed map of three vertices, and the linear part of the map."""
    a0, a1, a2 = rows_of(maps, v[0])
    b0, b1, b2 = rows_of(maps, v[1])
    c0, c1, c2 = rows_of(maps, v[2])
    m0 = a0 * w[0] + b0 * w[1] + c0 * w[2]
    m1 = a1 * w[0] + b1 * w[1] + c1 * w[2]
    m2 = a2 * w[0] + b2 * w[1] + c2 * w[2]
    h = wp.vec4(p[0], p[1], p[2], 1.0)
    image = wp.vec3(wp.dot(m0, h), wp.dot(m1, h), wp.dot(m2, h))
    linear = wp.mat33(m0[0], m0[1], m0[2], m1[0], m1[1], m1[2], m2[0], m2[1], m2[2])
    return image, linear


@no_type_check
@wp.func
def rank_one(inverse: wp.mat33, move: wp.vec3, change: wp.vec3):
    """Smallest change of an inverse Jacobian that explains the last step, where defined."""
    guess = inverse * change
    scale = wp.dot(move, guess)
    if wp.abs(scale) > 1.0e-3 * wp.length_sq(move):
        inverse += wp.outer(move - guess, wp.transpose(inverse) * move) / scale
    return inverse


@no_type_check
@wp.kernel
def rescue(
    start: int,
    points: wp.array(dtype=wp.vec3),
    guess: wp.array(dtype=wp.vec3),
    layout: wp.array2d(dtype=wp.int64),
    boxes: wp.array2d(dtype=wp.float32),
    tris: wp.array2d(dtype=wp.float32),
    slots: wp.array(dtype=wp.int32),
    verts: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    maps: wp.array2d(dtype=wp.vec4),
    weights: wp.array2d(dtype=wp.float32),
    joints: wp.array(dtype=wp.vec3),
    bones: wp.array2d(dtype=wp.vec4),
    starts: int,
    iterations: int,
    limits: wp.vec4,
    rest: wp.array(dtype=wp.vec3),
    blend: wp.array2d(dtype=wp.float32),
    face: wp.array(dtype=wp.int32),
    residual: wp.array(dtype=wp.float32),
    invertible: wp.array(dtype=wp.bool),
):
    """Broyden's method for points whose residual is above ``limits[1]``; what is better is kept.

    Across a kink of the weights, a secant of both sides goes where the tangent of one does not.
    ``limits``: as in `newton.solve`.
    """
    i = start + wp.tid()
    best = residual[i]
    if best <= limits[1]:
        return
    x = points[i]
    for attempt in range(starts):
        p = guess[i]
        if attempt > 0:
            p = bone_guess(x, attempt - 1, joints, bones)
        inverse = wp.mat33(0.0)
        move = wp.vec3(0.0, 0.0, 0.0)
        last = wp.vec3(0.0, 0.0, 0.0)
        f = int(-1)
        k = int(0)
        while k <= iterations and best > limits[0]:
            f = closest_from(p, f, layout, boxes, tris, slots, verts, faces, limits[3])
            if f < 0:
                break
            v = faces[f]
            w = bary_on_triangle(p, verts[v[0]], verts[v[1]], verts[v[2]])
            image, linear = mixed(maps, v, w, p)
            e = image - x
            r = wp.length(e)
            ok = wp.abs(wp.determinant(linear)) > limits[2]
            if r < best:
                best = r
                rest[i] = p
                face[i] = f
                residual[i] = r
                invertible[i] = ok
                mix_rows(weights, v, w, blend, i)
            if k == 0:
                if not ok:
                    break
                inverse = wp.inverse(linear)
            else:
                inverse = rank_one(inverse, move, e - last)
            last = e
            move = -(inverse * e)
            size = wp.length(move)
            if size > 0.2:
                move = move * (0.2 / size)
            p = p + move
            k += 1
        if best <= limits[1]:
            break
