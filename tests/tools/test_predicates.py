"""Signs of determinants against fractions."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from monopart.tools.predicates import orient2d, orient3d


def exact(points: list[np.ndarray]) -> int:
    """Sign of the determinant of the points minus the first, in fractions."""
    start, *rest = ([Fraction(float(x)) for x in p] for p in points)
    rows = [[x - s for x, s in zip(r, start, strict=True)] for r in rest]
    if len(rows) == 2:
        value = rows[0][0] * rows[1][1] - rows[0][1] * rows[1][0]
    else:
        u, v, w = rows
        value = sum(
            (u[i] * v[j] - u[j] * v[i]) * w[k] for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
        )
    return (value > 0) - (value < 0)


@given(st.integers(0, 10**6), st.sampled_from([2, 3]), st.sampled_from([0, 1e-16, 1e-12, 1e-3]))
def test_points_near_a_line_or_plane(seed: int, dim: int, off: float) -> None:
    rng = np.random.default_rng(seed)
    base = rng.normal(size=(dim, dim)).astype(np.float32).astype(float) + rng.integers(-3, 3)
    share = np.float32(rng.integers(-64, 64, size=dim - 1) / 64).astype(float)
    point = base[0] + (share[:, None] * (base[1:] - base[0])).sum(0) + off * rng.normal(size=dim)
    points = [*base, point]
    found = (orient2d if dim == 2 else orient3d)(*(p[None] for p in points))
    assert found.dtype == np.int8 and int(found[0]) == exact(points)


def test_exactly_flat_points_of_float32_are_flat() -> None:
    rng = np.random.default_rng(1)
    corner = rng.integers(-(2**20), 2**20, size=(500, 3, 3)) / 2.0**20
    mix = rng.integers(-4, 5, size=(500, 2))
    a, b, c = np.moveaxis(corner, 1, 0)
    d = a + mix[:, :1] * (b - a) + mix[:, 1:] * (c - a)
    assert not orient3d(a, b, c, d).any()
    up = d + 1e-15 * np.cross(b - a, c - a)
    assert (orient3d(a, b, c, up + np.sign(up - d) * 1e-15) != 0).any()


@pytest.mark.parametrize("sign", [orient2d, orient3d])
def test_swapping_two_points_turns_the_sign(sign) -> None:
    dim = 2 if sign is orient2d else 3
    points = list(np.random.default_rng(2).normal(size=(dim + 1, 50, dim)))
    swapped = [points[1], points[0], *points[2:]]
    assert np.array_equal(sign(*points), -sign(*swapped))
    assert sign(*(p[:0] for p in points)).shape == (0,)
