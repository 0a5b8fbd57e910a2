"""Boxes against a plain oracle that walks over faces and edges of the ray's parameter."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from monopart.geometry.boxes import box_mask, box_of, in_box, ray_box
from monopart.geometry.cameras import Camera, Rays
from monopart.geometry.errors import InputError

F64 = torch.float64


def oracle(origin: list, direction: list, lo: list, hi: list) -> tuple[float, float] | None:
    """Brute force: every crossing with a face plane that lies in the box, the origin included."""
    inside = [
        s
        for s in [0.0]
        + [
            (face - o) / d
            for o, d, a, b in zip(origin, direction, lo, hi, strict=True)
            if d != 0
            for face in (a, b)
        ]
        if s >= 0
        and all(
            a - 1e-9 <= o + s * d <= b + 1e-9
            for o, d, a, b in zip(origin, direction, lo, hi, strict=True)
        )
    ]
    return (min(inside), max(inside)) if inside else None


def check(origin, direction, lo, hi):
    rays = Rays(torch.tensor(origin, dtype=F64), torch.tensor(direction, dtype=F64))
    near, far, hit = ray_box(rays, torch.tensor(lo, dtype=F64), torch.tensor(hi, dtype=F64))
    expected = oracle(origin, direction, lo, hi)
    assert bool(hit) == (expected is not None)
    assert (float(near), float(far)) == pytest.approx(expected or (0.0, 0.0), abs=1e-9)


component = st.sampled_from([-1.0, -0.5, 0.0, -0.0, 0.25, 1.0])
coordinate = st.integers(-12, 12).map(lambda n: n / 4)


@given(
    origin=st.lists(coordinate, min_size=3, max_size=3),
    direction=st.lists(component, min_size=3, max_size=3).filter(any),
    corner=st.lists(coordinate, min_size=3, max_size=3),
    extent=st.lists(st.integers(0, 8).map(lambda n: n / 4), min_size=3, max_size=3),
)
@settings(max_examples=400, deadline=None)
def test_ray_box_on_a_lattice_of_touching_cases(origin, direction, corner, extent):
    # quarters are exact in binary, so rays that graze faces, edges and corners must hit
    check(origin, direction, corner, [a + b for a, b in zip(corner, extent, strict=True)])


def test_ray_box_against_dense_marching():
    generator = torch.Generator().manual_seed(0)
    origins = torch.randn(500, 3, generator=generator, dtype=F64) * 1.5
    directions = torch.randn(500, 3, generator=generator, dtype=F64)
    directions += 0.5 * -origins
    directions[::7, 0] = 0
    directions[::5, 2] = 0
    directions = directions / directions.norm(dim=-1, keepdim=True)
    lo, hi = torch.tensor([-0.7, -0.4, -1.0], dtype=F64), torch.tensor([0.5, 0.9, 0.3], dtype=F64)
    near, far, hit = ray_box(Rays(origins, directions), lo, hi)
    steps = torch.linspace(0, 8, 4001, dtype=F64)
    inside = in_box(origins[:, None] + steps[:, None] * directions[:, None], lo, hi)
    assert 50 < int(hit.sum()) < 450
    # a chord shorter than the step may slip between the samples
    assert bool((inside.any(-1) == hit)[(far - near > 0.002) | ~hit].all())
    seen = inside.any(-1)
    first = steps[inside[seen].double().argmax(-1)]
    last = steps[4000 - inside[seen].flip(-1).double().argmax(-1)]
    assert float((first - near[seen]).abs().max()) <= 0.0021
    assert float((last - far[seen]).abs().max()) <= 0.0021


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_values_and_gradients_are_finite_for_awkward_directions(dtype):
    tiny = torch.finfo(dtype).tiny
    directions = torch.tensor(
        [[1, 0, 0], [0, -1, 0], [tiny, 1, 0], [tiny / 8, 0, 1], [1e-12, 1, 0], [0, 0, 0]],
        dtype=dtype,
    )
    origins = torch.tensor([[0.5] * 3, [-2.0] * 3, [0.0] * 3, [0.5, 1.0, -3]], dtype=dtype)
    origins = origins[:, None].expand(4, 6, 3).clone().requires_grad_()
    directions = directions.expand(4, 6, 3).clone().requires_grad_()
    near, far, hit = ray_box(
        Rays(origins, directions), torch.zeros(3, dtype=dtype), torch.ones(3, dtype=dtype)
    )
    (near.sum() + far.sum()).backward()
    for value in (near, far, origins.grad, directions.grad):
        assert value is not None
        assert bool(torch.isfinite(value).all())
    assert hit[0].tolist() == [True] * 5 + [False]
    assert hit[1].tolist() == [False] * 6
    assert near[0].tolist() == [0.0] * 6
    assert far[0, 0].item() == 0.5


def test_gradients_of_ray_box():
    def bounds(origins, directions, lo, hi):
        near, far, _ = ray_box(Rays(origins, directions), lo, hi)
        return near, far

    origins = torch.tensor([[-2.0, 0.4, 0.3], [0.2, 0.3, 0.4]], dtype=F64, requires_grad=True)
    directions = torch.tensor([[1.0, 0.1, 0.05], [0.3, -0.8, 0.1]], dtype=F64, requires_grad=True)
    lo = torch.zeros(3, dtype=F64, requires_grad=True)
    hi = torch.ones(3, dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(bounds, (origins, directions, lo, hi))


def test_an_inverted_box_is_never_hit():
    rays = Rays(torch.zeros(2, 3), torch.tensor([[1.0, 0, 0], [0.6, 0.8, 0]]))
    assert not bool(ray_box(rays, torch.ones(3), -torch.ones(3))[2].any())


def test_empty_rays_and_batches():
    for shape in ((0,), (2, 0), (2, 3), ()):
        rays = Rays(torch.zeros(*shape, 3), torch.ones(*shape, 3) / math.sqrt(3))
        near, far, hit = ray_box(rays, -torch.ones(3), torch.ones(3))
        assert near.shape == far.shape == hit.shape == shape
        assert bool(hit.all())
        assert near.dtype == far.dtype == torch.float32


@given(st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=1), st.floats(0, 2))
@settings(max_examples=50, deadline=None)
def test_box_of_holds_the_points_and_is_tight(points, margin):
    cloud = torch.tensor(points, dtype=F64)
    lo, hi = box_of(cloud, margin)
    assert bool(in_box(cloud, lo, hi).all())
    torch.testing.assert_close(lo + margin, cloud.min(0).values)
    torch.testing.assert_close(hi - margin, cloud.max(0).values)


def test_box_of_nothing_is_refused():
    with pytest.raises(InputError, match="at least one point"):
        box_of(torch.zeros(0, 3))


def test_box_mask_is_the_projected_box():
    K = torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    camera = Camera(K, torch.eye(3), torch.zeros(3), (48, 64))
    # the near face spans x/z in ±0.25 and y/z in ±0.1: 60 * 0.25 = 15 and 6 pixels
    mask = box_mask(camera, torch.tensor([-0.5, -0.2, 2.0]), torch.tensor([0.5, 0.2, 2.5]))
    expected = torch.zeros(48, 64, dtype=torch.bool)
    expected[18:30, 17:47] = True
    assert bool((mask == expected).all())
