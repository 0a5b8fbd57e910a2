"""The tilted sensor of OpenCV's lens with 14 coefficients: a homography after the lens."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

HORIZON = 1e-3
"""Smallest denominator of the homography: points nearer to its horizon or beyond have no image."""


def tilt_matrix(angles: Float[Tensor, "2"]) -> Float[Tensor, "3 3"]:
    """Homography from the untilted plane z = 1 to the tilted sensor.

    Args:
        angles: turns τx about x, then τy about y, radians, 2.

    Returns:
        The matrix, 3 3, differentiable in the angles; the identity for zeros.

    Reference: OpenCV calib3d, the tilted sensor of `projectPoints`.

    >>> bool((tilt_matrix(torch.zeros(2)) == torch.eye(3)).all())
    True
    """
    (cx, cy), (sx, sy) = torch.cos(angles).unbind(-1), torch.sin(angles).unbind(-1)
    zero, one = torch.zeros_like(cx), torch.ones_like(cx)
    about_x = torch.stack([one, zero, zero, zero, cx, sx, zero, -sx, cx]).reshape(3, 3)
    about_y = torch.stack([cy, zero, -sy, zero, one, zero, sy, zero, cy]).reshape(3, 3)
    turn = about_y @ about_x
    lift = torch.stack([turn[2, 2], zero, -turn[0, 2], zero, turn[2, 2], -turn[1, 2]])
    return torch.cat([lift, torch.stack([zero, zero, one])]).reshape(3, 3) @ turn


def map_plane(
    points: Float[Tensor, "*b 2"], homography: Float[Tensor, "3 3"]
) -> tuple[Float[Tensor, "*b 2"], Bool[Tensor, "*b"]]:
    """Moves points of a plane by a homography.

    Args:
        points: *b 2.
        homography: acts on (x, y, 1), 3 3.

    Returns:
        The images, *b 2, and a mask *b, False at or beyond the horizon, where the denominator is at
        most `HORIZON`: there it is replaced by that, so that values and gradients stay finite and
        the direction is kept. Differentiable in both arguments.

    >>> map_plane(torch.tensor([1.0, 2.0]), torch.diag(torch.tensor([1.0, 1.0, 2.0])))[0].tolist()
    [0.5, 1.0]
    """
    mapped = points @ homography[:, :2].mT + homography[:, 2]
    below = mapped[..., 2:]
    valid = below > HORIZON
    safe = torch.where(valid, below, torch.full_like(below, HORIZON))
    return mapped[..., :2] / safe, valid[..., 0]


def map_plane_jacobian(
    points: Float[Tensor, "*b 2"], homography: Float[Tensor, "3 3"]
) -> Float[Tensor, "*b 2 2"]:
    """Derivative of `map_plane` with respect to its points, on the valid side of the horizon.

    Args:
        points: *b 2.
        homography: acts on (x, y, 1), 3 3.

    Returns:
        Jacobians, *b 2 2, row = output, column = input.

    >>> map_plane_jacobian(torch.zeros(2), torch.eye(3)).tolist()
    [[1.0, 0.0], [0.0, 1.0]]
    """
    mapped, _ = map_plane(points, homography)
    below = (points @ homography[2, :2] + homography[2, 2]).clamp_min(HORIZON)
    numerators = homography[:2, :2] - mapped[..., :, None] * homography[2, :2]
    return numerators / below[..., None, None]
