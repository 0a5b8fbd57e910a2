"""How a light that stands still falls on a matt surface: harmonics of the surface's normal."""

import torch
from jaxtyping import Float
from torch import Tensor

NUM_IRRADIANCE = 8
"""Columns of :func:`irradiance_basis`."""
ZONAL = 2, 7
"""Columns that a turn about the z axis leaves alone; the mean of the others over all turns is 0."""


def irradiance_basis(normals: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 8"]:
    """Spherical harmonics of first and second order, not normalised.

    With a constant they hold 99 % of the energy of what a matt surface gets from distant lights,
    whatever these are, as a function of the way it looks.

    Args:
        normals: unit normals in the frame of the lights; a zero normal gives zeros.

    Returns:
        x, y, z, xy, yz, zx, x² − y², 2z² − x² − y²; differentiable in the normals.

    Reference: Ramamoorthi and Hanrahan, An efficient representation for irradiance environment
    maps, 2001, eq. 3.

    >>> irradiance_basis(torch.tensor([0.0, 0.0, 1.0])).tolist()
    [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 2.0]
    """
    x, y, z = normals.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack([x, y, z, x * y, y * z, z * x, xx - yy, 2 * zz - xx - yy], -1)
