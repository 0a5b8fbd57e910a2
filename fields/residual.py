"""Non-rigid residuals over surface and time or space and time (MonoPartNeRF, eqs. 1 and 2)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from monopart.geometry.errors import InputError

from .hash_grid import GridSpec, HashGrid
from .mlp import PartMLP

UVT_GRID = GridSpec(levels=8, features=2, log2_size=14, base=4, growth=1.38)
"""The encoding of (u, v, t) in METHOD section 3."""

_AXES = {3: ([0, 1, 2],), 4: ([0, 1, 3], [1, 2, 3], [2, 0, 3])}  # axes of each grid


class ResidualField(torch.nn.Module):
    """s * tanh(MLP(enc(x), part)): a bounded offset, zero at the start.

    ``x`` is (u, v, t) of the surface point below a sample, or any other three coordinates in
    [0, 1]. With four, such as (x, y, z, t), the encoding is the sum of three grids, over
    (x, y, t), (y, z, t) and (z, x, t), as hash grids have three axes.

    >>> field = ResidualField(parts=2)
    >>> x = torch.rand(3, 3)
    >>> field(x, torch.tensor([0, 0, 1]), (2, 1)).abs().max().item()
    0.0
    """

    def __init__(
        self,
        parts: int,
        scale: float = 0.05,
        grid: GridSpec = UVT_GRID,
        hidden: int = 32,
        axes: int = 3,
    ) -> None:
        """Make one grid and one network per part.

        Args:
            parts: number of parts.
            scale: largest offset per axis, metres.
            grid: the encoding.
            hidden: width of the two hidden layers.
            axes: coordinates of a row, 3 or 4.

        Raises:
            InputError: another number of axes.
        """
        super().__init__()
        if axes not in _AXES:
            raise InputError(f"axes: expected 3 (u, v, t) or 4 (x, y, z, t), found {axes}")
        self.scale, self.axes, self.parts = scale, axes, parts
        self.grid = HashGrid([grid] * parts * len(_AXES[axes]))
        width = self.grid.out_features + axes
        self.mlp = PartMLP(parts, (width, hidden, hidden, 3), zero_last=True)

    def encode(
        self, coordinates: Float[Tensor, "n c"], part: Int[Tensor, "n"]
    ) -> Float[Tensor, "n w"]:
        """Grid features of coordinates, and the coordinates themselves.

        Args:
            coordinates: in [0, 1].
            part: part of each row.
        """
        if coordinates.shape[1] != self.axes:
            raise InputError(
                f"coordinates: expected {self.axes} columns, found {coordinates.shape[1]}; "
                "the field was made for another input"
            )
        if self.axes == 3:
            return torch.cat([self.grid(coordinates, part), coordinates], -1)
        planes = torch.cat([coordinates[:, axes] for axes in _AXES[4]])
        which = torch.cat([part + self.parts * i for i in range(len(_AXES[4]))])
        features = self.grid(planes, which).unflatten(0, (len(_AXES[4]), len(part))).sum(0)
        return torch.cat([features, coordinates], -1)

    def forward(
        self, coordinates: Float[Tensor, "n c"], part: Int[Tensor, "n"], counts: Sequence[int]
    ) -> Float[Tensor, "n 3"]:
        """Offsets of pairs sorted by part.

        Args:
            coordinates: (u, v, t) or (x, y, z, t) in [0, 1].
            part: part of each row, ascending.
            counts: rows of each part.

        Returns:
            Offsets in metres, each component within (-scale, scale); differentiable in the inputs.
        """
        return self.scale * torch.tanh(self.mlp(self.encode(coordinates, part), counts))
