"""The residual field starts as the identity, stays within its bound and can be trained."""

import pytest
import torch

from monopart.fields.hash_grid import GridSpec
from monopart.fields.residual import UVT_GRID, ResidualField
from monopart.geometry.errors import InputError

COUNTS = (30, 0, 20)
PART = torch.tensor([0] * 30 + [2] * 20)


def trained(scale: float = 0.05) -> ResidualField:
    """A field whose last layer is no longer zero."""
    field = ResidualField(3, scale)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.add_(2.0 * torch.randn_like(parameter))
    return field


def test_it_starts_at_exactly_zero() -> None:
    offset = ResidualField(3)(torch.rand(50, 3), PART, COUNTS)
    assert offset.shape == (50, 3) and not bool(offset.any())


@pytest.mark.parametrize("scale", [0.05, 0.3])
def test_offsets_stay_within_the_scale(scale: float) -> None:
    offset = trained(scale)(torch.rand(50, 3), PART, COUNTS)
    assert scale / 2 < offset.abs().max() <= scale


def test_gradients_reach_every_parameter_of_the_parts_in_use() -> None:
    field = ResidualField(3)
    loss = (field(torch.rand(50, 3), PART, COUNTS) - 0.01).square().sum()
    loss.backward()
    # at the start the zero weights of the last layer hold back everything below it
    assert {
        n for n, p in field.named_parameters() if bool(p.grad is not None and p.grad.any())
    } == {
        "mlp.weights.2",
        "mlp.biases.2",
    }
    torch.optim.SGD(field.parameters(), 1.0).step()
    field.zero_grad()
    (field(torch.rand(50, 3), PART, COUNTS) - 0.01).square().sum().backward()
    for name, parameter in field.named_parameters():
        assert parameter.grad is not None, name
        assert bool(parameter.grad.isfinite().all()) and bool(parameter.grad.any()), name
        if name.startswith("mlp"):
            assert not bool(parameter.grad[1].any()), name  # no rows, no gradient
            assert bool(parameter.grad[0].any()) and bool(parameter.grad[2].any()), name


def test_a_few_steps_fit_a_constant() -> None:
    field = ResidualField(3, grid=GridSpec(2, 2, 8, 4, 2.0))
    optimizer = torch.optim.Adam(field.parameters(), 2e-2)
    target = torch.tensor([0.02, -0.01, 0.03])
    for _ in range(30):
        optimizer.zero_grad()
        loss = (field(torch.rand(50, 3), PART, COUNTS) - target).square().mean()
        loss.backward()
        optimizer.step()
    assert loss.item() < 5e-5


def test_it_is_differentiable_in_the_coordinates() -> None:
    field = trained()
    uvt = torch.rand(50, 3, requires_grad=True)
    (gradient,) = torch.autograd.grad(field(uvt, PART, COUNTS).sum(), uvt)
    assert bool(gradient.isfinite().all()) and bool(gradient.any())


def test_parts_do_not_share() -> None:
    """A row depends on its own part's grid and network alone."""
    field = trained()
    uvt = torch.rand(50, 3)
    before = field(uvt, PART, COUNTS)
    with torch.no_grad():
        field.mlp.weights[0][2] += 1.0
    after = field(uvt, PART, COUNTS)
    assert torch.equal(before[:30], after[:30]) and not torch.allclose(before[30:], after[30:])


def test_no_rows() -> None:
    none = torch.zeros(0, dtype=torch.int64)
    assert ResidualField(2)(torch.zeros(0, 3), none, (0, 0)).shape == (0, 3)
    assert ResidualField(2, axes=4)(torch.zeros(0, 4), none, (0, 0)).shape == (0, 3)


def test_four_axes_are_the_sum_of_three_grids() -> None:
    field = ResidualField(3, axes=4)
    torch.nn.init.normal_(field.grid.table)
    torch.nn.init.normal_(field.mlp.weights[-1])
    xyzt = torch.rand(50, 4)
    encoded = field.encode(xyzt, PART)
    assert encoded.shape == (50, field.grid.out_features + 4)
    for row in (0, 29, 30, 49):
        x, y, z, t = xyzt[row].tolist()
        planes = torch.tensor([[x, y, t], [y, z, t], [z, x, t]])
        whose = PART[row] + 3 * torch.arange(3)
        expected = field.grid(planes, whose, backend="torch").sum(0)
        torch.testing.assert_close(encoded[row, :-4], expected, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(encoded[row, -4:], xyzt[row])
    before = field(xyzt, PART, COUNTS)
    for axis in range(4):
        moved = xyzt.clone()
        moved[:, axis] = 1 - moved[:, axis]
        assert bool((field(moved, PART, COUNTS) != before).any()), axis


def test_wrong_inputs_are_named() -> None:
    with pytest.raises(InputError, match="axes"):
        ResidualField(2, axes=5)
    with pytest.raises(InputError, match="4 columns, found 3"):
        ResidualField(3, axes=4)(torch.rand(50, 3), PART, COUNTS)


def test_the_grid_is_the_method_s() -> None:
    assert (UVT_GRID.levels, UVT_GRID.features, UVT_GRID.log2_size) == (8, 2, 14)
    small = ResidualField(1, grid=GridSpec(2, 2, 8, 4, 2.0), hidden=8)
    assert small.mlp.widths == (2 * 2 + 3, 8, 8, 3)
