"""Radiance fields of the parts: one hash grid and two small networks each (MonoPartNeRF, eq. 7)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from monopart.geometry.errors import InputError

from .hash_grid import GridSpec, HashGrid
from .mlp import PartMLP

Number = int | float


@dataclass(frozen=True)
class PartFieldSpec:
    """Sizes of the fields.

    Attributes:
        levels: resolutions of the hash grid.
        features: features per level.
        log2_size: rows of a level, log2, one number per part or one for all.
        base: cells of the first level along the longest edge of a part's box.
        finest: edge of the finest cells, metres, one number per part or one for all.
        hidden: width of the networks.
        geometry: features handed from the density to the colour network.
        code: length of the appearance feature of a sample.
        light: further columns of that feature, which the colour alone sees.
        sharpness: density in 1/m per unit of softplus.
        density_code: whether the density sees the appearance feature too.
    """

    levels: int = 8
    features: int = 2
    log2_size: int | tuple[int, ...] = 16
    base: int = 16
    finest: float | tuple[float, ...] = 0.003
    hidden: int = 64
    geometry: int = 16
    code: int = 0
    light: int = 0
    sharpness: float = 100.0
    density_code: bool = False

    def grid_specs(self, extent: Sequence[float]) -> list[GridSpec]:
        """Grid of each part from the longest edge of its box, metres."""
        sizes = _each(self.log2_size, len(extent))
        cells = _each(self.finest, len(extent))
        specs = []
        for edge, size, cell in zip(extent, sizes, cells, strict=True):
            last = max(edge / cell, self.base)
            growth = (last / self.base) ** (1 / max(self.levels - 1, 1))
            specs.append(GridSpec(self.levels, self.features, int(size), self.base, growth))
        return specs


def _each(value: Number | tuple[Number, ...], count: int) -> tuple[Number, ...]:
    return value if isinstance(value, tuple) else (value,) * count


class PartField(torch.nn.Module):
    """Density and colour of canonical points, each part with its own grid and networks."""

    lo: Tensor
    edge: Tensor

    def __init__(
        self, lo: Float[Tensor, "k 3"], hi: Float[Tensor, "k 3"], spec: PartFieldSpec
    ) -> None:
        """Make the fields.

        Args:
            lo: lower corners of the parts' canonical boxes, margin included, metres.
            hi: upper corners.
            spec: sizes.

        Raises:
            InputError: a box without extent, or one that is not finite.
        """
        super().__init__()
        if not bool(((hi - lo).amax(-1) > 0).all() and (hi - lo).isfinite().all()):
            raise InputError(
                "PartField lo, hi: expected finite boxes with hi > lo on some axis, found one "
                "without extent; check the boxes"
            )
        parts = len(lo)
        self.spec = spec
        edge = (hi - lo).amax(-1)
        self.register_buffer("lo", lo.clone(), persistent=False)
        self.register_buffer("edge", edge.clone(), persistent=False)
        self.grid = HashGrid(spec.grid_specs(edge.tolist()))
        width = self.grid.out_features
        seen = width + (spec.code if spec.density_code else 0)
        self.density_mlp = PartMLP(parts, (seen, spec.hidden, 1 + spec.geometry))
        inputs = width + spec.geometry + spec.code + spec.light
        self.color_mlp = PartMLP(parts, (inputs, spec.hidden, spec.hidden, 3))

    def encode(self, points: Float[Tensor, "n 3"], part: Int[Tensor, "n"]) -> Float[Tensor, "n w"]:
        """Hash features of canonical points (metres), normalised by the box of their part."""
        return self.grid((points - self.lo[part]) / self.edge[part, None], part)

    def density(
        self,
        encoded: Float[Tensor, "n w"],
        counts: Sequence[int],
        prior: Float[Tensor, "n"] | float = 0.0,
        code: Float[Tensor, "n c"] | None = None,
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n g"]]:
        """Density and geometry features of pairs sorted by part.

        Args:
            encoded: from :meth:`encode`.
            counts: rows of each part.
            prior: added to the network's output before the softplus.
            code: appearance features, where the spec lets the density see them.

        Returns:
            Density in 1/m and the features for :meth:`color`.
        """
        inputs = encoded if code is None else torch.cat([encoded, code], -1)
        out = self.density_mlp(inputs, counts)
        return self.spec.sharpness * functional.softplus(out[:, 0] + prior), out[:, 1:]

    def color(
        self,
        encoded: Float[Tensor, "n w"],
        geometry: Float[Tensor, "n g"],
        code: Float[Tensor, "n c"] | None,
        counts: Sequence[int],
    ) -> Float[Tensor, "n 3"]:
        """Colour in [0, 1] of pairs sorted by part.

        Args:
            encoded: hash features of the pairs.
            geometry: geometry features of the pairs.
            code: appearance features, or None when the spec has none.
            counts: rows of each part.

        Returns:
            sRGB colours.
        """
        inputs = [encoded, geometry] if code is None else [encoded, geometry, code]
        return torch.sigmoid(self.color_mlp(torch.cat(inputs, -1), counts))
