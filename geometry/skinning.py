"""Linear blend skinning and its inverse for known weights."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .rigid import append_last_row, apply_linear, invert_linear, transform_points


def blend_transforms(
    transforms: Float[Tensor, "*b J 4 4"], weights: Float[Tensor, "N J"]
) -> Float[Tensor, "*b N 4 4"]:
    """Weighted sums of joint transforms: affine maps, in general not rigid.

    Args:
        transforms: joint transforms with last row (0, 0, 0, 1), (*b, J, 4, 4).
        weights: skinning weights, (N, J); each row must sum to 1, for the last row of the result
            is set to (0, 0, 0, 1) and not summed.

    Returns:
        Blended maps, (*b, N, 4, 4); differentiable in both.

    Reference:
        Loper et al. 2015 (SMPL), equation 2.

    >>> blend_transforms(torch.eye(4)[None], torch.ones(2, 1)).shape
    torch.Size([2, 4, 4])
    """
    flat = transforms[..., :3, :].flatten(-2)
    return append_last_row((weights @ flat).unflatten(-1, (3, 4)))


def skin(
    points: Float[Tensor, "*b N 3"], blended: Float[Tensor, "*b N 4 4"]
) -> Float[Tensor, "*b N 3"]:
    """Move rest points by their blended maps: x = A p.

    Args:
        points: points of the rest pose in metres, (*b, N, 3).
        blended: their maps from `blend_transforms`, (*b, N, 4, 4).

    Returns:
        Posed points in metres, (*b, N, 3); differentiable in both.

    >>> skin(torch.ones(2, 3), torch.eye(4).expand(2, 4, 4)).tolist()
    [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]
    """
    return transform_points(blended, points)


def unskin(
    points: Float[Tensor, "*b N 3"], blended: Float[Tensor, "*b N 4 4"], min_det: float = 1e-2
) -> tuple[Float[Tensor, "*b N 3"], Bool[Tensor, "*b N"]]:
    """Move posed points back by their blended maps: p = A⁻¹ x.

    Args:
        points: posed points in metres, (*b, N, 3).
        blended: their rest-to-posed maps, (*b, N, 4, 4).
        min_det: smallest |determinant| of the 3×3 part that counts as invertible.

    Returns:
        Rest points in metres (*b, N, 3) and the mask of points whose map is invertible (*b, N);
        an invalid point is only shifted (or returned as it is where its map is not finite).
        Differentiable in both.

    >>> unskin(torch.ones(1, 3), torch.eye(4)[None])[0].tolist()
    [[1.0, 1.0, 1.0]]
    """
    # the translation is taken off first: inverting it with the rest would cancel large terms
    offset = blended[..., :3, 3]
    finite = offset.isfinite().all(-1)
    offset = torch.where(finite[..., None], offset, torch.zeros_like(offset))
    inverse, valid = invert_linear(blended[..., :3, :3], min_det)
    return apply_linear(inverse, points - offset), valid & finite
