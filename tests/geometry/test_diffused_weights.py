"""Weights on a grid: a partition of unity that is smooth off the surface and can be inverted."""

import dataclasses

import pytest
import torch
from torch import Tensor

from monopart.geometry.body import BodyModel, BodyPose, PosedBody
from monopart.geometry.diffused_weights import DiffusedField
from monopart.geometry.errors import InputError
from monopart.geometry.skinning import blend_transforms, skin
from monopart.geometry.unskin import inverse_skin
from monopart.geometry.weight_grid import sweep_torch, sweep_warp

VOXEL = 0.02


def bent(body: BodyModel, scale: float = 0.4, seed: int = 1) -> PosedBody:
    generator = torch.Generator().manual_seed(seed)
    pose = scale * torch.randn(body.num_joints, 3, generator=generator)
    pose[0] = 0.0
    still = torch.zeros(3)
    full = BodyPose(pose, torch.zeros(body.num_betas), still, still)
    full = BodyPose(*(getattr(full, f.name).to(body.v_template) for f in dataclasses.fields(full)))
    return body(full)


def around(verts: Tensor, count: int, spread: float = 0.02) -> Tensor:
    generator = torch.Generator().manual_seed(7)
    pick = torch.randint(len(verts), (count,), generator=generator)
    return verts[pick] + spread * torch.randn(count, 3, generator=generator).to(verts)


@pytest.fixture(scope="module")
def field() -> DiffusedField:
    return DiffusedField(BodyModel.default(), voxel=VOXEL)


def test_weights_are_a_partition_of_unity(field: DiffusedField) -> None:
    points = around(field.rest, 4000, 0.03)
    weights = field.weights_at(points)
    there = weights.sum(1) > 0
    assert there.float().mean() > 0.95
    assert (weights >= 0).all()
    assert (weights[there].sum(1) - 1).abs().max() < 1e-5
    assert (field.weights_at(points + 5.0) == 0).all()


def test_on_the_surface_they_are_close_to_the_bodys(field: DiffusedField) -> None:
    off = (field.weights_at(field.rest) - field.weights).abs().sum(1) / 2
    finer = DiffusedField(BodyModel.default(), voxel=VOXEL / 2)
    off_finer = (finer.weights_at(field.rest) - field.weights).abs().sum(1) / 2
    assert off.mean() < 0.03 and off.quantile(0.99) < 0.25  # total variation
    assert off_finer.mean() < 0.6 * off.mean()


def test_they_are_continuous_where_the_closest_point_jumps(field: DiffusedField) -> None:
    body = BodyModel.default()
    crotch = body.v_template[:, 1].median()
    generator = torch.Generator().manual_seed(2)
    x = 0.04 * (2 * torch.rand(4000, generator=generator) - 1)
    y = crotch - 0.1 * torch.rand(4000, generator=generator)
    z = 0.02 * torch.randn(4000, generator=generator)
    points = torch.stack([x, y, z], 1)
    step = torch.tensor([1e-4, 0.0, 0.0])
    jump = (field.weights_at(points + step) - field.weights_at(points)).abs().sum(1) / 2
    nearest = super(DiffusedField, field).weights_at
    assert jump.max() < 0.02
    assert jump.max() <= (nearest(points + step) - nearest(points)).abs().sum(1).max() / 2 + 0.02


def test_kernel_and_torch_sweep_alike() -> None:
    generator = torch.Generator().manual_seed(3)
    weights = torch.rand(50, 4, generator=generator)
    neighbours = torch.randint(-1, 25, (50, 6), generator=generator).int()
    rows = torch.arange(25, 50)
    a, b = weights.clone(), weights.clone()
    sweep_torch(rows, neighbours.long(), a)
    sweep_warp(rows, neighbours, b)
    assert torch.allclose(a, b, atol=1e-6)
    sweep_warp(rows[:0], neighbours, b)
    assert torch.allclose(a, b, atol=1e-6)


@pytest.mark.parametrize("method", ["newton", "broyden", "fixed_point"])
def test_points_come_back(field: DiffusedField, method: str) -> None:
    body, posed = BodyModel.default(), bent(BodyModel.default())
    rest = around(body.v_template, 1500, 0.01)
    weights = field.weights_at(rest)
    targets = skin(rest, blend_transforms(posed.transforms, weights))[weights.sum(1) > 0.5]
    found = inverse_skin(targets, posed, body, method, rest_verts=field)
    assert found.valid.float().mean() > (0.95 if method == "fixed_point" else 0.985)
    back = skin(found.points, blend_transforms(posed.transforms, found.weights))
    off = (back - targets).norm(dim=-1)[found.valid]
    assert (off - found.residual[found.valid]).abs().max() < 2e-6
    assert off.max() <= 1e-3
    one = inverse_skin(targets[:1], posed, body, method, rest_verts=field)
    assert torch.allclose(one.points, found.points[:1], atol=1e-5)
    assert len(inverse_skin(targets[:0], posed, body, method, rest_verts=field).points) == 0


def test_kernel_and_torch_find_the_same_roots(field: DiffusedField) -> None:
    body, posed = BodyModel.default(), bent(BodyModel.default(), 0.25)
    points = around(posed.verts, 400, 0.005)
    fast = inverse_skin(points, posed, body, rest_verts=field, starts=1)
    double = body.to(torch.zeros(1, dtype=torch.float64))
    grid = dataclasses.replace(
        field.grid, weights=field.grid.weights.double(), distance=field.grid.distance.double()
    )
    slow_field = DiffusedField.__new__(DiffusedField)
    slow_field.__dict__.update(vars(field))
    slow_field.rest, slow_field.weights = field.rest.double(), field.weights.double()
    slow_field.index = type(field.index)(field.rest.double(), field.faces)
    slow_field._posed, slow_field.grid = None, grid
    posed64 = bent(double, 0.25)
    slow = inverse_skin(points.double(), posed64, double, rest_verts=slow_field, starts=1)
    both = fast.valid & slow.valid
    assert both.float().mean() > 0.95
    same = (fast.points - slow.points).norm(dim=-1)[both] < 1e-4
    assert same.float().mean() > 0.99  # where there are two roots, rounding may choose


def test_gradients_are_those_of_differences(field: DiffusedField) -> None:
    body, posed = BodyModel.default(), bent(BodyModel.default(), 0.2)
    points = around(posed.verts, 60, 0.004)
    x = points.clone().requires_grad_()
    transforms = posed.transforms.clone().requires_grad_()
    moving = dataclasses.replace(posed, transforms=transforms)
    found = inverse_skin(x, moving, body, rest_verts=field)
    direction = torch.randn(found.points.shape, generator=torch.Generator().manual_seed(5))
    of_x, of_t = torch.autograd.grad((found.points * direction)[found.valid].sum(), (x, transforms))
    assert of_x.isfinite().all() and of_t.isfinite().all()
    for axis in range(3):
        step = torch.zeros(3)
        step[axis] = 1e-3
        up = inverse_skin(points + step, posed, body, rest_verts=field)
        down = inverse_skin(points - step, posed, body, rest_verts=field)
        slope = ((up.points - down.points) * direction).sum(-1) / 2e-3
        ok = found.valid & up.valid & down.valid
        close = (slope - of_x[:, axis]).abs() < 0.05 + 0.05 * slope.abs()
        assert close[ok].float().mean() > 0.85  # kinks at the borders of cells


def test_the_field_of_a_body_is_kept_and_bad_sizes_are_named() -> None:
    body = BodyModel.default()
    first = DiffusedField.of(body, voxel=0.04)
    assert DiffusedField.of(body, voxel=0.04) is first
    assert DiffusedField.of(body, voxel=0.05) is not first
    assert DiffusedField.of(body, body.v_template * 1.1, voxel=0.05) is not first
    for voxel, reach in ((0.0, 0.1), (0.1, 0.1), (0.02, float("inf"))):
        with pytest.raises(InputError, match="voxel, reach"):
            DiffusedField(body, voxel=voxel, reach=reach)
    with pytest.raises(InputError, match="larger voxel"):
        DiffusedField(body, voxel=1e-4)
