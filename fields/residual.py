"""Non-rigid residuals in surface-time space (u, v, t), per part (MonoPartNeRF, eqs. 1 and 2)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .hash_grid import GridSpec, HashGrid
from .mlp import PartMLP

UVT_GRID = GridSpec(levels=8, features=2, log2_size=14, base=4, growth=1.38)
"""The encoding of (u, v, t) in METHOD section 3."""


class ResidualField(torch.nn.Module):
    """s * tanh(MLP(enc(x), part)): a bounded offset, zero at the start.

    ``x`` is (u, v, t) of the surface point below a sample, or any other coordinates in [0, 1].

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
    ) -> None:
        """Make one grid and one network per part.

        Args:
            parts: number of parts.
            scale: largest offset per axis, metres.
            grid: the encoding.
            hidden: width of the two hidden layers.
        """
        super().__init__()
        self.scale = scale
        self.grid = HashGrid([grid] * parts)
        self.mlp = PartMLP(parts, (self.grid.out_features + 3, hidden, hidden, 3), zero_last=True)

    def forward(
        self, coordinates: Float[Tensor, "n 3"], part: Int[Tensor, "n"], counts: Sequence[int]
    ) -> Float[Tensor, "n 3"]:
        """Offsets of pairs sorted by part.

        Args:
            coordinates: (u, v, t) in [0, 1].
            part: part of each row, ascending.
            counts: rows of each part.

        Returns:
            Offsets in metres, each component within (-scale, scale); differentiable in the inputs.
        """
        encoded = torch.cat([self.grid(coordinates, part), coordinates], -1)
        return self.scale * torch.tanh(self.mlp(encoded, counts))
