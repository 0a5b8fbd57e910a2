"""Part fields: boxes, sizes, parts without rows, gradients everywhere."""

import dataclasses

import pytest
import torch
from torch.nn import functional

from monopart.fields.part_field import PartField, PartFieldSpec

LO = torch.tensor([[-0.2, 0.0, -0.1], [0.5, -1.0, 0.0], [-1.0, -1.0, -1.0]])
HI = torch.tensor([[0.2, 0.6, 0.1], [0.6, 0.0, 0.3], [0.0, -0.5, -0.7]])
SPEC = PartFieldSpec(levels=4, log2_size=10, base=4, finest=0.02, hidden=16, geometry=5, code=2)
COUNTS = (20, 0, 30)
PART = torch.tensor([0] * 20 + [2] * 30)


def inside() -> torch.Tensor:
    """A point in the box of each row's part."""
    return LO[PART] + torch.rand(50, 3) * (HI - LO)[PART]


def evaluate(field: PartField, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    encoded = field.encode(points, PART)
    sigma, geometry = field.density(encoded, COUNTS)
    code = torch.full((50, 2), 0.3) if field.spec.code else None
    return sigma, field.color(encoded, geometry, code, COUNTS)


@pytest.mark.parametrize("code", [0, 2])
def test_shapes_and_ranges(code: int) -> None:
    field = PartField(LO, HI, dataclasses.replace(SPEC, code=code))
    sigma, color = evaluate(field, inside())
    assert sigma.shape == (50,) and bool((sigma > 0).all())
    assert color.shape == (50, 3) and bool((color > 0).all()) and bool((color < 1).all())


def test_cells_are_cubes_of_the_longest_edge() -> None:
    """Doubling all boxes about the origin and halving the points changes nothing."""
    torch.manual_seed(4)
    field = PartField(LO, HI, SPEC)
    torch.manual_seed(4)
    double = PartField(2 * LO, 2 * HI, dataclasses.replace(SPEC, finest=0.04))
    points = inside()
    torch.testing.assert_close(field.encode(points, PART), double.encode(2 * points, PART))
    assert torch.allclose(field.edge, torch.tensor([0.6, 1.0, 1.0]))
    expected = field.grid((points - LO[PART]) / field.edge[PART, None], PART)
    assert torch.equal(field.encode(points, PART), expected)


def test_the_finest_cells_have_the_asked_edge() -> None:
    specs = SPEC.grid_specs([0.6, 1.0])
    assert [s.resolutions[0] for s in specs] == [4, 4]
    assert [s.resolutions[-1] for s in specs] == [30, 50]
    each = dataclasses.replace(SPEC, log2_size=(9, 12), finest=(0.1, 0.01)).grid_specs([0.6, 1.0])
    assert [s.log2_size for s in each] == [9, 12]
    assert [s.resolutions[-1] for s in each] == [6, 100]
    # a box smaller than base * finest keeps the base, and one level needs no growth
    assert SPEC.grid_specs([0.01])[0].growth == 1.0
    assert dataclasses.replace(SPEC, levels=1).grid_specs([0.6])[0].resolutions == (4,)


def test_the_prior_is_added_before_the_softplus() -> None:
    field = PartField(LO, HI, SPEC)
    encoded = field.encode(inside(), PART)
    raw = field.density_mlp(encoded, COUNTS)
    prior = torch.randn(50)
    sigma, geometry = field.density(encoded, COUNTS, prior)
    torch.testing.assert_close(sigma, SPEC.sharpness * functional.softplus(raw[:, 0] + prior))
    assert torch.equal(geometry, raw[:, 1:])
    empty, _ = field.density(encoded, COUNTS, torch.full((50,), -50.0))
    assert empty.max() < 1e-10


def test_gradients_reach_every_parameter_of_the_parts_in_use() -> None:
    field = PartField(LO, HI, SPEC)
    points = inside().requires_grad_()
    sigma, color = evaluate(field, points)
    (sigma.sum() * 1e-2 + color.square().sum()).backward()
    for name, parameter in field.named_parameters():
        assert parameter.grad is not None, name
        assert bool(parameter.grad.isfinite().all()) and bool(parameter.grad.any()), name
        if "mlp" in name:
            assert not bool(parameter.grad[1].any()), name
            assert bool(parameter.grad[0].any()) and bool(parameter.grad[2].any()), name
    rows = field.grid.offsets[:, 0].tolist()
    table = field.grid.table.grad
    assert table is not None
    assert bool(table[: rows[1]].any()) and bool(table[rows[2] :].any())
    assert not bool(table[rows[1] : rows[2]].any())
    assert points.grad is not None and bool(points.grad.any())


def test_points_outside_the_box_are_finite() -> None:
    field = PartField(LO, HI, SPEC)
    sigma, color = evaluate(field, 100 * torch.randn(50, 3))
    assert bool(sigma.isfinite().all()) and bool(color.isfinite().all())


def test_no_rows() -> None:
    field = PartField(LO, HI, SPEC)
    encoded = field.encode(torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64))
    sigma, geometry = field.density(encoded, (0, 0, 0))
    color = field.color(encoded, geometry, torch.zeros(0, 2), (0, 0, 0))
    assert sigma.shape == (0,) and color.shape == (0, 3)


def test_boxes_move_with_the_module_but_are_not_saved() -> None:
    field = PartField(LO, HI, SPEC).double()
    assert field.lo.dtype == torch.float64
    assert not {"lo", "edge"} & set(field.state_dict())
    given = LO.clone()
    kept = PartField(given, HI, SPEC)
    given += 1
    assert torch.equal(kept.lo, LO)
