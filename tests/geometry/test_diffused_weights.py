"""Diffused weights: a partition of unity, near the surface's own; inverse skinning with them."""

import functools
import gc
import weakref
from dataclasses import replace

import numpy as np
import oracles
import pytest
import torch
from posing import ITERATIVE, METHODS, around, bent_tube, pose_of, share
from torch import Tensor
from tube import tube

from monopart.geometry.body import BodyModel
from monopart.geometry.diffused_weights import DiffusedField, newton_cells
from monopart.geometry.errors import InputError
from monopart.geometry.skinning import blend_transforms, skin
from monopart.geometry.skinning_field import SkinningField
from monopart.geometry.unskin import inverse_skin
from monopart.geometry.unskin_newton import Bones, Plan, newton_torch
from monopart.geometry.weight_grid import sweep_torch, sweep_warp


@pytest.fixture(scope="module")
def whole() -> DiffusedField:
    return DiffusedField.of(BodyModel.default())


@functools.cache
def small(dtype: torch.dtype, backend: str = "auto") -> DiffusedField:
    """A field of the tube; brute force, the torch back end, fills a coarse grid in a second."""
    return DiffusedField(tube(dtype), backend=backend, voxel=0.04, reach=0.12)


def total_variation(first: Tensor, second: Tensor) -> Tensor:
    return (first - second).abs().sum(-1) / 2


# --- the grid -------------------------------------------------------------------------------------


def test_weights_are_a_partition_of_unity(whole: DiffusedField) -> None:
    points = around(whole.rest, whole.faces, 5000, 0.09)
    weights = whole.weights_at(points)
    inside = weights.sum(-1) > 0
    assert share(inside) > 0.98
    assert (weights >= 0).all()
    torch.testing.assert_close(weights[inside].sum(-1), torch.ones(int(inside.sum())))


def test_every_node_off_the_surface_is_the_mean_of_its_neighbours() -> None:
    grid = small(torch.float64).grid
    x, y, z = grid.size
    place = torch.full((z, y, x), -1)
    cells, slots = grid.cells.long(), grid.slots.long()
    low = (slots >= 0).nonzero().squeeze(-1)
    place.view(-1)[low] = cells[slots[low], 0]
    block = place[1:-1, 1:-1, 1:-1]
    around_it = [
        place[1 + dz : z - 1 + dz, 1 + dy : y - 1 + dy, 1 + dx : x - 1 + dx]
        for dz, dy, dx in ((0, 0, 1), (0, 0, -1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0))
    ]
    free = block >= 0
    for neighbour in around_it:
        free &= neighbour >= 0
    free &= grid.distance[block.clamp(min=0)] > grid.voxel * 3**0.5
    assert free.sum() > 50
    mean = torch.stack([grid.weights[n[free]] for n in around_it]).mean(0)
    torch.testing.assert_close(grid.weights[block[free]], mean, atol=1e-3, rtol=0)


def test_error_on_the_surface_shrinks_with_the_voxel(whole: DiffusedField) -> None:
    """The documented error of the default grid: 1 % of the weights, 0.2 mm of a posed point."""
    body = BodyModel.default()
    exact = SkinningField(body)
    points = around(body.v_template, body.faces, 5000, 0.0)
    truth = exact.weights_at(points)
    coarse = DiffusedField(body, voxel=0.03)
    errors = [total_variation(f.weights_at(points), truth).mean() for f in (coarse, whole)]
    assert errors[1] < 0.013 and errors[1] < 0.6 * errors[0] < 0.6 * 0.035
    posed = pose_of(body, 0.3 * torch.randn(24, 3))
    moved = [
        skin(points, blend_transforms(posed.transforms, w))
        for w in (whole.weights_at(points), truth)
    ]
    gap = (moved[0] - moved[1]).norm(dim=-1)
    assert gap.mean() < 3e-4 and gap.quantile(0.99) < 4e-3


def test_weights_between_the_legs_do_not_jump(whole: DiffusedField) -> None:
    """Along a line from knee to knee, where the closest surface point changes sides."""
    line = torch.zeros(401, 3)
    line[:, 0] = torch.linspace(-0.06, 0.06, 401)
    line[:, 1] = whole.rest[:, 1].amin() + 0.45
    steps = [
        total_variation(w[1:], w[:-1]).max()
        for w in (whole.weights_at(line), SkinningField(BodyModel.default()).weights_at(line))
    ]
    assert whole.weights_at(line).sum(-1).min() > 0.99
    assert steps[0] < 0.03 and steps[1] > 0.9


def test_sweep_and_its_twin() -> None:
    around_them = torch.randint(-1, 40, (40, 6), dtype=torch.int32)
    around_them[7] = -1  # a node without neighbours keeps its weights
    for rows in (torch.arange(0, 40), torch.tensor([3]), torch.tensor([], dtype=torch.long)):
        # rows are no neighbours of each other
        apart = torch.where(torch.isin(around_them, rows), -1, around_them).contiguous()
        fast, plain = (w := torch.rand(40, 5)).clone(), w.clone()
        sweep_warp(rows, apart, fast)
        sweep_torch(rows, apart, plain)
        torch.testing.assert_close(fast, plain)
        assert torch.equal(plain[7], w[7])


def test_grids_of_both_back_ends_agree() -> None:
    fast, plain = (small(torch.float32, b).grid for b in ("warp", "torch"))
    assert fast.size == plain.size and torch.equal(fast.cells, plain.cells)
    torch.testing.assert_close(fast.weights, plain.weights, atol=2e-5, rtol=0)
    torch.testing.assert_close(fast.distance, plain.distance, atol=1e-6, rtol=0)


def test_no_weights_beyond_the_reach(whole: DiffusedField) -> None:
    points = torch.tensor([[0.0, 0, 5], [5.0, 0, 0], [0, -5.0, 0], [0, 0.6, 0.6]])
    assert not whole.weights_at(points).any()
    near = whole.rest[:3] + torch.tensor([0, 0, 1e-3])
    assert whole.weights_at(near).any(1).all()
    assert not whole.weights_at(near, max_distance=1e-9).any(1).all()
    assert whole.weights_at(near[:0]).shape == (0, 24)


# --- derivatives ----------------------------------------------------------------------------------


def test_derivatives_against_finite_differences() -> None:
    body, posed = bent_tube()
    field = small(torch.float64)
    points = around(body.v_template, body.faces, 60, 0.08)
    cell, found = field.search(points, 0.2)
    points, cell = points[found], cell[found]
    q = (points - points.new_tensor(field.grid.lo)) / field.grid.voxel % 1
    inner = ((q > 0.01) & (q < 0.99)).all(-1)  # the derivative jumps from cell to cell
    points, cell = points[inner], cell[inner]
    maps = field.maps(posed.transforms)

    def image(p: Tensor) -> Tensor:
        return field.at(p, cell, maps).image

    columns = []
    for axis in range(3):
        shift = 1e-6 * torch.eye(3, dtype=points.dtype)[axis]
        columns.append((image(points + shift) - image(points - shift)) / 2e-6)
    jacobian = field.at(points, cell, maps).jacobian()
    torch.testing.assert_close(jacobian, torch.stack(columns, -1), atol=1e-6, rtol=0)
    assert torch.autograd.gradcheck(field.weights_at, points.requires_grad_(), fast_mode=True)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("backend", ["torch", "auto"])
def test_gradients_in_points_and_pose(method: str, backend: str) -> None:
    body, posed = bent_tube()
    field = small(torch.float64, backend)
    rest = around(body.v_template, body.faces, 4, 0.02)
    points = skin(rest, blend_transforms(posed.transforms, field.weights_at(rest)))

    def invert(p: Tensor, transforms: Tensor) -> tuple[Tensor, Tensor]:
        moved = replace(posed, transforms=transforms)
        steps = 150 if method == "fixed_point" else None
        found = inverse_skin(p, moved, body, method, rest_verts=field, iterations=steps)
        return found.points, found.weights

    inputs = (points.requires_grad_(), posed.transforms.clone().requires_grad_())
    assert torch.autograd.gradcheck(invert, inputs, eps=1e-6, atol=1e-5, fast_mode=True)


# --- inverse skinning -----------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_residual_is_the_cycle_of_the_float64_loop(method: str, whole: DiffusedField) -> None:
    body = BodyModel.default()
    posed = pose_of(body, 0.2 * torch.randn(24, 3))
    points = around(posed.verts, body.faces, 300)
    found = inverse_skin(points, posed, body, method, rest_verts=whole)
    weights = whole.weights_at(found.points).double()
    arrays = (found.points.double(), weights, posed.transforms.double())
    cycle = oracles.linear_blend_skinning(*(a.numpy() for a in arrays))
    expected = np.linalg.norm(cycle - points.double().numpy(), axis=-1)
    reached = found.residual.isfinite().numpy()
    assert reached.mean() > 0.98
    np.testing.assert_allclose(found.residual.numpy()[reached], expected[reached], atol=3e-6)
    assert torch.equal(found.valid, found.residual <= 1e-3)
    if method in ITERATIVE:
        torch.testing.assert_close(found.weights.double(), weights, atol=1e-4, rtol=0)


def test_more_points_are_valid_than_with_weights_of_the_surface(whole: DiffusedField) -> None:
    body = BodyModel.default()
    for spread in (0.1, 0.2, 0.3):
        posed = pose_of(body, spread * torch.randn(24, 3))
        points = around(posed.verts, body.faces, 1500, 0.05)
        smooth = inverse_skin(points, posed, body, rest_verts=whole)
        assert share(smooth.residual <= 1e-5) >= 0.99
        assert smooth.valid.sum() >= inverse_skin(points, posed, body).valid.sum()


@pytest.mark.parametrize("gradients", [True, False])
def test_kernel_and_twin_agree(whole: DiffusedField, gradients: bool) -> None:
    body = BodyModel.default()
    posed = pose_of(body, 0.2 * torch.randn(24, 3))
    points = around(posed.verts, body.faces, 1000)
    guess = inverse_skin(points, posed, body, "surface").points
    maps, bones = whole.maps(posed.transforms), Bones.of(posed.joints, posed.transforms)
    for steps, starts in ((0, 1), (2, 1), (8, 3)):
        plan = Plan(steps, starts, 0.2, 5e-6, gradients)
        fast, weights = newton_cells(whole, points, maps, bones, plan, guess)
        plain = newton_torch(whole, points, maps, bones, plan, guess)
        close = (fast.points - plain.points).norm(dim=-1) < 2e-5
        assert share(close) >= 0.985  # roots at folds may be taken otherwise
        torch.testing.assert_close(
            fast.residual[close], plain.residual[close], atol=2e-5, rtol=0, equal_nan=True
        )
        expected = whole.weights_on(fast.points, fast.face, whole.rest)
        expected = expected * fast.residual.isfinite()[:, None]
        torch.testing.assert_close(weights, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("method", METHODS)
def test_back_ends_agree(method: str) -> None:
    body, posed = bent_tube(torch.float32)
    points = around(posed.verts, body.faces, 150)
    warp, plain = (
        inverse_skin(points, posed, body, method, rest_verts=small(torch.float32, b))
        for b in ("warp", "torch")
    )
    close = (warp.points - plain.points).norm(dim=-1) < 5e-5
    assert share(close) >= 0.97 and share(warp.valid == plain.valid) >= 0.97
    torch.testing.assert_close(warp.weights[close], plain.weights[close], atol=5e-4, rtol=0)


@pytest.mark.parametrize("method", METHODS)
def test_no_point_one_point_and_points_out_of_reach(method: str) -> None:
    body, posed = bent_tube(torch.float32)
    field = small(torch.float32)
    for count in (0, 1):
        points = posed.verts[20 : 20 + count].clone().requires_grad_()
        found = inverse_skin(points, posed, body, method, rest_verts=field)
        assert found.points.shape == (count, 3) and found.weights.shape == (count, 3)
        found.points.sum().backward()
        assert points.grad is not None and points.grad.isfinite().all()
    far = posed.verts[:3] + torch.tensor([5.0, 0, 0])
    found = inverse_skin(far, posed, body, method, rest_verts=field)
    assert not found.valid.any() and found.points.isfinite().all()
    assert found.residual.isinf().all() and found.weights.isfinite().all()


# --- what is kept ---------------------------------------------------------------------------------


def test_the_field_of_a_body_is_kept_and_dies_with_it() -> None:
    body = tube(torch.float32)
    options: dict[str, float] = {"voxel": 0.05, "reach": 0.12}
    first = DiffusedField.of(body, **options)
    assert DiffusedField.of(body, body.v_template.clone(), **options) is first
    wide = DiffusedField.of(body, body.v_template * 1.1, **options)
    assert wide is not first and not torch.equal(wide.rest, first.rest)
    finer = DiffusedField.of(body, voxel=0.04, reach=0.12)
    assert finer.grid.voxel == 0.04
    assert DiffusedField.of(body, backend="torch", **options).backend == "torch"
    ghost = weakref.ref(DiffusedField.of(body, **options))
    del body, first, wide, finer
    gc.collect()
    assert ghost() is None


@pytest.mark.parametrize(
    ("voxel", "reach"), [(0.0, 0.1), (0.06, 0.1), (0.01, float("inf")), (float("nan"), 0.1)]
)
def test_grids_that_cannot_be(voxel: float, reach: float) -> None:
    with pytest.raises(InputError, match="voxel, reach: expected 0 < 2 voxel <= reach"):
        DiffusedField(tube(torch.float32), voxel=voxel, reach=reach)


def test_grids_too_large() -> None:
    body = tube(torch.float32)
    with pytest.raises(InputError, match="voxel: expected a grid of at most"):
        DiffusedField(body, body.v_template * 1000)
    with pytest.raises(InputError, match="rest_verts: expected 106 vertices"):
        DiffusedField(body, torch.zeros(5, 3))


def test_gradients_to_rest_vertices_are_none() -> None:
    """The grid is a constant; a shape that asks for gradients may still build one."""
    body, posed = bent_tube(torch.float32)
    rest = body.v_template.clone().requires_grad_()
    field = DiffusedField(body, rest, voxel=0.05, reach=0.12)
    points = posed.verts[:5].clone().requires_grad_()
    inverse_skin(points, posed, body, rest_verts=field).points.sum().backward()
    assert points.grad is not None and points.grad.abs().sum() > 0 and rest.grad is None
