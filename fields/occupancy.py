"""Which canonical cells of each part are empty, learned from the samples that training evaluates."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


class PartOccupancy(torch.nn.Module):
    """A slowly falling maximum of the density seen in each cell; cells never seen count as full.

    Skipping empty cells is approximate: a cell is empty when light loses less than ``threshold``
    of itself over one sample.

    >>> occupancy = PartOccupancy(torch.zeros(1, 3), torch.ones(1), cells=4)
    >>> point, part = torch.full((1, 3), 0.5), torch.zeros(1, dtype=torch.long)
    >>> before = bool(occupancy.keep(point, part, 1.0))
    >>> occupancy.see(point, part, torch.zeros(1))
    >>> before, bool(occupancy.keep(point, part, 1.0))
    (True, False)
    """

    lo: Tensor
    edge: Tensor
    peak: Tensor

    def __init__(
        self,
        lo: Float[Tensor, "k 3"],
        edge: Float[Tensor, "k"],
        cells: int = 96,
        decay: float = 0.9,
    ) -> None:
        """Make the cells.

        Args:
            lo: lower corner of each part's canonical cube, metres.
            edge: edge of each part's cube, metres.
            cells: cells along an edge.
            decay: factor of the remembered maximum each time a cell is seen.
        """
        super().__init__()
        self.cells, self.decay = cells, decay
        self.register_buffer("lo", lo.clone(), persistent=False)
        self.register_buffer("edge", edge.clone(), persistent=False)
        self.register_buffer("peak", torch.full((len(lo) * cells**3,), torch.inf))

    def _cell(self, points: Tensor, part: Tensor) -> Tensor:
        place = (points - self.lo[part]) / self.edge[part, None] * self.cells
        x, y, z = place.long().clamp(0, self.cells - 1).unbind(-1)
        return ((part * self.cells + z) * self.cells + y) * self.cells + x

    def keep(
        self, points: Float[Tensor, "n 3"], part: Int[Tensor, "n"], density: float
    ) -> Bool[Tensor, "n"]:
        """Whether the cell of a point may hold more than a density.

        Args:
            points: canonical points, metres.
            part: part of each point.
            density: 1/m.
        """
        return self.peak[self._cell(points, part)] > density

    @torch.no_grad()
    def see(
        self, points: Float[Tensor, "n 3"], part: Int[Tensor, "n"], sigma: Float[Tensor, "n"]
    ) -> None:
        """Remember densities: the cell's value becomes max(decay * value, largest sigma seen now).

        Args:
            points: canonical points that were evaluated, metres.
            part: part of each point.
            sigma: their densities, 1/m.
        """
        cell = self._cell(points, part)
        old = self.peak[cell]
        self.peak[cell] = torch.where(old.isinf(), 0.0, old * self.decay)
        self.peak.scatter_reduce_(0, cell, sigma.detach(), "amax")
