"""The bidirectional consistency of a deformation: round trip and loss (MonoPartNeRF, eq. 3)."""

from collections.abc import Callable

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from .errors import InputError
from .norms import safe_norm


def round_trip(
    points: Float[Tensor, "n 3"],
    backward: Callable[[Tensor], Tensor],
    forward: Callable[[Tensor], Tensor],
) -> Float[Tensor, "n"]:
    """Distance between points and their image under backward, then forward deformation.

    Args:
        points: points in the observation space, metres.
        backward: observation to canonical space, [N, 3] to [N, 3].
        forward: canonical to observation space, [N, 3] to [N, 3].

    Returns:
        Distances in metres; the gradient at distance 0 is 0.

    >>> round_trip(torch.zeros(2, 3), lambda p: p + 1.0, lambda c: c - 1.0)
    tensor([0., 0.])
    """
    return safe_norm(points - forward(backward(points)))


def consistency_loss(distance: Shaped[Tensor, "..."], threshold: float = 0.05) -> Float[Tensor, ""]:
    """Mean of the round-trip distances that exceed a threshold; exactly 0 when none does.

    Args:
        distance: round-trip distances, metres, any shape.
        threshold: metres; smaller distances cost nothing (0.05 in the authors' code, 0.01-0.02
            bite more).

    Returns:
        The loss in metres, differentiable in the distances that exceed the threshold; NaN where
        a distance is NaN.

    Raises:
        InputError: the threshold is negative or not a number.

    Reference: MonoPartNeRF, eq. (3): sum over d > theta of d, over max(1, their number).

    >>> consistency_loss(torch.tensor([0.01, 0.1, 0.3]), 0.05)
    tensor(0.2000)
    """
    if not threshold >= 0:
        raise InputError(f"threshold: expected metres >= 0, found {threshold}; use 0.05")
    over = ~(distance <= threshold)  # NaN counts, so that it is seen
    return torch.where(over, distance, 0.0).sum() / over.sum().clamp(min=1)
