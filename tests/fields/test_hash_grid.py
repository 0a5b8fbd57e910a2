"""The hash grid against its torch twin and a plain float64 loop, in value and gradients."""

import math

import numpy as np
import pytest
import torch

from monopart.fields.hash_grid import (
    GridSpec,
    HashGrid,
    _add_sorted_gradient,
    _add_table_gradient,
)
from monopart.geometry.errors import BackendError, InputError

# three parts with dense and hashed levels in different places
SPECS = {
    features: [
        GridSpec(levels=5, features=features, log2_size=9, base=3, growth=1.7),
        GridSpec(levels=5, features=features, log2_size=6, base=2, growth=1.9),
        GridSpec(levels=5, features=features, log2_size=12, base=5, growth=1.3),
    ]
    for features in (1, 2, 3, 4)
}


def _grid(features, parts=3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    grid = HashGrid(SPECS[features][:parts], generator)
    with torch.no_grad():
        grid.table.copy_(torch.randn(grid.table.shape, generator=generator))
    return grid


def _points(n, seed=0):
    """Points inside, outside, at 0 and 1, and on cell borders."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(n, 3, generator=generator) * 1.4 - 0.2
    special = torch.tensor([0.0, 1.0, 0.5, 1 / 3, 0.25, 1e-7, 1 - 1e-7])
    rows = torch.randint(0, len(special), (n // 3, 3), generator=generator)
    points[: n // 3] = special[rows]
    return points, torch.randint(0, 3, (n,), generator=generator)


def oracle(specs, table, points, part, cotangent):
    """Value, table gradient and point gradient by loops in float64."""
    table, points, cotangent = (t.detach().double().numpy() for t in (table, points, cotangent))
    features = table.shape[1]
    starts, row = [], 0
    for spec in specs:
        starts.append([])
        for size in spec.sizes:
            starts[-1].append(row)
            row += size
    value = np.zeros((len(points), specs[0].levels * features))
    grad_table, grad_points = np.zeros_like(table), np.zeros_like(points)
    for i, (point, k) in enumerate(zip(points, part.tolist(), strict=True)):
        for level in range(specs[k].levels):
            res = math.floor(specs[k].base * specs[k].growth ** level + 1e-6)
            size = 2 ** specs[k].log2_size
            columns = slice(level * features, (level + 1) * features)
            # float32 as the code under test, so that both fall into the same cell
            position = np.clip(point, 0, 1).astype(np.float32) * np.float32(res)
            cell = np.minimum(np.floor(position).astype(int), res - 1)
            inside = position.astype(float) - cell
            for corner in np.ndindex(2, 2, 2):
                x, y, z = (int(v) for v in cell + corner)
                if (res + 1) ** 3 <= size:
                    j = x + (res + 1) * y + (res + 1) ** 2 * z
                else:
                    j = (x ^ (y * 2654435761 % 2**32) ^ (z * 805459861 % 2**32)) % size
                j += starts[k][level]
                axis = [inside[d] if corner[d] else 1 - inside[d] for d in range(3)]
                weight = axis[0] * axis[1] * axis[2]
                value[i, columns] += weight * table[j]
                grad_table[j] += weight * cotangent[i, columns]
                for d in range(3):
                    if 0 <= point[d] <= 1:
                        others = axis[(d + 1) % 3] * axis[(d + 2) % 3]
                        sign = 1 if corner[d] else -1
                        along = table[j] @ cotangent[i, columns]
                        grad_points[i, d] += sign * res * others * along
    return value, grad_table, grad_points


def _run(grid, points, part, cotangent, backend):
    points = points.clone().requires_grad_()
    grid.table.grad = None
    out = grid(points, part, backend)
    out.backward(cotangent)
    return out.detach(), grid.table.grad.clone(), points.grad


@pytest.mark.parametrize("backend", ["torch", "warp"])
@pytest.mark.parametrize("features", [1, 2, 4])
@pytest.mark.parametrize("n", [1, 2, 300])
def test_oracle(n, features, backend):
    grid = _grid(features)
    dense = {flag for spec in grid.specs for flag in spec.dense}
    assert dense == {True, False}
    points, part = _points(n)
    cotangent = torch.randn(n, grid.out_features, generator=torch.Generator().manual_seed(1))
    expected = oracle(grid.specs, grid.table, points, part, cotangent)
    for found, wanted in zip(_run(grid, points, part, cotangent, backend), expected, strict=True):
        scale = max(1.0, abs(wanted).max())
        assert abs(found.numpy() - wanted).max() <= 2e-6 * scale


@pytest.mark.parametrize("threads", [1, 3])
def test_warp_equals_torch_on_many_points(threads):
    """More points than one launch takes on one thread, and levels that threads do not divide."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        grid = _grid(2)
        points, part = _points(5000)
        part = part.sort().values.int()
        cotangent = torch.randn(5000, grid.out_features)
        ours = _run(grid, points, part, cotangent, "warp")
        twin = _run(grid, points, part, cotangent, "torch")
        for a, b in zip(ours, twin, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-4)
    finally:
        torch.set_num_threads(before)


def test_gradient_is_bitwise_repeatable_on_any_number_of_threads():
    before = torch.get_num_threads()
    grid = _grid(2)
    points, part = _points(4000)
    cotangent = torch.randn(4000, grid.out_features)
    try:
        runs = []
        for threads in (1, 2, 4, 2):
            torch.set_num_threads(threads)
            runs.append(_run(grid, points, part, cotangent, "warp"))
    finally:
        torch.set_num_threads(before)
    for run in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(run, runs[0], strict=True))


@pytest.mark.parametrize("features", [1, 2, 4])
def test_sorted_gradient_is_the_gradient(features):
    """What CUDA runs under `deterministic`, on the CPU."""
    for parts, n in ((3, 500), (1, 300), (3, 1), (3, 0)):
        grid = _grid(features, parts)
        points, part = _points(n)
        part = part if parts > 1 else torch.zeros(0, dtype=torch.long)
        layout = [grid.offsets, grid.masks, grid.resolutions]
        cotangent = torch.randn(n, grid.out_features)
        found, expected = torch.zeros(2, *grid.table.shape).unbind(0)
        saved = (points, grid.table.detach(), part.int(), layout, cotangent)
        _add_sorted_gradient(found, *saved)
        _add_table_gradient(expected, *saved)
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


@pytest.mark.gpu
def test_sorted_gradient_repeats_on_cuda():
    grid = _grid(2).cuda()
    grid.deterministic = True
    points, part = (t.cuda() for t in _points(20000))
    found = []
    for _ in range(3):
        grid.table.grad = None
        grid(points, part).square().sum().backward()
        found.append(grid.table.grad.clone())
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])
    grid.deterministic, grid.table.grad = False, None
    grid(points, part).square().sum().backward()
    torch.testing.assert_close(grid.table.grad, found[0], atol=1e-2, rtol=1e-3)


@pytest.mark.parametrize("backend", ["torch", "warp"])
def test_empty(backend):
    grid = _grid(2)
    points = torch.zeros(0, 3, requires_grad=True)
    out = grid(points, torch.zeros(0, dtype=torch.int32), backend)
    assert out.shape == (0, grid.out_features)
    out.sum().backward()
    assert grid.table.grad.abs().max() == 0
    assert points.grad.shape == (0, 3)


@pytest.mark.parametrize("backend", ["torch", "warp"])
def test_single_part_and_single_level(backend):
    grid = HashGrid([GridSpec(levels=1, features=2, log2_size=10, base=4, growth=1.0)])
    with torch.no_grad():  # the x coordinate of a vertex: trilinear interpolation returns x
        grid.table.copy_((torch.arange(125) % 5 / 4)[:, None].expand(125, 2))
    points = torch.rand(50, 3)
    torch.testing.assert_close(grid(points, None, backend), points[:, :1].expand(50, 2))
    zeros = torch.zeros(50, dtype=torch.long)
    assert torch.equal(grid(points, None, backend), grid(points, zeros, backend))


@pytest.mark.parametrize("backend", ["torch", "warp"])
def test_non_contiguous_inputs(backend):
    grid = _grid(4)
    points, part = _points(30)
    cotangent = torch.randn(grid.out_features, 30).T
    plain = _run(grid, points, part, cotangent.contiguous(), backend)
    odd = _run(grid, points.T.contiguous().T, part.repeat(2, 1).T[:, 0], cotangent, backend)
    assert all(torch.equal(a, b) for a, b in zip(odd, plain, strict=True))


@pytest.mark.parametrize("backend", ["torch", "warp"])
def test_no_point_gradient_unless_asked(backend):
    grid = _grid(2)
    points, part = _points(10)
    out = grid(points, part, backend)
    out.sum().backward()
    assert points.grad is None
    assert grid.table.grad.abs().sum() > 0
    grid.table.requires_grad_(False)
    assert not grid(points, part, backend).requires_grad


def test_nan_and_infinite_points_stay_inside_the_table():
    grid = _grid(2, parts=1)
    points = torch.tensor([[math.nan, 0.5, 0.5], [math.inf, -math.inf, 0.5], [1e30, 0.5, 0.5]])
    out = grid(points, None, "warp")
    torch.testing.assert_close(out[1:], grid(points, None, "torch")[1:])


def test_gradcheck_first_and_second_order():
    specs = [GridSpec(2, 1, 5, 2, 2.0), GridSpec(2, 1, 4, 3, 1.5)]
    grid = HashGrid(specs).double()
    generator = torch.Generator().manual_seed(3)
    table = torch.randn(grid.table.shape, generator=generator, dtype=torch.float64)
    points = torch.rand(3, 3, generator=generator, dtype=torch.float64)
    part = torch.tensor([0, 1, 0])

    def run(points, table):
        return torch.func.functional_call(grid, {"table": table}, (points, part, "torch"))

    inputs = (points.requires_grad_(), table.requires_grad_())
    assert torch.autograd.gradcheck(run, inputs)
    assert torch.autograd.gradgradcheck(run, inputs)


def test_initial_values_and_layout():
    grid = HashGrid(SPECS[2], torch.Generator().manual_seed(5))
    again = HashGrid(SPECS[2], torch.Generator().manual_seed(5))
    assert torch.equal(grid.table, again.table)
    assert 0.9e-4 < grid.table.abs().max() <= 1e-4
    assert grid.table.shape == (sum(sum(spec.sizes) for spec in SPECS[2]), 2)
    assert set(grid.state_dict()) == {"table"}
    assert GridSpec(16, 2, 19, 16, (512 / 16) ** (1 / 15)).resolutions[-1] == 512


def test_errors():
    grid = _grid(2)
    points, part = _points(10)
    with pytest.raises(InputError, match="part: expected indices in"):
        grid(points, torch.full((10,), 3))
    with pytest.raises(InputError, match="found None"):
        grid(points)
    with pytest.raises(BackendError, match="float32"):
        _grid(2).double()(points.double(), part, "warp")
    with pytest.raises(InputError, match="as the table"):
        grid(points.double(), part)
    with pytest.raises(BackendError, match="features per level"):
        _grid(3)(points, part, "warp")
    torch.testing.assert_close(_grid(3)(points, part), _grid(3)(points, part, "torch"))
    with pytest.raises(InputError, match="for all parts"):
        HashGrid([SPECS[2][0], SPECS[4][0]])
    with pytest.raises(InputError, match="found none"):
        HashGrid([])
    with pytest.raises(InputError, match="log2_size"):
        GridSpec(4, 2, 2, 4, 1.5)


def test_warp_refuses_a_second_derivative():
    grid = _grid(2)
    points, part = _points(10)
    out = grid(points.requires_grad_(), part, "warp")
    with pytest.raises(BackendError, match="second derivative"):
        torch.autograd.grad(out.sum(), points, create_graph=True)
