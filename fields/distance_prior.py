"""A density that starts as the body: the signed distance to the canonical surface on a grid."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from monopart.geometry.culling import BodyShell
from monopart.geometry.errors import InputError
from monopart.geometry.surface import SurfaceIndex, signed_distance, vertex_normals


class DistancePrior(torch.nn.Module):
    """Trilinear signed distance to a fixed surface, clamped to ±reach.

    >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    >>> faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    >>> prior = DistancePrior(verts, faces, reach=0.2, cell=0.05)
    >>> bool(prior(torch.tensor([[0.2, 0.2, 0.2]])) < 0)
    True
    """

    lo: Tensor
    extent: Tensor
    values: Tensor

    def __init__(
        self,
        verts: Float[Tensor, "v 3"],
        faces: Int[Tensor, "f 3"],
        reach: float = 0.12,
        cell: float = 0.01,
        values: Float[Tensor, "z y x"] | None = None,
    ) -> None:
        """Sample the distance on a grid.

        Args:
            verts: canonical vertices, metres.
            faces: triangles, counter-clockwise from outside.
            reach: distances beyond it are clamped, metres.
            cell: edge of a grid cell, metres.
            values: the nodes of an earlier instance with the same arguments (its ``values[0, 0]``),
                where a caller kept them; nothing is then sampled.

        Raises:
            InputError: not 0 < cell <= reach, or values of another grid.
        """
        super().__init__()
        if not 0 < cell <= reach:
            raise InputError(
                f"reach, cell: expected 0 < cell <= reach in metres, found {reach}, {cell}; "
                "a cell of a tenth of the reach is usual"
            )
        verts = verts.detach().float()
        lo = verts.amin(0) - reach
        steps = ((verts.amax(0) + reach - lo) / cell).ceil().long() + 1
        self.register_buffer("lo", lo, persistent=False)
        self.register_buffer("extent", (steps - 1) * cell, persistent=False)
        if values is None:
            values = _sampled(verts, faces, lo, steps, reach, cell)
        shape = tuple(steps.flip(0).tolist())
        if values.shape != shape or values.dtype != torch.float32:
            raise InputError(
                f"values: expected a float32 grid of {shape}, found {values.dtype} of "
                f"{tuple(values.shape)}; leave them out, then they are sampled"
            )
        self.register_buffer("values", values[None, None], persistent=False)

    def forward(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Signed distance, metres, negative inside.

        Args:
            points: canonical points, metres; outside the grid the border value holds.

        Returns:
            Distances, clamped to ±reach; differentiable in points.
        """
        place = 2 * (points - self.lo) / self.extent - 1
        sampled = functional.grid_sample(
            self.values, place[None, None, None], padding_mode="border", align_corners=True
        )
        return sampled.reshape(-1)


def _sampled(
    verts: Tensor, faces: Tensor, lo: Tensor, steps: Tensor, reach: float, cell: float
) -> Tensor:
    """Clamped signed distance at the nodes of the grid, [Z, Y, X]."""
    axes = [lo[a] + cell * torch.arange(int(steps[a]), device=lo.device) for a in range(3)]
    z, y, x = torch.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    nodes = torch.stack([x, y, z], -1).reshape(-1, 3)
    near = BodyShell(verts, faces, reach).occupied(nodes)
    found = nodes[near]
    hit = SurfaceIndex(verts, faces).query(found, max_distance=reach)
    distance = torch.full_like(nodes[:, 0], torch.inf)
    distance[near] = signed_distance(found, hit, vertex_normals(verts, faces), faces)
    return _fill_unknown(distance.reshape(z.shape), reach).clamp(-reach, reach)


def _fill_unknown(distance: Tensor, reach: float) -> Tensor:
    """Nodes beyond the reach (infinite) get ±reach: the side of the last known node along x.

    A row of nodes starts outside, and to change sides it has to pass nodes within the reach.
    """
    known = distance.isfinite()
    place = torch.arange(distance.shape[-1], device=distance.device).expand_as(distance)
    last = torch.where(known, place, -1).cummax(-1).values
    side = torch.where(last < 0, 1.0, distance.gather(-1, last.clamp(min=0)).sign())
    return torch.where(known, distance, reach * side)
