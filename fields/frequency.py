"""Frequency encoding, for view directions."""

import torch
from jaxtyping import Float
from torch import Tensor

from monopart.geometry.errors import InputError


class FrequencyEncoding(torch.nn.Module):
    """Sines and cosines at octaves 1, 2, 4, … rad per unit, with the raw input in front.

    Reference: Mildenhall et al., NeRF, 2020, eq. 4 (without the factor π, for unit vectors).

    >>> FrequencyEncoding(3, octaves=4)(torch.zeros(2, 3)).shape
    torch.Size([2, 27])
    """

    def __init__(self, in_features: int, octaves: int, include_raw: bool = True):
        """Fix the sizes; there is nothing to learn.

        Args:
            in_features: columns of the input.
            octaves: number of frequencies; 0 leaves the raw input.
            include_raw: put the input in front.

        Raises:
            InputError: an encoding without columns.
        """
        super().__init__()
        if in_features < 1 or octaves < 0 or (octaves == 0 and not include_raw):
            raise InputError(
                f"FrequencyEncoding: expected one column or more, found "
                f"in_features={in_features}, octaves={octaves}, include_raw={include_raw}"
            )
        self.in_features = in_features
        self.octaves = octaves
        self.include_raw = include_raw

    @property
    def out_features(self) -> int:
        """Columns of the result."""
        return self.in_features * (2 * self.octaves + self.include_raw)

    def forward(self, x: Float[Tensor, "*b in"]) -> Float[Tensor, "*b out"]:
        """Encode; the columns are raw, then sin, then cos (axis by axis, octaves ascending).

        Args:
            x: any leading batch.

        Returns:
            The encoding; differentiable in x.
        """
        if x.shape[-1] != self.in_features:
            raise InputError(
                f"FrequencyEncoding x: expected {self.in_features} columns, found {x.shape[-1]}"
            )
        octaves = 2.0 ** torch.arange(self.octaves, device=x.device, dtype=x.dtype)
        angles = (x[..., None] * octaves).flatten(-2)
        raw = (x,) if self.include_raw else ()
        return torch.cat((*raw, angles.sin(), angles.cos()), dim=-1)
