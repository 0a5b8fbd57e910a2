"""Affine 4×4 transforms that act on column vectors: build, invert, apply."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def rigid(
    rotmat: Float[Tensor, "*b 3 3"], translation: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 4 4"]:
    """The 4×4 transform x → R x + t.

    Args:
        rotmat: linear part R, (*b, 3, 3).
        translation: t in metres, (*b, 3).

    Returns:
        Transforms with last row (0, 0, 0, 1), (*b, 4, 4); differentiable in both.

    >>> rigid(torch.eye(3), torch.ones(3))[:3, 3].tolist()
    [1.0, 1.0, 1.0]
    """
    return append_last_row(torch.cat((rotmat, translation[..., None]), dim=-1))


def append_last_row(affine: Float[Tensor, "*b 3 4"]) -> Float[Tensor, "*b 4 4"]:
    """The 4×4 form of 3×4 affine maps: the row (0, 0, 0, 1) is appended.

    Args:
        affine: maps (R | t), (*b, 3, 4).

    Returns:
        Transforms, (*b, 4, 4); differentiable.
    """
    last = torch.zeros_like(affine[..., :1, :])
    last[..., 3] = 1
    return torch.cat((affine, last), dim=-2)


def invert_linear(
    linear: Float[Tensor, "*b 3 3"], min_det: float = 1e-2
) -> tuple[Float[Tensor, "*b 3 3"], Bool[Tensor, "*b"]]:
    """Inverse of 3×3 matrices by cofactors.

    Args:
        linear: matrices, (*b, 3, 3).
        min_det: an element with |determinant| ≤ min_det, or one that is not finite, is invalid.

    Returns:
        Inverses (*b, 3, 3), the identity where invalid, and the mask of valid elements (*b).
        Differentiable in `linear`; invalid elements receive a zero gradient.
    """
    with torch.no_grad():
        det = _cofactor_columns(linear)[1]
        valid = (det.abs() > min_det) & linear.isfinite().flatten(-2).all(-1)
    identity = torch.eye(3, dtype=linear.dtype, device=linear.device)
    safe = torch.where(valid[..., None, None], linear, identity)
    cofactors, det = _cofactor_columns(safe)
    return cofactors / det[..., None, None], valid


def _cofactor_columns(linear: Tensor) -> tuple[Tensor, Tensor]:
    """The adjugate (its columns are cross products of the rows) and the determinant."""
    row0, row1, row2 = linear.unbind(-2)
    first = torch.linalg.cross(row1, row2)
    adjugate = torch.stack(
        (first, torch.linalg.cross(row2, row0), torch.linalg.cross(row0, row1)), dim=-1
    )
    return adjugate, (row0 * first).sum(-1)


def invert_affine(
    transforms: Float[Tensor, "*b 4 4"], min_det: float = 1e-2
) -> tuple[Float[Tensor, "*b 4 4"], Bool[Tensor, "*b"]]:
    """Inverse of affine transforms, with a mask instead of an error where there is none.

    Args:
        transforms: affine maps with last row (0, 0, 0, 1), (*b, 4, 4); need not be rigid.
        min_det: smallest |determinant| of the 3×3 part that counts as invertible.

    Returns:
        Inverses (*b, 4, 4) and the mask of valid elements (*b). Invalid elements (singular, or not
        finite) hold the identity, with zero gradient. Differentiable in `transforms`.

    >>> inverse, valid = invert_affine(torch.eye(4))
    >>> valid.item()
    True
    """
    finite = transforms.isfinite().flatten(-2).all(-1)
    inverse, valid = invert_linear(transforms[..., :3, :3], min_det)
    valid = valid & finite
    identity = torch.eye(3, dtype=transforms.dtype, device=transforms.device)
    inverse = torch.where(valid[..., None, None], inverse, identity)
    offset = transforms[..., :3, 3]
    offset = torch.where(valid[..., None], offset, torch.zeros_like(offset))
    return rigid(inverse, -apply_linear(inverse, offset)), valid


def apply_linear(
    linear: Float[Tensor, "*b 3 3"], vectors: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 3"]:
    """Matrix times vector, element by element, as multiply-adds (no batched matrix product).

    Args:
        linear: matrices, (*b, 3, 3).
        vectors: vectors, (*b, 3).

    Returns:
        Products, (*b, 3); differentiable in both.
    """
    return (linear * vectors[..., None, :]).sum(-1)


def transform_points(
    transforms: Float[Tensor, "*b 4 4"], points: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 3"]:
    """Apply one affine transform to each point.

    Args:
        transforms: affine maps, (*b, 4, 4).
        points: points in metres, (*b, 3).

    Returns:
        Transformed points, (*b, 3); differentiable in both.

    >>> transform_points(torch.eye(4), torch.ones(3)).tolist()
    [1.0, 1.0, 1.0]
    """
    return apply_linear(transforms[..., :3, :3], points) + transforms[..., :3, 3]
