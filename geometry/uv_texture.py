"""Textures of a layout: what each texel shows, filled gutters, look-up that keeps to its chart."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .errors import InputError
from .uv import UVMap
from .uv_lookup import UVIndex


@dataclass(frozen=True, eq=False)
class TexelMap:
    """The point of the surface at the middle of each texel; row 0 is at v = 0."""

    face: Int[Tensor, "h w"]
    """Face index; −1 between the charts."""
    bary: Float[Tensor, "h w 3"]
    """Barycentric coordinates, zero between the charts."""

    @property
    def covered(self) -> Bool[Tensor, "h w"]:
        """Texels whose middle lies in a chart."""
        return self.face >= 0

    def of_corners(self, values: Float[Tensor, "F 3 c"]) -> Float[Tensor, "h w c"]:
        """Texture of values given per face corner; zero between the charts; differentiable."""
        found = (self.bary[..., None] * values[self.face.clamp(min=0)]).sum(-2)
        return torch.where(self.covered[..., None], found, 0.0)


def texel_map(uv: UVMap, size: int) -> TexelMap:
    """The face at the middle of each texel of a square texture.

    Args:
        uv: the map.
        size: texels along a side.

    Returns:
        Faces and barycentric coordinates.

    Raises:
        InputError: a texture without texels.

    >>> face = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]])
    >>> texel_map(UVMap(face), 2).face.tolist()
    [[0, 0], [0, -1]]
    """
    if size < 1:
        raise InputError(f"size: expected at least one texel, found {size}")
    middle = (torch.arange(size, device=uv.corner_uv.device, dtype=torch.float64) + 0.5) / size
    v, u = torch.meshgrid(middle, middle, indexing="ij")
    hit = UVIndex(uv).locate(torch.stack([u, v], -1).reshape(-1, 2))
    bary = hit.bary.to(uv.corner_uv).reshape(size, size, 3)
    return TexelMap(hit.face.reshape(size, size), bary)


def fill_gutter(
    texture: Float[Tensor, "h w c"], covered: Bool[Tensor, "p q"], texels: int
) -> Float[Tensor, "h w c"]:
    """Spread the colours at the borders of the charts outwards, so that filters find no blank.

    Each round gives an empty texel the mean of its covered neighbours, of eight.

    Args:
        texture: colours.
        covered: texels that have one, (h, w).
        texels: number of rounds, that is, width of the gutter.

    Returns:
        The texture; covered texels are unchanged, those out of reach zero; differentiable.

    Raises:
        InputError: a mask of another size than the texture, a negative width.

    >>> fill_gutter(torch.tensor([[[1.0], [0.0]]]), torch.tensor([[True, False]]), 1).flatten()
    tensor([1., 1.])
    """
    if covered.shape != texture.shape[:2] or texels < 0:
        raise InputError(
            f"covered, texels: expected a mask of {tuple(texture.shape[:2])} texels and a width of "
            f"0 or more, found {tuple(covered.shape)} and {texels}"
        )
    if texture.numel() == 0:
        return texture
    mask = covered[None, None].to(texture)
    image = torch.where(covered, texture.movedim(-1, 0), 0.0)[None]
    for _ in range(texels):
        total = 9 * torch.nn.functional.avg_pool2d(image, 3, 1, 1)
        number = 9 * torch.nn.functional.avg_pool2d(mask, 3, 1, 1)
        near = (number > 0.5).to(texture)
        image = torch.where(mask > 0, image, near * total / number.clamp(min=0.5))
        mask = torch.maximum(mask, near)
    return image[0].movedim(0, -1)


def sample_texture(
    texture: Float[Tensor, "h w c"],
    uv: Float[Tensor, "n 2"],
    chart: Int[Tensor, "n"],
    texel_chart: Int[Tensor, "p q"],
) -> Float[Tensor, "n c"]:
    """Bilinear look-up that reads texels of the point's own chart alone.

    Neither the value nor the gradient of a point mixes charts that only lie beside each other in
    the texture; weights of texels of other charts, or of none, go to those that remain.

    Args:
        texture: colours; row 0 is at v = 0.
        uv: points; those that are not finite have no colour.
        chart: chart of each point; −1 (nothing found) has no colour.
        texel_chart: chart of each texel, (h, w); −1 between the charts.

    Returns:
        Colours; zero where none of the four texels is of the chart. Differentiable in the texture
        and in uv.

    Raises:
        InputError: a texture without texels, charts of another size than the texture.

    >>> texture = torch.tensor([[[1.0], [3.0]]])
    >>> at, both = torch.tensor([[0.5, 0.5]]), torch.tensor([[0, 1]])
    >>> sample_texture(texture, at, torch.tensor([1]), both)
    tensor([[3.]])
    """
    height, width = texture.shape[:2]
    if height * width == 0 or texel_chart.shape != (height, width):
        raise InputError(
            f"texture, texel_chart: expected two of one size with a texel at least, found "
            f"{tuple(texture.shape)} and {tuple(texel_chart.shape)}"
        )
    known = uv.isfinite().all(-1) & (chart >= 0)
    uv = torch.where(known[:, None], uv, 0.0)  # else its NaN reaches every gradient
    x, y = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
    left, low = x.detach().floor(), y.detach().floor()
    right, up = x - left, y - low
    total = texture.new_zeros(len(uv), texture.shape[2])
    weights = texture.new_zeros(len(uv), 1)
    for dx, across in ((0, 1 - right), (1, right)):
        for dy, along in ((0, 1 - up), (1, up)):
            column = (left + dx).long().clamp(0, width - 1)
            row = (low + dy).long().clamp(0, height - 1)
            own = (texel_chart[row, column] == chart) & known
            weight = torch.where(own, across * along, 0.0)[:, None]
            total = total + weight * texture[row, column]
            weights = weights + weight
    some = weights > 0
    return torch.where(some, total / torch.where(some, weights, 1.0), 0.0)
