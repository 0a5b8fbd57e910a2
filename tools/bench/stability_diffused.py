"""Stress of the field of diffused weights: images of points, and their Jacobians."""

import dataclasses
import functools

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.body import BodyModel
from monopart.geometry.diffused_weights import DiffusedField

from .stability_cases import DOUBLE, Family, Inputs, Stress, Way
from .stability_moving import pose_of
from .stability_rotations import Make


def _in_cells(kind: str) -> Make:
    """Points inside of the cells of the grid, or on their borders, with poses of a body."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        field, body = diffused(DOUBLE), BodyModel.default()
        grid = field.grid
        places = (grid.slots >= 0).nonzero()[:, 0]
        at = places[torch.randint(0, len(places), (count,), generator=generator)]
        x, y, z = (
            at % grid.size[0],
            at // grid.size[0] % grid.size[1],
            at // (grid.size[0] * grid.size[1]),
        )
        share = 0.1 + 0.8 * torch.rand(count, 3, generator=generator, dtype=DOUBLE)
        if kind == "nodes":
            share = torch.zeros_like(share)
        points = torch.stack((x, y, z), 1) + share
        points = points * grid.voxel + torch.tensor(grid.lo, dtype=DOUBLE)
        if kind in ("NaN", "infinite"):
            points = torch.full_like(points, torch.nan if kind == "NaN" else torch.inf)
        if kind == "10 m off":
            points = points + 10.0
        fold = {"fold 150°": 2.6, "fold 180°": np.pi}.get(kind, 0.0)
        posed = body(dataclasses.replace(pose_of(0.0 if fold else 0.5, fold)))
        return points, posed.transforms.double()

    return make


@functools.cache
def diffused(dtype: torch.dtype) -> DiffusedField:
    """One coarse field in each precision, of the same numbers."""
    body = BodyModel.default().to(torch.zeros(1, dtype=DOUBLE))
    field = DiffusedField(body, voxel=0.04)
    grid = field.grid
    if dtype == DOUBLE:
        weights, gaps = grid.weights.float().double(), grid.distance.float().double()
    else:
        field = DiffusedField(BodyModel.default(), voxel=0.04)
        weights, gaps = grid.weights.float(), grid.distance.float()
    field.grid = dataclasses.replace(grid, weights=weights, distance=gaps)
    return field


def _image(points: np.ndarray, cells: np.ndarray, low: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """Trilinear mix of the images under the maps of the corners; also of complex points."""
    grid, out = diffused(DOUBLE).grid, np.zeros_like(points)
    q = (points - np.array(grid.lo)) / grid.voxel - low
    for corner in range(8):
        share = np.ones(len(points), points.dtype)
        for axis in range(3):
            share = share * (q[:, axis] if corner >> axis & 1 else 1 - q[:, axis])
        own = maps[cells[:, corner]]
        image = np.einsum("nij,nj->ni", own[..., :3], points) + own[..., 3]
        out = out + share[:, None] * image
    return out


def exact_field(extra: None, points: np.ndarray, transforms: np.ndarray) -> np.ndarray:
    """Images and their Jacobians by complex steps: a polynomial within a cell, so exact."""
    grid = diffused(DOUBLE).grid
    points = np.nan_to_num(points, posinf=0.0)
    low = np.floor((points - np.array(grid.lo)) / grid.voxel + 1e-6)
    inside = np.asarray(((low >= 0) & (low < np.array(grid.size))).all(1))
    x, y, z = np.where(inside[:, None], low, 0).astype(np.int64).T
    slot = grid.slots.numpy()[(z * grid.size[1] + y) * grid.size[0] + x]
    cells = grid.cells.numpy()[np.maximum(slot, 0)]
    maps = np.einsum("mj,jab->mab", grid.weights.numpy(), transforms[:, :3])
    columns = [_image(points, cells, low, maps)]
    for axis in range(3):
        moved = points + 1e-30j * np.eye(3)[axis]
        columns.append(np.imag(_image(moved, cells, low, maps)) / 1e-30)
    return np.concatenate((columns[0], np.stack(columns[1:], 2).reshape(-1, 9)), 1)


def _fields() -> list[Stress]:
    def run(extra: None, points: Tensor, transforms: Tensor) -> tuple[Tensor, Tensor]:
        field = diffused(points.dtype)
        cell, found = field.search(points, torch.inf)
        point = field.at(points, cell, field.maps(transforms))
        weights = field.weights_on(points, cell, field.rest)
        image = torch.where(found[:, None], point.image, 0.0)
        turn = torch.where(found[:, None], point.jacobian().flatten(1), 0.0)
        # weights of the same cell mix the maps of the joints to the linear part
        mixed = torch.einsum("nj,jab->nab", weights, transforms[:, :3, :3])
        off = (mixed - point.linear).detach().flatten(1)
        return torch.cat((image, turn + off * found[:, None]), 1), found

    kinds = ("inside", "fold 150°", "fold 180°", "10 m off", "infinite", "NaN")
    smooth = ("inside", "fold 150°", "fold 180°")
    stress = Stress(
        name="diffused_jacobian",
        title="images under diffused weights, and their Jacobians",
        domain="any point within reach; others are masked; on a border of cells the Jacobian is "
        "that of one of them",
        error="2 m over the voxel: the last place of an image over a cell",
        families=tuple(Family(k, _in_cells(k), smooth=k in smooth, step=1e-7) for k in kinds),
        ways=(Way("monopart", run, True),),
        exact=exact_field,
        scale=lambda extra, exact, p, t: 2 / 0.04,
        wrt=(0, 1),
        rows_apart=False,
        cases=96,
    )

    def image(extra: None, points: Tensor, transforms: Tensor) -> tuple[Tensor, Tensor]:
        found, valid = run(extra, points, transforms)
        return found[:, :3], valid

    borders = Family("on nodes", _in_cells("nodes"), smooth=False)
    plain = dataclasses.replace(
        stress,
        name="diffused_image",
        title="images under diffused weights",
        error="1 m, the size of a body",
        families=(*stress.families, borders),
        ways=(Way("monopart", image, True),),
        exact=lambda extra, p, t: exact_field(extra, p, t)[:, :3],
        scale=lambda extra, exact, p, t: 2.0,
    )
    return [plain, stress]


def stresses() -> list[Stress]:
    """Operations on fields of weights."""
    return _fields()
