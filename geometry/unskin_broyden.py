"""Broyden's method on the forward skinning field, in batched torch: the classical choice."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from .rigid import apply_linear, invert_linear
from .skinning_field import SkinningField
from .unskin_newton import MIN_DET, Plan, Roots, nowhere


def broyden(
    field: SkinningField,
    points: Float[Tensor, "n 3"],
    maps: Float[Tensor, "m 3 4"],
    plan: Plan,
    guess: Float[Tensor, "n 3"],
) -> Roots:
    """Broyden's method from one start; points that arrived leave the batch.

    Args:
        field: the forward field.
        points: targets in pose space, finite.
        maps: ``field.maps`` of the pose.
        plan: how to search.
        guess: first rest points.

    Returns:
        The roots.

    Reference: C. G. Broyden, A class of methods for solving nonlinear simultaneous equations, 1965
    (the inverse form, by Sherman and Morrison).
    """
    best = nowhere(guess)
    rows = torch.arange(len(points), device=points.device)
    rest, inverse, move, error = guess, None, None, None
    for step in range(plan.iterations + 1):
        face, found = field.search(rest, plan.max_distance)
        at = field.at(rest, face, maps)
        new_error = at.image - points[rows]
        residual = torch.where(found, new_error.norm(dim=-1), math.inf)
        start_inverse, ok = invert_linear(at.linear, MIN_DET)
        _store(best, rows, Roots(rest, face, residual, ok))
        if inverse is None or move is None or error is None:
            inverse = start_inverse
        else:
            inverse = _rank_one(inverse, move, new_error - error)
        go = found & (residual > plan.stop)
        if step == plan.iterations or not bool(go.any()):
            break
        rows, inverse, error = rows[go], inverse[go], new_error[go]
        move = -apply_linear(inverse, error)
        move = move * (0.2 / move.norm(dim=-1, keepdim=True).clamp(min=0.2))
        rest = rest[go] + move
    return best


def _rank_one(inverse: Tensor, move: Tensor, change: Tensor) -> Tensor:
    """Smallest change of an inverse Jacobian that explains the last step, where defined."""
    guess = apply_linear(inverse, change)
    left = apply_linear(inverse.mT, move)
    scale = (move * guess).sum(-1)
    safe = scale.abs() > 1e-3 * move.square().sum(-1)
    gain = torch.where(safe, 1.0, 0.0) / torch.where(safe, scale, 1.0)
    return inverse + (move - guess)[:, :, None] * left[:, None, :] * gain[:, None, None]


def _store(best: Roots, rows: Tensor, new: Roots) -> None:
    """Write what is better into the best roots, in place."""
    take = new.residual < best.residual[rows]
    rows = rows[take]
    best.face[rows] = new.face[take]
    best.residual[rows] = new.residual[take]
    best.invertible[rows] = new.invertible[take]
    best.points[rows] = new.points[take]
