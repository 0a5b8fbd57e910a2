"""The lens, its Jacobian, fold and inverse: against the plain formula and dense search."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from monopart.geometry.distortion import (
    distort,
    distort_extended,
    distortion_jacobian,
    fold_radius,
    undistort,
)
from monopart.geometry.errors import InputError

F64 = torch.float64
LENSES = {
    "zju-like": [-0.2, 0.003, 0.0006, -0.0004, 0.0],
    "barrel": [-0.35, 0.12, 0.0, 0.0, -0.015],
    "pincushion": [0.6, 0.3, 0.001, -0.002, 0.1],
    "rational": [0.9, 0.2, 0.001, 0.0, 0.01, 1.3, 0.4, 0.02],
    "prism": [-0.1, 0.01, 0.001, 0.002, 0.0, 0.0, 0.0, 0.0, 0.01, -0.002, 0.004, 0.001],
    "tilt": [-0.1, 0.01, 0.001, 0.002, 0.0, 0.0, 0.0, 0.0, 0.01, -0.002, 0.004, 0.001, 0.2, -0.15],
}
UPRIGHT = [name for name in LENSES if name != "tilt"]  # the tilt is compared in test_fisheye


def lens(name: str, dtype: torch.dtype = F64) -> torch.Tensor:
    return torch.tensor(LENSES[name], dtype=dtype)


def disc(radius: float, count: int = 4000, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    r, a = torch.rand(2, count, generator=generator, dtype=F64)
    r, a = radius * r.sqrt(), 2 * math.pi * a
    return torch.stack([r * a.cos(), r * a.sin()], -1)


@pytest.mark.parametrize("name", UPRIGHT)
def test_distort_is_the_formula_of_opencv(name):
    points = disc(0.8, 500)
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = (LENSES[name] + [0.0] * 12)[:12]
    expected = []
    for x, y in points.tolist():
        r2 = x * x + y * y
        radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r2**2
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + s3 * r2 + s4 * r2**2
        expected.append([u, v])
    exact = torch.tensor(expected, dtype=F64)
    torch.testing.assert_close(distort(points, lens(name)), exact, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", LENSES)
def test_jacobian_is_the_derivative(name):
    points, coefficients = disc(1.0, 20), lens(name)
    each = torch.func.vmap(torch.func.jacrev(lambda p: distort(p, coefficients)))
    torch.testing.assert_close(distortion_jacobian(points, coefficients), each(points))


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("focal", [500.0, 2000.0])
def test_undistortion_residual(name, focal):
    # every pixel within a wide image, the ones past the fold included
    coefficients = lens(name)
    grid = torch.linspace(-1.2, 1.2, 121, dtype=F64)
    target = torch.cartesian_prod(grid, grid)
    ideal, valid = undistort(target, coefficients)
    residual = focal * (distort(ideal, coefficients) - target).norm(dim=-1)
    assert bool(torch.isfinite(ideal).all())
    assert float(residual[valid].max()) <= 1e-9
    assert float(valid.double().mean()) > 0.2
    assert float(ideal[valid].norm(dim=-1).max()) < fold_radius(coefficients)


@pytest.mark.parametrize("name", LENSES)
def test_undistort_recovers_every_point_inside_the_fold(name):
    coefficients = lens(name)
    points = disc(min(0.98 * fold_radius(coefficients), 2.0))
    ideal, valid = undistort(distort(points, coefficients), coefficients)
    assert bool(valid.all())
    assert float((ideal - points).abs().max()) < 1e-11


def test_eight_steps_are_enough_on_an_image():
    for name in ("zju-like", "barrel", "pincushion"):
        coefficients = lens(name)
        points = disc(0.7)
        ideal, valid = undistort(distort(points, coefficients), coefficients, steps=8)
        assert bool(valid.all())
        assert float((ideal - points).abs().max()) < 1e-12


@pytest.mark.parametrize("name", LENSES)
def test_undistort_float32(name):
    coefficients = lens(name, torch.float32)
    points = disc(0.7).float()
    ideal, valid = undistort(distort(points, coefficients), coefficients)
    assert bool(valid.all())
    assert float((ideal - points).abs().max()) < 1e-5


def test_points_beyond_the_fold_are_masked():
    coefficients = torch.tensor([-0.2, 0.0, 0.0, 0.0], dtype=F64)
    radius = fold_radius(coefficients)
    assert radius == pytest.approx(math.sqrt(1 / 0.6), abs=1e-12)
    edge = radius * (1 - 0.2 * radius**2)
    target = torch.tensor([[0.999 * edge, 0.0], [1.001 * edge, 0.0], [0.0, 5.0]], dtype=F64)
    assert undistort(target, coefficients)[1].tolist() == [True, False, False]


@pytest.mark.parametrize("name", UPRIGHT)
def test_fold_radius_against_a_dense_search(name):
    coefficients = lens(name)
    r = torch.linspace(0, 20, 20001, dtype=F64)
    a = torch.linspace(0, 2 * math.pi, 73, dtype=F64)
    points = r[:, None, None] * torch.stack([a.cos(), a.sin()], -1)
    jac = distortion_jacobian(points, coefficients)
    low = torch.linalg.eigvalsh((jac + jac.mT) / 2)[..., 0].amin(-1)
    first = float(r[int((low <= 0).float().argmax())]) if bool((low <= 0).any()) else math.inf
    found = fold_radius(coefficients)
    if math.isinf(first):
        assert found >= 10
    else:
        assert min(0.99 * first, 9.9) <= found <= first + 1e-3


def test_a_pole_of_the_rational_lens_is_a_fold():
    coefficients = torch.tensor([0, 0, 0, 0, 0, -0.25, 0, 0], dtype=F64)
    assert fold_radius(coefficients) == pytest.approx(2.0)


@pytest.mark.parametrize("name", LENSES)
def test_gradients_of_undistort(name):
    coefficients = lens(name).requires_grad_()
    target = distort(disc(0.6, 6), lens(name)).requires_grad_()
    radius = fold_radius(coefficients)

    def ideal(points, k):
        return undistort(points, k, radius)[0]

    assert torch.autograd.gradcheck(ideal, (target, coefficients), atol=1e-6)


def test_gradients_stay_finite_where_no_point_exists():
    coefficients = lens("zju-like").requires_grad_()
    target = torch.tensor([[3.0, 4.0], [0.1, 0.1]], dtype=F64, requires_grad=True)
    ideal, valid = undistort(target, coefficients)
    assert valid.tolist() == [False, True]
    ideal.sum().backward()
    assert target.grad is not None
    assert coefficients.grad is not None
    assert bool(torch.isfinite(target.grad).all() and torch.isfinite(coefficients.grad).all())
    assert target.grad[0].tolist() == [0, 0]


@given(
    radius=st.floats(0.1, 1e8),
    angle=st.floats(0, 6.3),
    name=st.sampled_from(sorted(LENSES)),
)
@settings(max_examples=60, deadline=None)
def test_extension_is_exact_inside_and_finite_outside(radius, angle, name):
    coefficients = lens(name, torch.float32)
    fold = fold_radius(coefficients)
    point = radius * torch.tensor([math.cos(angle), math.sin(angle)])
    point.requires_grad_()
    found = distort_extended(point, coefficients, fold)
    found.sum().backward()
    assert point.grad is not None
    assert bool(torch.isfinite(found).all() and torch.isfinite(point.grad).all())
    if radius < 0.999 * min(fold, 1e3):
        torch.testing.assert_close(found, distort(point, coefficients))


def test_empty_inputs():
    empty = torch.zeros(0, 2, dtype=F64)
    for coefficients in (lens("barrel"), torch.zeros(0, dtype=F64)):
        ideal, valid = undistort(empty, coefficients)
        assert ideal.shape == distort(empty, coefficients).shape == (0, 2)
        assert valid.shape == (0,)


def test_other_counts_are_refused():
    with pytest.raises(InputError, match="distortion"):
        distort(torch.zeros(2), torch.zeros(6))
