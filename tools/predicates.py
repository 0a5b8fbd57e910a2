"""Signs of determinants: on which side of a line or a plane a point lies; numpy.

A sign is taken from float64 where the rounding error cannot change it, and from twice the digits
elsewhere. What is zero to 96 bits of the size of its terms counts as zero; coordinates that were
float32 once are decided exactly. Reference: J. R. Shewchuk, Adaptive precision floating-point
arithmetic and fast robust geometric predicates, 1997 (filters, error-free sums and products); own
code.
"""

import numpy as np
from jaxtyping import Float, Int

_EPS = 2.0**-53
_SPLIT = 2.0**27 + 1
_ZERO = 2.0**-96
_Twice = tuple[np.ndarray, np.ndarray]  # a number as a sum of two floats


def _sum(a: np.ndarray, b: np.ndarray) -> _Twice:
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


def _product(a: np.ndarray, b: np.ndarray) -> _Twice:
    total = a * b
    high_a, high_b = a * _SPLIT, b * _SPLIT
    high_a, high_b = high_a - (high_a - a), high_b - (high_b - b)
    low_a, low_b = a - high_a, b - high_b
    error = ((high_a * high_b - total) + high_a * low_b + low_a * high_b) + low_a * low_b
    return total, error


def _times(a: _Twice, b: _Twice) -> _Twice:
    high, low = _product(a[0], b[0])
    return _sum(high, low + (a[0] * b[1] + a[1] * b[0]))


def _plus(a: _Twice, b: _Twice) -> _Twice:
    high, low = _sum(a[0], b[0])
    more, rest = _sum(a[1], b[1])
    high, low = _sum(high, low + more)
    return _sum(high, low + rest)


def _minus(a: _Twice, b: _Twice) -> _Twice:
    return _plus(a, (-b[0], -b[1]))


def _certain(value: np.ndarray, size: np.ndarray, share: float) -> np.ndarray:
    """Signs of values whose error is below a share of a size; 2 where it is not."""
    sign = np.sign(value).astype(np.int8)
    return np.where(np.abs(value) > share * size, sign, np.where(size == 0, 0, 2)).astype(np.int8)


def orient2d(
    a: Float[np.ndarray, "n 2"], b: Float[np.ndarray, "n 2"], c: Float[np.ndarray, "n 2"]
) -> Int[np.ndarray, "n"]:
    """Sign of the turn a → b → c.

    Args:
        a: first points.
        b: second points.
        c: third points.

    Returns:
        1 for a turn to the left (counter-clockwise), -1 to the right, 0 on a line.

    >>> one = np.eye(2)[:1]
    >>> orient2d(0 * one, one, np.array([[0.5, 1e-30]]))
    array([1], dtype=int8)
    """
    left = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1])
    right = (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    sign = _certain(left - right, np.abs(left) + np.abs(right), 4 * _EPS)
    open_ = np.flatnonzero(sign == 2)
    if len(open_):
        u = [_sum(b[open_, k], -a[open_, k]) for k in range(2)]
        v = [_sum(c[open_, k], -a[open_, k]) for k in range(2)]
        value = _minus(_times(u[0], v[1]), _times(u[1], v[0]))[0]
        size = (np.abs(left) + np.abs(right))[open_]
        sign[open_] = np.where(np.abs(value) > _ZERO * size, np.sign(value), 0)
    return sign


def orient3d(
    a: Float[np.ndarray, "n 3"],
    b: Float[np.ndarray, "n 3"],
    c: Float[np.ndarray, "n 3"],
    d: Float[np.ndarray, "n 3"],
) -> Int[np.ndarray, "n"]:
    """On which side of the plane of a, b, c the point d lies.

    Args:
        a: first corners.
        b: second corners.
        c: third corners.
        d: points.

    Returns:
        1 where a, b, c run counter-clockwise seen from d, -1 on the other side, 0 on the plane.

    >>> zero, rows = np.zeros((1, 3)), np.eye(3)[:, None]
    >>> orient3d(zero, rows[0], rows[1], rows[2]), orient3d(zero, rows[0], rows[1], rows[0])
    (array([1], dtype=int8), array([0], dtype=int8))
    """
    u, v, w = (b - a).T, (c - a).T, (d - a).T
    value, size = np.zeros(len(a)), np.zeros(len(a))
    turns = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
    for i, j, k in turns:
        left, right = u[i] * v[j], u[j] * v[i]
        value += (left - right) * w[k]
        size += (np.abs(left) + np.abs(right)) * np.abs(w[k])
    sign = _certain(value, size, 10 * _EPS)
    open_ = np.flatnonzero(sign == 2)
    if len(open_):
        start = a[open_]
        u, v, w = ([_sum(x[open_, k], -start[:, k]) for k in range(3)] for x in (b, c, d))
        zero = np.zeros(len(open_))
        exact: _Twice = (zero, zero)
        for i, j, k in turns:
            minor = _minus(_times(u[i], v[j]), _times(u[j], v[i]))
            exact = _plus(exact, _times(minor, w[k]))
        sign[open_] = np.where(np.abs(exact[0]) > _ZERO * size[open_], np.sign(exact[0]), 0)
    return sign
