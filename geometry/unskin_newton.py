"""Newton's method on the forward skinning field: one Warp kernel, and its plain torch twin."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .face_tree import LIMIT
from .rigid import apply_linear, invert_affine, invert_linear
from .skinning_field import SkinningField

MIN_DET = 1e-2  # a map with a smaller |determinant| has no inverse worth having
ARRIVED = 1e-3  # metres: a residual up to this counts as a root
LONGEST_STEP = 0.2  # metres: a Newton step of a nearly singular Jacobian is cut to this
_GRID, _SPLAT = 64, 1.8  # first-guess grid of a pose: voxels per side, reach in voxels
_ORDER, _MARGIN = 64, 0.1  # cells per side and margin (metres) by which points are ordered


@dataclass(frozen=True)
class Roots:
    """Where a search for rest points ended.

    Attributes:
        points: [N, 3] best rest points, metres.
        face: [N] int64 closest rest face, 0 where none was within reach.
        residual: [N] distance of image and target, metres; infinite where no face was within reach.
        invertible: [N] whether the blended map or the Jacobian there has an inverse.
    """

    points: Float[Tensor, "n 3"]
    face: Int[Tensor, "n"]
    residual: Float[Tensor, "n"]
    invertible: Bool[Tensor, "n"]

    def spread(self, rows: Int[Tensor, "m"], among: "Roots") -> "Roots":
        """These roots at some rows of others; elsewhere nothing.

        Args:
            rows: a row of each of these roots.
            among: gives the number of rows.

        Returns:
            Roots as many as ``among``.
        """
        rest = nowhere(among.points)
        return Roots(
            rest.points.index_copy(0, rows, self.points),
            rest.face.index_copy(0, rows, self.face),
            rest.residual.index_copy(0, rows, self.residual),
            rest.invertible.index_copy(0, rows, self.invertible),
        )


@dataclass(frozen=True)
class Plan:
    """How to search.

    Attributes:
        iterations: steps of one start.
        starts: first guesses at most; the next one is for points that did not arrive.
        max_distance: reach of the rest surface, metres.
        stop: residual that ends the iterations of a point, metres.
        gradients: Newton's Jacobian; False only re-queries the weights.
        rescues: starts of Broyden's method for the points that did not arrive.
    """

    iterations: int
    starts: int
    max_distance: float
    stop: float
    gradients: bool
    rescues: int = 0

    @property
    def rescue_iterations(self) -> int:
        """Steps of one start of a rescue: secants need more of them than tangents."""
        return 5 * self.iterations // 2


@dataclass(frozen=True)
class Bones:
    """Rigid inverses as first guesses.

    Attributes:
        joints: [J, 3] posed joints, metres.
        inverses: [J, 3, 4] inverses of their transforms.
    """

    joints: Float[Tensor, "J 3"]
    inverses: Float[Tensor, "J 3 4"]

    @classmethod
    def of(cls, joints: Float[Tensor, "J 3"], transforms: Float[Tensor, "J 4 4"]) -> "Bones":
        """Bones of a pose."""
        inverse, _ = invert_affine(transforms)
        return cls(joints.contiguous(), inverse[:, :3].contiguous())

    def guess(self, points: Float[Tensor, "n 3"], rank: int) -> Float[Tensor, "n 3"]:
        """Points under the inverse of the bone whose joint is the ``rank``-th nearest."""
        gap = (points[:, None] - self.joints).square().sum(-1)
        nearest = gap.argsort(dim=1, stable=True)[:, min(rank, gap.shape[1] - 1)]
        inverse = self.inverses[nearest]
        return apply_linear(inverse[..., :3], points) + inverse[..., 3]


def guess_warp(
    field: SkinningField,
    points: Float[Tensor, "n 3"],
    maps: Float[Tensor, "V 3 4"],
    max_distance: float,
) -> tuple[Float[Tensor, "n 3"], Int[Tensor, "n"]]:
    """First guesses: the inverse map of the posed vertex that the voxel of a point names.

    Args:
        field: the forward field, with the warp back end.
        points: float32 targets in pose space, metres.
        maps: blended maps of the vertices.
        max_distance: half the reach of the search that follows an empty voxel, metres.

    Returns:
        Rest points; where the voxel is empty, by a corner of the closest posed face, and where that
        is out of reach too, the point itself. And a face near each, -1 where there is none.
    """
    from .kernels.launch import launch, launch_one, view
    from .kernels.newton import EMPTY, first_guess, skin_verts, splat_verts

    rest = field.rest.detach().contiguous()
    skinned, inverse = torch.empty_like(rest), torch.empty(len(rest), 3, 3, device=rest.device)
    args = [view(rest, 3), view(maps, 4), MIN_DET, view(skinned, 3), view(inverse, 3)]
    launch(skin_verts, len(rest), args, points)
    low, high = skinned.amin(0), skinned.amax(0)
    # corner and voxel size stay on the device; the reach is kept free around the body
    border = math.ceil(_SPLAT)
    voxel = ((high - low).amax() / (_GRID - 2 * border)).clamp(min=1e-3)
    frame = torch.cat([low - border * voxel, voxel[None]])
    nearest = torch.full((_GRID**3,), EMPTY, device=points.device)
    args = [view(skinned, 3), view(frame), _GRID, _SPLAT, view(nearest)]
    launch_one(splat_verts, len(skinned), args, points)
    posed = field.posed_index(skinned)
    guess = torch.empty_like(points)
    hint = torch.empty(len(points), dtype=torch.int32, device=points.device)
    args = [view(points, 3), view(frame), _GRID, view(nearest), *posed.tree.args()]
    args += [view(posed.tree.corners, 3), min(2 * max_distance, LIMIT), view(rest, 3)]
    args += [view(skinned, 3), view(inverse, 3), view(field.some_face), view(guess, 3), view(hint)]
    launch(first_guess, len(points), args, points)
    return guess, hint


def by_voxel(points: Float[Tensor, "n 3"], rest: Float[Tensor, "V 3"]) -> Int[Tensor, "n"]:
    """Order in which neighbours follow each other: the look-ups then hit warm memory.

    Args:
        points: rest points.
        rest: rest vertices; their box is cut into voxels.

    Returns:
        Rows of the points, voxel after voxel.
    """
    low = rest.amin(0) - _MARGIN
    voxel = ((rest.amax(0) + _MARGIN - low) / _ORDER).clamp(min=1e-6)
    cell = ((points - low) / voxel).clamp(0, _ORDER - 1).int()
    return ((cell[:, 2] * _ORDER + cell[:, 1]) * _ORDER + cell[:, 0]).argsort()


@dataclass(frozen=True)
class SolverOutput:
    """What the kernels that solve every point write.

    Attributes:
        rest: [N, 3] rest points, metres.
        weights: [N, J] skinning weights.
        place: [N] int32 faces or cells, -1: none.
        residual: [N] metres.
        invertible: [N] whether the map has an inverse.
    """

    rest: Float[Tensor, "n 3"]
    weights: Float[Tensor, "n J"]
    place: Int[Tensor, "n"]
    residual: Float[Tensor, "n"]
    invertible: Bool[Tensor, "n"]

    @classmethod
    def of(cls, points: Float[Tensor, "n 3"], joints: int) -> "SolverOutput":
        """Room for the results of some targets.

        Args:
            points: the targets.
            joints: number of joints.

        Returns:
            Tensors that are not initialised.
        """
        count, device = len(points), points.device
        return cls(
            torch.empty_like(points),
            torch.empty(count, joints, device=device),
            torch.empty(count, dtype=torch.int32, device=device),
            torch.empty(count, device=device),
            torch.empty(count, dtype=torch.bool, device=device),
        )

    def views(self) -> list[Any]:
        """Launch arguments, in the order of the attributes.

        Returns:
            Views.
        """
        from .kernels.launch import view

        mask = [view(self.place), view(self.residual), view(self.invertible)]
        return [view(self.rest, 3), view(self.weights), *mask]

    def roots(self) -> Roots:
        """The roots, after the launches.

        Returns:
            Roots that share these tensors.
        """
        residual = torch.where(self.place >= 0, self.residual, math.inf)
        return Roots(self.rest, self.place.clamp(min=0).long(), residual, self.invertible)


def limits_of(plan: Plan) -> tuple[float, float, float, float]:
    """Limits of a kernel that solves.

    Args:
        plan: how to search.

    Returns:
        Residual that ends the iterations, residual that ends the starts, smallest determinant and
        reach: see `kernels.newton.solve`.
    """
    return plan.stop, ARRIVED, MIN_DET, min(plan.max_distance, LIMIT)


def newton_warp(
    field: SkinningField,
    points: Float[Tensor, "n 3"],
    maps: Float[Tensor, "V 3 4"],
    bones: Bones,
    plan: Plan,
    guess: Float[Tensor, "n 3"] | None = None,
) -> tuple[Roots, Float[Tensor, "n J"]]:
    """All starts and iterations of a point in one thread of one kernel.

    Args:
        field: the forward field, with the warp back end.
        points: [N, 3] float32 targets in pose space, finite.
        maps: blended maps of the vertices.
        bones: for the starts after the first.
        plan: how to search.
        guess: first rest points; None looks them up.

    Returns:
        The roots, and their weights [N, J].
    """
    from .kernels.broyden import rescue
    from .kernels.launch import launch, view
    from .kernels.newton import solve

    points, maps = points.contiguous(), maps.contiguous()
    if guess is None:
        guess, hint = guess_warp(field, points, maps, plan.max_distance)
    else:
        hint = torch.full((len(points),), -1, dtype=torch.int32, device=points.device)
    tree, rest = field.index.tree, field.rest.detach().contiguous()
    to = [view(points, 3), view(guess, 3)]
    on = [*tree.args(), view(rest, 3), view(tree.corners, 3), view(maps, 4)]
    on += [view(field.weights32), view(bones.joints, 3), view(bones.inverses, 4)]
    out = SolverOutput.of(points, field.weights.shape[1])
    search = [plan.starts, plan.iterations, int(plan.gradients), limits_of(plan)]
    first = [view(by_voxel(guess, field.rest)), *to, view(hint), view(tree.places)]
    launch(solve, len(points), [*first, *on, *search, *out.views()], points)
    if plan.rescues:
        search = [plan.rescues, plan.rescue_iterations, limits_of(plan)]
        launch(rescue, len(points), [*to, *on, *search, *out.views()], points)
    return out.roots(), out.weights


def newton_torch(
    field: SkinningField,
    points: Float[Tensor, "n 3"],
    maps: Float[Tensor, "m 3 4"],
    bones: Bones,
    plan: Plan,
    guess: Float[Tensor, "n 3"],
) -> Roots:
    """The plain twin of :func:`newton_warp`, in the dtype of the input.

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
        todo = (best.residual > ARRIVED).nonzero().squeeze(-1)
        first = guess if start == 0 else bones.guess(points, start - 1)
        found = _descend(field, points[todo], maps, plan, first[todo])
        best = keep_better(best, found.spread(todo, best))
    return best


def _descend(
    field: SkinningField, points: Tensor, maps: Tensor, plan: Plan, guess: Tensor
) -> Roots:
    """One start: Newton steps (or re-queries) that keep the best iterate."""
    rest, best, last = guess, nowhere(guess), torch.inf
    for step in range(plan.iterations + 1):
        face, found = field.search(rest, plan.max_distance)
        at = field.at(rest, face, maps)
        error = points - at.image
        residual = torch.where(found, error.norm(dim=-1), math.inf)
        better, last = residual < last, residual
        inverse, ok = invert_linear(at.linear, MIN_DET)
        best = keep_better(best, Roots(rest, face, residual, ok))
        active = found & (best.residual > plan.stop)
        if step == plan.iterations or not bool(active.any()):
            break
        if plan.gradients:
            full, regular = invert_linear(at.jacobian(), MIN_DET)
            regular = regular & better  # after a step that did not help: re-query only
            inverse = torch.where(regular[:, None, None], full, inverse)
            ok = ok | regular
        move = apply_linear(inverse, error)
        move = move * (LONGEST_STEP / move.norm(dim=-1, keepdim=True).clamp(min=LONGEST_STEP))
        rest = torch.where((active & ok)[:, None], rest + move, rest)
    return best


def nowhere(guess: Float[Tensor, "n 3"]) -> Roots:
    """Roots that anything is better than.

    Args:
        guess: where they are.

    Returns:
        Roots of infinite residual.
    """
    face = torch.zeros(len(guess), dtype=torch.long, device=guess.device)
    residual = torch.full((len(guess),), math.inf, dtype=guess.dtype, device=guess.device)
    return Roots(guess.clone(), face, residual, torch.zeros_like(face, dtype=torch.bool))


def keep_better(old: Roots, new: Roots) -> Roots:
    """Per point the better of two roots.

    Args:
        old: taken where both are equal.
        new: taken where its residual is smaller.

    Returns:
        The roots.
    """
    take = new.residual < old.residual
    return Roots(
        torch.where(take[:, None], new.points, old.points),
        torch.where(take, new.face, old.face),
        torch.where(take, new.residual, old.residual),
        torch.where(take, new.invertible, old.invertible),
    )
