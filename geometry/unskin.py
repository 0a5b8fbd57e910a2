"""Inverse skinning: from posed points back to the shaped rest pose, by five methods.

The forward map is x = sum over j of w_j(p) T_j p, with w(p) the weights of the point of the rest
surface that is closest to p. Reference: X. Chen et al., Fast-SNARF, 2023 (root finding from several
starts); the methods here are own code.
"""

import math
import weakref
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .body import BodyModel, PosedBody
from .diffused_weights import DiffusedField, newton_cells
from .errors import InputError
from .rigid import append_last_row, apply_linear, invert_linear
from .skinning import blend_transforms, unskin
from .skinning_field import SkinningField, vertex_maps
from .unskin_broyden import broyden_starts, rescued
from .unskin_newton import (
    ARRIVED,
    MIN_DET,
    Bones,
    Plan,
    Roots,
    guess_warp,
    newton_torch,
    newton_warp,
)

_ITERATIONS = {"nearest": 0, "surface": 0, "fixed_point": 5, "broyden": 20, "newton": 8}
_STARTS = {"nearest": 1, "surface": 1, "fixed_point": 1, "broyden": 1, "newton": 6}
_STOP, _STOP_TANGENTS = 5e-6, 4e-7  # metres, float32: Newton's last step is nearly free
_PAIRS = 1 << 24  # (point, vertex) pairs of one step of the nearest-vertex search
_FIELDS: "weakref.WeakKeyDictionary[BodyModel, SkinningField]" = weakref.WeakKeyDictionary()


@dataclass(frozen=True)
class Unskinned:
    """Rest-space points of posed points.

    Attributes:
        points: [N, 3] points in the space of the shaped rest pose, metres; where not valid, the
            best that was found.
        weights: [N, J] skinning weights that take them back.
        residual: [N] cycle error, metres: distance of the target and of the point skinned with the
            weights looked up again at it; infinite where the rest surface is out of reach. Not
            differentiable.
        valid: [N] residual <= 1 mm and the map at the point has an inverse.
    """

    points: Float[Tensor, "n 3"]
    weights: Float[Tensor, "n J"]
    residual: Float[Tensor, "n"]
    valid: Bool[Tensor, "n"]


def inverse_skin(
    points: Float[Tensor, "n 3"],
    posed: PosedBody,
    body: BodyModel,
    method: str = "newton",
    *,
    rest_verts: Float[Tensor, "V 3"] | SkinningField | None = None,
    max_distance: float = 0.2,
    starts: int | None = None,
    iterations: int | None = None,
) -> Unskinned:
    """Find the rest points that linear blend skinning moves to given posed points.

    Args:
        points: targets in local pose space (``posed.to_local`` of world points), metres.
        posed: the body, unbatched.
        body: its model.
        method: "nearest" (weights of the nearest posed vertex), "surface" (weights of the closest
            posed surface point), "fixed_point" (surface, then the weights are looked up again at
            the rest point), "broyden" (quasi-Newton in batched torch) or "newton" (voxel look-up of
            a first guess, then Newton steps with the analytic Jacobian, one kernel for all; what
            did not arrive goes through Broyden's method, but for a `DiffusedField`).
        rest_verts: shaped rest vertices ``body.shaped(betas)[0]``, or a `SkinningField` that holds
            them and names a back end; None is the mean shape, ``body.v_template``. The search
            structures of the last shape of a body are kept. A `DiffusedField` takes weights from a
            grid that extends them smoothly off the surface; points beyond the reach of its grid are
            not valid, and gradients to its rest vertices are zero.
        max_distance: rest points farther than this from the rest surface are not valid, metres.
        starts: first guesses: one from the posed surface, the others by the inverses of the nearest
            bones. Broyden runs them all and keeps the best; newton and fixed_point try the next
            where the last one failed; nearest and surface have one. None: newton 6, else 1.
        iterations: steps of one start. None: fixed_point 5, newton 8, broyden 20.

    Returns:
        Points, weights, cycle residual and mask. Points and weights are differentiable in `points`,
        in ``posed.transforms`` and in `rest_verts`: the three iterative methods by the implicit
        function theorem where valid (no gradient elsewhere), the others directly.

    Raises:
        InputError: unknown method, batched body, tensors that do not fit together, bad limits.

    Reference:
        X. Chen et al., Fast-SNARF, 2023, section 3 (several starts).

    >>> from .body import BodyPose
    >>> body = BodyModel.default()
    >>> posed = body(BodyPose.zeros(body))
    >>> found = inverse_skin(body.v_template[:4] + 0.001, posed, body, "surface")
    >>> found.valid.tolist()
    [True, True, True, True]
    """
    plan = plan_of(method, max_distance, starts, iterations, points.dtype)
    query = prepare(points, posed, body, rest_verts)
    if isinstance(query.field, DiffusedField):
        plan = replace(plan, rescues=0)  # its weights have no kinks to cross
    found = (_direct if method in ("nearest", "surface") else _iterative)(query, method, plan)
    return Unskinned(
        found.points,
        found.weights,
        torch.where(query.sound, found.residual, math.inf),
        found.valid & query.sound,
    )


@dataclass(frozen=True)
class Query:
    """Checked input of a search.

    Attributes:
        points: [N, 3] targets in pose space; those that are not finite are replaced.
        posed: the body; numbers that are not finite are replaced.
        field: the forward field.
        rest: [V, 3] rest vertices, as tensors that gradients go to.
        sound: [N] whether nothing was replaced.
    """

    points: Float[Tensor, "n 3"]
    posed: PosedBody
    field: SkinningField
    rest: Float[Tensor, "V 3"]
    sound: Bool[Tensor, "n"]

    @property
    def fast(self) -> bool:
        """Whether the Warp solvers serve it."""
        return self.field.backend == "warp" and self.points.dtype == torch.float32

    def bones(self) -> Bones:
        """Rigid inverses as first guesses, detached."""
        return Bones.of(self.posed.joints.detach(), self.posed.transforms.detach())


def prepare(
    points: Float[Tensor, "n 3"],
    posed: PosedBody,
    body: BodyModel,
    rest_verts: Float[Tensor, "V 3"] | SkinningField | None,
) -> Query:
    """Check the input of a search and mask what is not finite.

    Args:
        points: targets in pose space, metres.
        posed: the body, unbatched.
        body: its model.
        rest_verts: as in `inverse_skin`.

    Returns:
        The query.

    Raises:
        InputError: batched body, tensors that do not fit together.
    """
    field, rest = _field(points, posed, body, rest_verts)
    with torch.no_grad():
        whole = posed.transforms.isfinite().all()
        sound = points.isfinite().all(-1) & whole & posed.verts.isfinite().all()
    identity = torch.eye(4, dtype=points.dtype, device=points.device)
    # one bad number would spread through the search structures: such input is replaced, then masked
    posed = replace(
        posed,
        transforms=torch.where(whole, posed.transforms, identity),
        verts=torch.where(posed.verts.isfinite(), posed.verts, 0.0),
        joints=torch.where(posed.joints.isfinite(), posed.joints, 0.0),
    )
    return Query(torch.where(sound[:, None], points, 0.0), posed, field, rest, sound)


def plan_of(
    method: str, max_distance: float, starts: int | None, iterations: int | None, dtype: torch.dtype
) -> Plan:
    """Check how to search, and fill in what a method has as its default.

    Args:
        method: as in `inverse_skin`.
        max_distance: reach of the rest surface, metres.
        starts: first guesses, or None.
        iterations: steps of one start, or None.
        dtype: of the targets; decides when a residual is small enough.

    Returns:
        The plan.

    Raises:
        InputError: unknown method, or a limit out of range.
    """
    if method not in _ITERATIONS:
        raise InputError(f"method: expected one of {', '.join(_ITERATIONS)}, found {method!r}")
    starts = _STARTS[method] if starts is None else starts
    iterations = _ITERATIONS[method] if iterations is None else iterations
    for name, value, least in (("starts", starts, 1), ("iterations", iterations, 0)):
        if value < least:
            raise InputError(f"{name}: expected at least {least}, found {value}; or pass None")
    if not max_distance > 0:
        raise InputError(f"max_distance: expected metres > 0, found {max_distance}; use 0.2")
    tangents = method == "newton"
    stop = 1e-10 if dtype != torch.float32 else _STOP_TANGENTS if tangents else _STOP
    rescues = starts if tangents and iterations else 0
    return Plan(iterations, starts, max_distance, stop, tangents, rescues)


def _field(
    points: Tensor,
    posed: PosedBody,
    body: BodyModel,
    rest_verts: "Tensor | SkinningField | None",
) -> tuple[SkinningField, Tensor]:
    """The forward field, and the rest vertices that gradients go to."""
    if posed.transforms.ndim != 3 or posed.transforms.shape[0] != body.num_joints:
        raise InputError(
            f"posed: expected one body with {body.num_joints} joints, found transforms of shape "
            f"{tuple(posed.transforms.shape)}; pass one body of the batch, posed by this model"
        )
    body = body.to(points)
    rest = rest_verts.rest if isinstance(rest_verts, SkinningField) else rest_verts
    rest = body.v_template if rest is None else rest
    for name, other in (("posed", posed.transforms), ("rest_verts", rest)):
        if other.dtype != points.dtype or other.device != points.device:
            raise InputError(
                f"{name}: expected dtype and device of points ({points.dtype}, {points.device}), "
                f"found {other.dtype}, {other.device}; convert one of them"
            )
    if isinstance(rest_verts, SkinningField):
        return rest_verts, rest
    kept = _FIELDS.get(body)
    if kept is None or not torch.equal(kept.rest, rest.detach()):
        kept = SkinningField(body, rest.detach().clone())
        _FIELDS[body] = kept
    return kept, rest


def _direct(query: Query, method: str, plan: Plan) -> Unskinned:
    """One look-up of the weights on the posed body, one inverse."""
    points, posed, field = query.points, query.posed, query.field
    if method == "nearest":
        weights = field.weights[_nearest_vertex(points, posed.verts)]
    else:
        hit = field.posed_index(posed.verts).query(points)
        weights = field.mix(hit.face, hit.bary)
    rest, ok = unskin(points, blend_transforms(posed.transforms, weights), MIN_DET)
    with torch.no_grad():
        maps = field.maps(posed.transforms)
        face, near = field.search(rest.detach(), plan.max_distance)
        image = field.at(rest, face, maps).image
        residual = torch.where(near, (image - points).norm(dim=-1), math.inf)
    return Unskinned(rest, weights, residual, ok & (residual <= ARRIVED))


def _nearest_vertex(points: Tensor, verts: Tensor) -> Tensor:
    with torch.no_grad():
        step = max(1, _PAIRS // verts.shape[0])
        parts = [torch.cdist(chunk, verts).argmin(1) for chunk in points.split(step)]
    return torch.cat(parts)


def _iterative(query: Query, method: str, plan: Plan) -> Unskinned:
    """Search without gradients, then attach them at the solution."""
    maps = query.field.maps(query.posed.transforms)
    with torch.no_grad():
        still, bones = maps.detach(), query.bones()
        if method == "newton" and query.fast:
            roots, weights = solve(query, still, bones, plan, None)
        else:
            roots = _search(method, query, still, bones, plan)
            weights = weights_of(query, roots)
        valid = roots.invertible & (roots.residual <= ARRIVED)
    moved, weights = attach(query, maps, roots, weights, valid)
    return Unskinned(moved, weights, roots.residual, valid)


def solve(
    query: Query,
    maps: Float[Tensor, "m 3 4"],
    bones: Bones,
    plan: Plan,
    guess: Float[Tensor, "n 3"] | None,
) -> tuple[Roots, Float[Tensor, "n J"]]:
    """Run the Warp solver of the field.

    Args:
        query: targets and field, float32.
        maps: ``field.maps`` of the pose, detached.
        bones: for the starts after the first.
        plan: how to search.
        guess: first rest points; None looks them up.

    Returns:
        The roots and their weights [N, J].
    """
    field, points = query.field, query.points.detach()
    if not isinstance(field, DiffusedField):
        return newton_warp(field, points, maps, bones, plan, guess)
    if guess is None:
        verts_maps = vertex_maps(query.posed.transforms.detach(), field.weights)
        guess, _ = guess_warp(field, points, verts_maps, plan.max_distance)
    return newton_cells(field, points, maps, bones, plan, guess)


def weights_of(query: Query, roots: Roots) -> Float[Tensor, "n J"]:
    """Skinning weights of roots.

    Args:
        query: gives the field.
        roots: found by a search without weights.

    Returns:
        Weights [N, J], zeros where nothing was within reach.
    """
    weights = query.field.weights_on(roots.points, roots.face, query.field.rest)
    return weights * roots.residual.isfinite()[:, None]


def attach(
    query: Query,
    maps: Float[Tensor, "m 3 4"],
    roots: Roots,
    weights: Float[Tensor, "n J"],
    valid: Bool[Tensor, "n"],
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n J"]]:
    """Give roots the derivatives of the implicit function theorem.

    Args:
        query: targets and field.
        maps: ``field.maps`` of the pose, not detached.
        roots: where the search ended.
        weights: their skinning weights.
        valid: elsewhere no gradient flows.

    Returns:
        Rest points and weights, equal in value.
    """
    points, field, rest = query.points, query.field, query.rest
    wanted = points.requires_grad or maps.requires_grad or rest.requires_grad
    if not (torch.is_grad_enabled() and wanted):
        return roots.points, weights
    at = field.at(roots.points, roots.face, maps, rest)
    inverse, ok = invert_linear(at.jacobian().detach(), MIN_DET)
    # p - J^-1 (f(p) - x) with p and J held: its first derivatives are those of the root
    step = apply_linear(inverse, points - at.image)
    step = torch.where((ok & valid)[:, None], step - step.detach(), 0.0)
    moved = roots.points + step
    exact = field.weights_on(moved, roots.face, rest)
    return moved, weights + torch.where((ok & valid)[:, None], exact - exact.detach(), 0.0)


def surface_guess(query: Query) -> Float[Tensor, "n 3"]:
    """First rest points: the result of the method "surface".

    Args:
        query: targets and posed body.

    Returns:
        Rest points, detached.
    """
    field, points, posed = query.field, query.points.detach(), query.posed
    hit = field.posed_index(posed.verts.detach()).query(points)
    maps = vertex_maps(posed.transforms.detach(), field.weights)
    blended = (maps[field.faces[hit.face]] * hit.bary[..., None, None]).sum(1)
    return unskin(points, append_last_row(blended), MIN_DET)[0]


def _search(method: str, query: Query, maps: Tensor, bones: Bones, plan: Plan) -> Roots:
    guess, points = surface_guess(query), query.points.detach()
    if method == "broyden":
        return broyden_starts(query.field, points, maps, bones, plan, guess)
    if query.fast:
        return solve(query, maps, bones, plan, guess.contiguous())[0]
    found = newton_torch(query.field, points, maps, bones, plan, guess)
    return rescued(found, query.field, points, maps, bones, plan, guess)
