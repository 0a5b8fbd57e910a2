"""Axis-aligned boxes: around points, met by rays, seen in images."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .cameras import Camera, Rays
from .errors import InputError


def box_of(
    points: Float[Tensor, "n 3"], margin: float = 0.0
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Smallest box around points, widened on all sides.

    Args:
        points: metres, any frame, n 3 with n ≥ 1.
        margin: metres added on every side.

    Returns:
        Lower and upper corner, 3 each, differentiable in the points.

    Raises:
        InputError: no points.

    >>> lo, hi = box_of(torch.tensor([[0.0, 1, 2], [3, 0, 2]]), 0.5)
    >>> lo.tolist(), hi.tolist()
    ([-0.5, -0.5, 1.5], [3.5, 1.5, 2.5])
    """
    if points.shape[0] == 0:
        raise InputError("points: expected at least one point, found none; check the selection")
    return points.amin(0) - margin, points.amax(0) + margin


def in_box(
    points: Float[Tensor, "*b 3"], lo: Float[Tensor, "3"], hi: Float[Tensor, "3"]
) -> Bool[Tensor, "*b"]:
    """Which points lie in a box, its faces included.

    Args:
        points: metres, frame of the box, *b 3.
        lo: lower corner, 3.
        hi: upper corner, 3.

    Returns:
        Mask *b.

    >>> in_box(torch.tensor([[0.5, 0, 1], [2, 0, 0]]), torch.zeros(3), torch.ones(3)).tolist()
    [True, False]
    """
    return ((points >= lo) & (points <= hi)).all(-1)


def ray_box(
    rays: Rays, lo: Float[Tensor, "3"], hi: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"], Bool[Tensor, "*b"]]:
    """Where rays enter and leave a box; the part behind the origin does not count.

    A direction component of zero (or below 1e-15 in float32) keeps the ray between two faces or
    outside of both, with no division. Rays that touch a face, an edge or a corner hit.

    Args:
        rays: rays *b, in the frame of the box.
        lo: lower corner, metres, 3.
        hi: upper corner, metres, 3; a box with hi < lo is empty and never hit.

    Returns:
        near *b (0 where the origin is inside), far *b, both in metres along the ray and 0 where
        the ray misses, and hit *b. Differentiable in rays and corners.

    Reference: Kay and Kajiya, "Ray tracing complex scenes", 1986 (slabs).

    >>> rays = Rays(torch.tensor([[-1.0, 0.5, 0.5]]), torch.tensor([[1.0, 0.0, 0.0]]))
    >>> [x.tolist() for x in ray_box(rays, torch.zeros(3), torch.ones(3))]
    [[1.0], [2.0], [True]]
    """
    origins, directions = rays.origins, rays.directions
    # the square of the threshold still divides without overflow, so gradients stay finite
    parallel = directions.abs() <= torch.finfo(directions.dtype).tiny ** 0.4
    divisor = torch.where(parallel, torch.ones_like(directions), directions)
    to_lo, to_hi = (lo - origins) / divisor, (hi - origins) / divisor
    forwards = divisor > 0
    inf = torch.full_like(directions, torch.inf)
    enter = torch.where(parallel, -inf, torch.where(forwards, to_lo, to_hi)).amax(-1)
    leave = torch.where(parallel, inf, torch.where(forwards, to_hi, to_lo)).amin(-1)
    between = (~parallel | ((origins >= lo) & (origins <= hi))).all(-1)
    hit = between & (leave >= enter) & (leave >= 0) & ~parallel.all(-1)
    zero = torch.zeros_like(enter)
    return torch.where(hit, enter.clamp_min(0), zero), torch.where(hit, leave, zero), hit


def box_mask(camera: Camera, lo: Float[Tensor, "3"], hi: Float[Tensor, "3"]) -> Bool[Tensor, "h w"]:
    """Pixels whose central ray meets a box.

    Args:
        camera: the camera; pixels beyond the fold of its lens are False.
        lo: lower corner, world metres, 3.
        hi: upper corner, world metres, 3.

    Returns:
        Mask, height width.
    """
    rays, valid = camera.rays_with_mask(camera.pixel_grid().to(lo))
    return ray_box(rays, lo, hi)[2] & valid
