"""Broyden's method on the forward skinning field, in batched torch: the classical choice."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from .rigid import apply_linear, invert_linear
from .skinning_field import SkinningField
from .unskin_newton import ARRIVED, MIN_DET, Bones, Plan, Roots, keep_better, nowhere


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


def broyden_starts(
    field: SkinningField,
    points: Float[Tensor, "n 3"],
    maps: Float[Tensor, "m 3 4"],
    bones: Bones,
    plan: Plan,
    guess: Float[Tensor, "n 3"],
) -> Roots:
    """Broyden's method from several starts: every point takes the best.

    Args:
        field: the forward field.
        points: targets in pose space, finite.
        maps: ``field.maps`` of the pose.
        bones: for the starts after the first.
        plan: how to search.
        guess: first rest points.

    Returns:
        The roots.
    """
    best = nowhere(guess)
    for start in range(min(plan.starts, bones.joints.shape[0] + 1)):
        first = guess if start == 0 else bones.guess(points, start - 1)
        best = keep_better(best, broyden(field, points, maps, plan, first))
    return best


def rescued(
    found: Roots,
    field: SkinningField,
    points: Float[Tensor, "n 3"],
    maps: Float[Tensor, "m 3 4"],
    bones: Bones,
    plan: Plan,
    guess: Float[Tensor, "n 3"],
) -> Roots:
    """Newton's roots, and Broyden's where Newton's did not arrive: twin of `kernels.broyden`.

    Args:
        found: where Newton's method ended.
        field: the forward field.
        points: targets in pose space, finite.
        maps: ``field.maps`` of the pose.
        bones: for the starts after the first.
        plan: how to search; without rescues nothing is done.
        guess: first rest points.

    Returns:
        The roots.
    """
    rows = (found.residual > ARRIVED).nonzero().squeeze(-1)
    if not plan.rescues or not len(rows):
        return found
    plan = replace(plan, starts=plan.rescues, iterations=plan.rescue_iterations)
    more = broyden_starts(field, points[rows], maps, bones, plan, guess[rows])
    return keep_better(found, more.spread(rows, found))


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
