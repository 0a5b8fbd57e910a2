"""All rest points that a posed point may have come from: several where body parts touch.

Where a hand lies on a hip, a point in the overlap is the image of a point of the hand and of one of
the hip. `inverse_skin` returns one of them; here each start keeps its own root.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .body import BodyModel, PosedBody
from .errors import InputError
from .skinning_field import SkinningField
from .unskin import Query, attach, plan_of, prepare, solve, surface_guess, weights_of
from .unskin_newton import ARRIVED, Plan, Roots, newton_torch

_ITERATIONS = 12  # a start that may be far away gets more steps than one of `inverse_skin`


@dataclass(frozen=True)
class UnskinnedRoots:
    """Distinct rest-space points of posed points, the smallest residual first.

    Attributes:
        points: [N, K, 3] rest points, metres; where not valid, copies of the first.
        weights: [N, K, J] skinning weights that take them back, zeros where not valid.
        residual: [N, K] cycle error as in `Unskinned`, infinite where there is no further root.
        valid: [N, K] whether there is a root with a residual of at most 1 mm and an inverse.
        count: [N] valid roots.
    """

    points: Float[Tensor, "n k 3"]
    weights: Float[Tensor, "n k J"]
    residual: Float[Tensor, "n k"]
    valid: Bool[Tensor, "n k"]

    @property
    def count(self) -> Tensor:
        """Valid roots of each point, [N] int64."""
        return self.valid.sum(1)


def inverse_skin_all(
    points: Float[Tensor, "n 3"],
    posed: PosedBody,
    body: BodyModel,
    *,
    rest_verts: Float[Tensor, "V 3"] | SkinningField | None = None,
    max_distance: float = 0.2,
    starts: int = 9,
    apart: float = 0.01,
    most: int = 3,
) -> UnskinnedRoots:
    """Find the rest points that linear blend skinning moves to given posed points, by Newton.

    Args:
        points: targets in local pose space, metres.
        posed: the body, unbatched.
        body: its model.
        rest_verts: as in `inverse_skin`.
        max_distance: rest points farther than this from the rest surface are not roots, metres.
        starts: first guesses: one from the posed surface, the others by the inverses of the nearest
            bones. In a fold of the map, as a crease of the armpit, a root 1 to 3 cm from another
            one may be missed whatever their number.
        apart: roots nearer to each other than this count as one, metres.
        most: roots that are kept of each point, K.

    Returns:
        The roots. Points and weights are differentiable as those of `inverse_skin`.

    Raises:
        InputError: as `inverse_skin`, or a limit that is not positive.

    Reference:
        X. Chen et al., Fast-SNARF, 2023, section 3 (several starts, all roots kept).

    >>> from .body import BodyPose
    >>> body = BodyModel.default()
    >>> posed = body(BodyPose.zeros(body))
    >>> inverse_skin_all(body.v_template[:4] + 0.001, posed, body).count.tolist()
    [1, 1, 1, 1]
    """
    if not apart > 0 or most < 1:
        raise InputError(
            f"apart, most: expected metres > 0 and a number of roots ≥ 1, found {apart}, {most}; "
            "use 0.01 and 3"
        )
    plan = plan_of("newton", max_distance, starts, _ITERATIONS, points.dtype)
    query = prepare(points, posed, body, rest_verts)
    maps = query.field.maps(query.posed.transforms)
    with torch.no_grad():
        found = _every_start(query, maps.detach(), plan)
        picks = _distinct(found, query.sound, apart, most)
    results = [attach(query, maps, *pick) for pick in picks]
    return UnskinnedRoots(
        torch.stack([rest for rest, _ in results], 1),
        torch.stack([weights for _, weights in results], 1),
        torch.stack([pick[0].residual for pick in picks], 1),
        torch.stack([pick[2] for pick in picks], 1),
    )


def _every_start(query: Query, maps: Tensor, plan: Plan) -> list[tuple[Roots, Tensor]]:
    """The root of each start, alone, and its weights."""
    bones, targets = query.bones(), query.points.detach()
    alone = replace(plan, starts=1, rescues=0)
    found = []
    for number in range(min(plan.starts, bones.joints.shape[0] + 1)):
        # the closest face itself: the voxel look-up of `inverse_skin` finds fewer roots in contacts
        guess = surface_guess(query) if number == 0 else bones.guess(targets, number - 1)
        if query.fast:
            found.append(solve(query, maps, bones, alone, guess.contiguous()))
        else:
            roots = newton_torch(query.field, targets, maps, bones, alone, guess)
            found.append((roots, weights_of(query, roots)))
    return found


def _distinct(
    found: list[tuple[Roots, Tensor]], sound: Tensor, apart: float, most: int
) -> list[tuple[Roots, Tensor, Tensor]]:
    """Roots of each point that are not the same, their weights and masks, best first."""
    points = torch.stack([roots.points for roots, _ in found])
    residual = torch.stack([roots.residual for roots, _ in found])
    valid = torch.stack([r.invertible & (r.residual <= ARRIVED) for r, _ in found]) & sound
    open_ = torch.where(valid, residual, torch.inf)
    rows = torch.arange(points.shape[1], device=points.device)
    faces = torch.stack([roots.face for roots, _ in found])
    weights = torch.stack([own for _, own in found])
    picks, first = [], open_.argmin(0)
    for _ in range(most):
        best, which = open_.min(0)
        there = best.isfinite()
        which = torch.where(there, which, first)
        roots = Roots(points[which, rows], faces[which, rows], best, there)
        picks.append((roots, torch.where(there[:, None], weights[which, rows], 0.0), there))
        near = (points - roots.points).norm(dim=-1) <= apart
        open_ = torch.where(near & there, torch.inf, open_)
    return picks
