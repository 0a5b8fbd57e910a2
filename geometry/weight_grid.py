"""A sparse grid of skinning weights around a rest surface, filled by diffusion from it.

Nodes next to the surface hold the weights of their closest surface point. All others, inside and
outside, solve the Laplace equation of the grid: each is the mean of its neighbours, so weights stay
in [0, 1] and sum to 1, and no part of the space is nearer to a seam of the closest point than to
its surroundings. Solved coarse to fine, by sweeps over the two colours of a checkerboard.
Reference: I. Baran, J. Popović, Automatic Rigging and Animation of 3D Characters, 2007, section 4
(weights as the equilibrium of heat).
"""

import itertools
import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .errors import InputError
from .surface import SurfaceIndex

_SWEEPS = 30  # of each level; coarser levels have carried the long waves
_BLOCK = 4  # nodes per side of the blocks that are searched first
_MOST = 1 << 27  # places of the grid, empty ones included


@dataclass(frozen=True)
class WeightGrid:
    """Weights on the nodes of a regular grid that lie near a surface.

    Attributes:
        lo: lowest node of the box, metres.
        size: nodes of the box along x, y, z.
        voxel: distance of neighbours, metres.
        slots: [X·Y·Z] int32 cell above each place of the box (x fastest), -1 where there is none.
        cells: [C, 8] int32 nodes at the corners of each cell; corner bit 0 is x, 1 is y, 2 is z.
        weights: [M, J] skinning weights of the nodes.
        distance: [M] distance of the nodes to the surface, metres.
    """

    lo: tuple[float, float, float]
    size: tuple[int, int, int]
    voxel: float
    slots: Int[Tensor, "places"]
    cells: Int[Tensor, "c 8"]
    weights: Float[Tensor, "m J"]
    distance: Float[Tensor, "m"]

    def locate(self, points: Float[Tensor, "n 3"]) -> tuple[Int[Tensor, "n"], Bool[Tensor, "n"]]:
        """Cell of points (0 where there is none), and whether there is one."""
        q = ((points.detach() - points.new_tensor(self.lo)) / self.voxel).floor()
        limit = points.new_tensor(self.size)
        inside = ((q >= 0) & (q < limit)).all(-1)
        x, y, z = torch.where(inside[:, None], q, 0.0).long().unbind(-1)
        cell = self.slots[(z * self.size[1] + y) * self.size[0] + x]
        found = inside & (cell >= 0)
        return torch.where(found, cell, 0).long(), found

    def shares(
        self, points: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 8"], Float[Tensor, "n 8 3"]]:
        """Trilinear weights of the corners of the cells of points, and their gradients, 1/metre.

        The weights are differentiable in the points, the cell held; those of a point that is not
        finite are the ones of the lowest node, without gradient.
        """
        lo = points.new_tensor(self.lo)
        q = (torch.where(points.isfinite().all(-1, keepdim=True), points, lo) - lo) / self.voxel
        q = q - q.detach().floor()
        sides = torch.stack([1 - q, q], 1)  # n 2 3
        low, high = [0, 1] * 4, [0, 0, 1, 1] * 2
        x, y, z = sides[:, low, 0], sides[:, high, 1], sides[:, [0] * 4 + [1] * 4, 2]
        sign = torch.tensor([-1.0, 1.0], dtype=points.dtype, device=points.device)
        sx, sy, sz = sign[low], sign[high], sign[[0] * 4 + [1] * 4]
        slopes = torch.stack([sx * y * z, x * sy * z, x * y * sz], -1)
        return x * y * z, slopes / self.voxel

    def mix(
        self, cell: Int[Tensor, "n"], shares: Float[Tensor, "n 8"], values: Float[Tensor, "m d"]
    ) -> Float[Tensor, "n d"]:
        """Values of the nodes at points, given their cells and `shares`."""
        corners = self.cells[cell]
        total = values[corners[:, 0]] * shares[:, :1]
        for c in range(1, 8):
            total = total + values[corners[:, c]] * shares[:, c : c + 1]
        return total


def diffuse_weights(
    surface: SurfaceIndex,
    weights: Float[Tensor, "V J"],
    voxel: float,
    reach: float,
) -> WeightGrid:
    """Fill a grid around a surface with the weights of its vertices.

    Args:
        surface: search structure of the rest surface; its back end runs the sweeps.
        weights: skinning weights of the vertices.
        voxel: distance of neighbouring nodes, metres.
        reach: nodes up to this distance from the surface are kept, metres.

    Returns:
        The grid; nothing is differentiable.

    Raises:
        InputError: sizes that are not positive, or a grid too large.
    """
    if not (0 < voxel <= reach / 2 and math.isfinite(reach)):
        raise InputError(
            f"voxel, reach: expected 0 < 2 voxel <= reach in metres, found {voxel}, {reach}; use "
            "0.015 and 0.1"
        )
    with torch.no_grad():
        return _level(surface, weights, voxel, reach)


def _level(surface: SurfaceIndex, weights: Tensor, voxel: float, reach: float) -> WeightGrid:
    verts = surface.verts.detach()
    low = verts.amin(0) - reach - voxel
    extent = ((verts.amax(0) + reach + voxel - low) / voxel).ceil().clamp(max=1e9)
    x, y, z = (int(n) + 1 for n in extent.tolist())
    size = (x, y, z)
    if math.prod(size) > _MOST:
        raise InputError(
            f"voxel: expected a grid of at most {_MOST} places, found {x} x {y} x {z}; "
            "use a larger voxel (metres)"
        )
    place = _near_places(surface, low, size, voxel, reach)
    node = torch.full((math.prod(size),), -1, dtype=torch.int32, device=low.device)
    node[place] = torch.arange(len(place), dtype=torch.int32, device=low.device)
    points = low + voxel * _position(place, size).to(low)
    hit = surface.query(points)
    corners = surface.faces[hit.face]
    values = (weights[corners] * hit.bary[..., None]).sum(1)
    cells = torch.stack([node[place + s] for s in _corner_steps(size)], 1)
    cells = cells[(cells >= 0).all(1)]
    slots = torch.full_like(node, -1)
    slots[place[cells[:, 0].long()]] = torch.arange(
        len(cells), dtype=torch.int32, device=low.device
    )
    lo = (float(low[0]), float(low[1]), float(low[2]))
    grid = WeightGrid(lo, size, voxel, slots, cells, values, hit.distance)
    free = hit.distance > math.sqrt(3) * voxel
    _start_from_coarse(surface, weights, grid, points, free, reach)
    _relax(surface.backend, grid, node, place, free)
    grid.weights.div_(grid.weights.sum(1, keepdim=True))  # sweeps round the sum away from 1
    return grid


def _near_places(
    surface: SurfaceIndex, low: Tensor, size: tuple[int, ...], voxel: float, reach: float
) -> Tensor:
    """Flat places of the nodes within reach, in ascending order; whole blocks are tried first."""
    blocks = tuple(-(-n // _BLOCK) for n in size)
    every = torch.arange(math.prod(blocks), device=low.device)
    corner = _position(every, blocks) * _BLOCK
    middle = low + voxel * (corner + (_BLOCK - 1) / 2).to(low)
    margin = voxel * math.sqrt(3) * (_BLOCK - 1) / 2 * (1 + 1e-4)
    corner = corner[surface.query(middle, reach + margin).found]
    inside = _position(torch.arange(_BLOCK**3, device=low.device), (_BLOCK,) * 3)
    nodes = (corner[:, None] + inside).flatten(0, 1)
    limit = torch.tensor(size, device=low.device)
    nodes = nodes[(nodes < limit).all(1)]
    near = surface.query(low + voxel * nodes.to(low), reach).found
    x, y, z = nodes[near].unbind(-1)
    return ((z * size[1] + y) * size[0] + x).sort().values


def _position(place: Tensor, size: tuple[int, ...]) -> Tensor:
    """Node x, y, z of flat places."""
    x, rest = place % size[0], place // size[0]
    return torch.stack([x, rest % size[1], rest // size[1]], -1)


def _corner_steps(size: tuple[int, ...]) -> list[int]:
    return [
        x + y * size[0] + z * size[0] * size[1] for z, y, x in itertools.product((0, 1), repeat=3)
    ]


def _start_from_coarse(
    surface: SurfaceIndex,
    weights: Tensor,
    grid: WeightGrid,
    points: Tensor,
    free: Tensor,
    reach: float,
) -> None:
    """Overwrite the weights of the free nodes by those of a grid of twice the voxel."""
    if 8 * grid.voxel > reach:
        return
    coarse = _level(surface, weights, 2 * grid.voxel, reach + 4 * grid.voxel)
    cell, found = coarse.locate(points)
    rows = (free & found).nonzero().squeeze(-1)
    grid.weights[rows] = coarse.mix(cell[rows], coarse.shares(points[rows])[0], coarse.weights)


def _relax(backend: str, grid: WeightGrid, node: Tensor, place: Tensor, free: Tensor) -> None:
    """Sweep over the free nodes, one colour of the checkerboard after the other, in place."""
    sx, sy = grid.size[0], grid.size[0] * grid.size[1]
    steps = (-1, 1, -sx, sx, -sy, sy)
    neighbours = torch.stack([node[place + s] for s in steps], 1).contiguous()
    odd = _position(place, grid.size).sum(-1) % 2 == 1
    colours = [(free & c).nonzero().squeeze(-1) for c in (odd, ~odd)]
    fast = backend == "warp" and grid.weights.dtype == torch.float32
    sweep = sweep_warp if fast else sweep_torch
    for _ in range(_SWEEPS):
        for rows in colours:
            sweep(rows, neighbours, grid.weights)


def sweep_torch(
    rows: Int[Tensor, "r"], neighbours: Int[Tensor, "m 6"], weights: Float[Tensor, "m J"]
) -> None:
    """Replace the weights of some nodes, no two of them neighbours, by the mean around them.

    Args:
        rows: the nodes.
        neighbours: nodes next to each node, -1 where there is none.
        weights: weights of all nodes, changed in place.
    """
    around = neighbours[rows]
    there = around >= 0
    count = there.sum(1, keepdim=True)
    total = (weights[around.clamp(min=0)] * there[..., None]).sum(1)
    weights[rows] = torch.where(count > 0, total / count.clamp(min=1), weights[rows])


def sweep_warp(
    rows: Int[Tensor, "r"], neighbours: Int[Tensor, "m 6"], weights: Float[Tensor, "m J"]
) -> None:
    """The kernel of :func:`sweep_torch`.

    Args:
        rows: the nodes.
        neighbours: nodes next to each node, int32, -1 where there is none.
        weights: float32 weights of all nodes, changed in place.
    """
    from .kernels.diffused import relax
    from .kernels.launch import launch, view

    args = [view(rows.int()), view(neighbours), view(weights)]
    launch(relax, len(rows), args, weights)
