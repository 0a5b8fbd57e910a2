"""What training has seen of the density of each part's canonical cells: empty, or opaque."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_GROWTH = 1.05  # of a remembered minimum, each time its cell is seen


class PartOccupancy(torch.nn.Module):
    """A slowly falling maximum and a slowly rising minimum of the density seen in each cell.

    Where the maximum is small a sample may be skipped; where minima in front of a sample add up to
    an opaque wall, it cannot be seen. Both are approximate. A cell that was never seen counts as
    neither empty nor opaque.

    >>> occupancy = PartOccupancy(torch.zeros(1, 3), torch.ones(1), cells=4)
    >>> point, part = torch.full((1, 3), 0.5), torch.zeros(1, dtype=torch.long)
    >>> cell = occupancy.cells_of(point, part)
    >>> before = bool(occupancy.keep(cell, 1.0))
    >>> occupancy.see(cell, torch.zeros(1))
    >>> before, bool(occupancy.keep(cell, 1.0))
    (True, False)
    """

    lo: Tensor
    edge: Tensor
    peak: Tensor
    floor: Tensor

    def __init__(
        self,
        lo: Float[Tensor, "k 3"],
        edge: Float[Tensor, "k"],
        cells: int = 64,
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
        self.register_buffer("floor", torch.zeros(len(lo) * cells**3))

    def cells_of(self, points: Float[Tensor, "n 3"], part: Int[Tensor, "n"]) -> Int[Tensor, "n"]:
        """Flat index of the cell of each canonical point in the grid of its part.

        Args:
            points: canonical points, metres.
            part: part of each point.

        Returns:
            Indices into ``peak`` and ``floor``; points outside, however far, belong to the nearest
            border cell. One that is NaN is given some cell.
        """
        place = (points - self.lo[part]) * (self.cells / self.edge)[part, None]
        # clamped as floats, which a whole number may not hold, and again for NaN
        place = place.clamp_(-1, self.cells).long().clamp_(0, self.cells - 1)
        x, y, z = place.unbind(-1)
        return ((part * self.cells + z) * self.cells + y) * self.cells + x

    def keep(self, cell: Int[Tensor, "n"], density: float) -> Bool[Tensor, "n"]:
        """Whether a cell may hold more than a density.

        Args:
            cell: from :meth:`cells_of`.
            density: 1/m.

        Returns:
            False only where training has seen less than this density.
        """
        return self.peak[cell] > density

    @torch.no_grad()
    def see(self, cell: Int[Tensor, "n"], sigma: Float[Tensor, "n"]) -> None:
        """Remember densities.

        Args:
            cell: cells of the points that were evaluated.
            sigma: their densities, 1/m.
        """
        sigma = sigma.detach()
        unknown = ~sigma.isfinite()  # may be dense, may be empty: never skipped, never a wall
        top, bottom = sigma.masked_fill(unknown, torch.inf), sigma.masked_fill(unknown, 0.0)
        old, low = self.peak[cell], self.floor[cell]
        first = old.isinf()
        self.peak[cell] = torch.where(first, 0.0, old * self.decay)
        self.peak.scatter_reduce_(0, cell, top, "amax")
        self.floor[cell] = torch.where(first, torch.inf, low * _GROWTH)
        self.floor.scatter_reduce_(0, cell, bottom, "amin")


def visible_samples(
    wall: Float[Tensor, "n"], ray_start: Int[Tensor, "r1"], ray: Int[Tensor, "n"], limit: float
) -> Bool[Tensor, "n"]:
    """Samples with less than a given optical depth in front of them.

    Args:
        wall: optical depth of each sample (density times step), a lower bound; infinity is opaque,
            NaN is no wall.
        ray_start: first sample of each ray, and the end.
        ray: ray of each sample.
        limit: optical depth beyond which nothing is seen; 10 leaves 5e-5 of the light.

    Returns:
        [N] True for the samples that light reaches.

    >>> wall, ray = torch.tensor([6.0, 6.0, 6.0, 1.0]), torch.tensor([0, 0, 0, 1])
    >>> visible_samples(wall, torch.tensor([0, 3, 4]), ray, 10.0).tolist()
    [True, True, False, True]
    """
    # more than the limit blocks as the limit does, and an infinite sum would end all rays behind it
    wall = wall.double().nan_to_num(nan=0.0).clamp(max=limit)
    total = wall.cumsum(0)
    before = total - wall
    base = torch.cat([total.new_zeros(1), total])[ray_start[:-1]]
    return before - base[ray.long()] < limit
