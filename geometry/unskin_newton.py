"""The forward skinning field of a rest surface, and Newton's method on it (torch and Warp).

The weights of a rest-space point are those of its closest rest-surface point, linear on each triangle, so that
x(p) = A(w(p)) p with A(w) = sum of w_j T_j has the Jacobian A(w) + sum over corners c of (A_c p) (grad b_c)^T,
b_c the barycentrics of the closest point: constant on a face, along an edge, or at a corner.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .body import BodyModel
from .errors import InputError
from .rigid import apply_linear, invert_affine, invert_linear
from .surface import SurfaceIndex, closest_on_triangle

MIN_DET = 1e-2  # a map with a smaller |determinant| has no inverse worth having
ARRIVED = 1e-3  # metres: a residual up to this counts as a root
LONGEST_STEP = 0.2  # metres: a Newton step of a nearly singular Jacobian is cut to this
_VOXEL, _REACH, _LISTED = 0.0125, 0.06, 48  # near-face lists of the rest surface: metres, metres, faces
_GRID, _SPLAT = 72, 2.5  # first-guess grid of a pose: voxels per side, reach in voxels


@dataclass(frozen=True)
class FieldPoint:
    """The forward field at rest points with known faces.

    Attributes:
        image: [N, 3] posed points, metres.
        bary: [N, 3] barycentrics of the closest rest-surface points.
        linear: [N, 3, 3] A(w), the linear part of the blended maps.
        corner_images: [N, 3, 3] the points under the map of each corner (corner index second).
        triangles: [N, 3, 3] rest corners.
    """

    image: Float[Tensor, "n 3"]
    bary: Float[Tensor, "n 3"]
    linear: Float[Tensor, "n 3 3"]
    corner_images: Float[Tensor, "n 3 3"]
    triangles: Float[Tensor, "n 3 3"]


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


@dataclass(frozen=True)
class Plan:
    """How to search.

    Attributes:
        iterations: steps of one start.
        starts: first guesses at most; the next one is for points that did not arrive.
        max_distance: reach of the rest surface, metres.
        stop: residual that ends the iterations of a point, metres.
        gradients: Newton's Jacobian; False only re-queries the weights.
    """

    iterations: int
    starts: int
    max_distance: float
    stop: float
    gradients: bool


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


def vertex_maps(
    transforms: Float[Tensor, "J 4 4"], weights: Float[Tensor, "V J"]
) -> Float[Tensor, "V 3 4"]:
    """Blended 3x4 maps of the vertices; the map of a surface point is their barycentric mix, exactly."""
    return (weights @ transforms[:, :3, :].flatten(1)).unflatten(-1, (3, 4))


def field_at(
    points: Float[Tensor, "n 3"],
    face: Int[Tensor, "n"],
    rest: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    maps: Float[Tensor, "V 3 4"],
) -> FieldPoint:
    """Evaluate the forward field where the closest face is known; differentiable in all but the indices."""
    corners = faces[face]
    triangles = rest[corners]
    bary = closest_on_triangle(points, triangles)
    corner_maps = maps[corners]
    images = (corner_maps[..., :3] * points[:, None, None, :]).sum(-1) + corner_maps[..., 3]
    image = (bary[..., None] * images).sum(1)
    linear = (bary[..., None, None] * corner_maps[..., :3]).sum(1)
    return FieldPoint(image, bary, linear, images, triangles)


def _bary_gradients(bary: Tensor, triangles: Tensor) -> Tensor:
    """Gradients [N, 3 corners, 3] of the barycentrics of the closest point, by face, edge or corner."""
    a, b, c = triangles.unbind(1)
    on = bary > 0
    tiny = torch.finfo(bary.dtype).tiny

    def along(start: Tensor, end: Tensor) -> Tensor:
        edge = end - start
        return edge / edge.square().sum(-1, keepdim=True).clamp(min=tiny)

    ab, ac = b - a, c - a
    d00, d01, d11 = ((u * v).sum(-1, keepdim=True) for u, v in ((ab, ab), (ab, ac), (ac, ac)))
    det = (d00 * d11 - d01 * d01).clamp(min=tiny)
    zero = torch.zeros_like(a)
    grad_b, grad_c = zero, zero
    e_ab, e_ac, e_bc = along(a, b), along(a, c), along(b, c)
    cases = [
        (on.all(-1), (ab * d11 - ac * d01) / det, (ac * d00 - ab * d01) / det),
        (on[:, 0] & on[:, 1] & ~on[:, 2], e_ab, zero),
        (on[:, 0] & on[:, 2] & ~on[:, 1], zero, e_ac),
        (on[:, 1] & on[:, 2] & ~on[:, 0], -e_bc, e_bc),
    ]
    for mask, gb, gc in cases:
        grad_b = torch.where(mask[:, None], gb, grad_b)
        grad_c = torch.where(mask[:, None], gc, grad_c)
    return torch.stack([-grad_b - grad_c, grad_b, grad_c], 1)


def field_jacobian(at: FieldPoint) -> Float[Tensor, "n 3 3"]:
    """The analytic Jacobian of the forward field: A(w) + sum over corners of (A_c p) (grad b_c)^T."""
    gradients = _bary_gradients(at.bary, at.triangles)
    return at.linear + (at.corner_images[..., :, None] * gradients[..., None, :]).sum(1)


class SkinningField:
    """Skinning weights of every point around a rest surface: those of the closest surface point.

    Holds the search structures of one shape; they are built on first use and shared by all poses.

    >>> body = BodyModel.default()
    >>> field = SkinningField(body)
    >>> field.weights_at(body.v_template[:5]).sum(-1)
    tensor([1.0000, 1.0000, 1.0000, 1.0000, 1.0000])
    """

    def __init__(
        self,
        body: BodyModel,
        rest_verts: Float[Tensor, "V 3"] | None = None,
        backend: str = "auto",
    ) -> None:
        """Prepare the field.

        Args:
            body: gives faces and weights.
            rest_verts: shaped rest vertices, metres (``body.shaped(betas)[0]``); None is the mean shape.
            backend: "warp" (float32 search and solver), "torch" (reference, brute force) or "auto" (warp).

        Raises:
            InputError: the vertices do not fit the body, or the backend is unknown.
        """
        rest = body.v_template if rest_verts is None else rest_verts
        if rest.shape[0] != body.num_verts:
            raise InputError(
                f"rest_verts: expected {body.num_verts} vertices (the body's), found "
                f"{rest.shape[0]}; pass body.shaped(betas)[0]"
            )
        body = body.to(rest)
        self.rest = rest
        self.faces = body.faces
        self.weights = body.weights
        self.index = SurfaceIndex(rest.detach(), self.faces, backend)
        self.backend = self.index.backend
        self._posed: SurfaceIndex | None = None
        self._lists: dict[str, Any] | None = None

    def weights_at(
        self, points: Float[Tensor, "n 3"], max_distance: float = math.inf
    ) -> Float[Tensor, "n J"]:
        """Skinning weights of rest-space points; rows of zeros beyond ``max_distance`` of the surface."""
        hit = self.index.query(points, max_distance)
        return self.mix(hit.face, hit.bary) * hit.found[:, None]

    def mix(self, face: Int[Tensor, "n"], bary: Float[Tensor, "n 3"]) -> Float[Tensor, "n J"]:
        """Weights of surface points given by face and barycentrics."""
        corners = self.faces[face]
        first, second, third = (self.weights[corners[:, k]] for k in range(3))
        return first * bary[:, :1] + second * bary[:, 1:2] + third * bary[:, 2:]

    def posed_index(self, verts: Float[Tensor, "V 3"]) -> SurfaceIndex:
        """Search structure of the posed surface, refit from pose to pose."""
        if self._posed is None:
            self._posed = SurfaceIndex(verts, self.faces, self.backend)
        else:
            self._posed.refit(verts)
        return self._posed

    def near_lists(self) -> dict[str, Any]:
        """Per voxel near the rest surface, its possible closest faces, nearest first (built once)."""
        if self._lists is None:
            self._lists = _build_lists(self)
        return self._lists


def _mesh_id(index: SurfaceIndex) -> Any:
    """Warp's handle of the mesh of an index with the warp back end."""
    return index._mesh.id  # type: ignore[union-attr]


def _build_lists(field: SkinningField) -> dict[str, Any]:
    from .kernels.launch import launch, view
    from .kernels.newton import list_faces, mark_near

    rest = field.rest.detach().float()
    tris = rest[field.faces].contiguous()
    low, high = rest.amin(0) - _REACH, rest.amax(0) + _REACH
    # a shape far larger than a person gets larger voxels, not more of them
    voxel = max(_VOXEL, float((high - low).prod()) ** (1 / 3) / 160)
    reach = _REACH * voxel / _VOXEL
    low, high = rest.amin(0) - reach, rest.amax(0) + reach
    lo = tuple(low.tolist())
    dims = tuple(((high - low) / voxel).ceil().int().tolist())
    count = math.prod(dims)
    near = torch.zeros(count, dtype=torch.bool, device=rest.device)
    mesh = _mesh_id(field.index)
    launch(mark_near, count, [mesh, lo, dims, voxel, reach, view(near)], rest)
    cells = near.nonzero().squeeze(-1)
    slots = torch.full((count,), -1, dtype=torch.int32, device=rest.device)
    slots[cells] = torch.arange(len(cells), dtype=torch.int32, device=rest.device)
    face = torch.full((len(cells), _LISTED), -1, dtype=torch.int32, device=rest.device)
    gap = torch.zeros(len(cells), _LISTED, device=rest.device)
    cells = cells.int()
    args = [mesh, view(tris, 3), view(cells), lo, dims, voxel, view(face), view(gap)]
    launch(list_faces, len(cells), args, rest)
    return {
        "tris": tris,
        "discs": _discs(tris),
        "faces": field.faces.int().contiguous(),
        "weights": field.weights.float().contiguous(),
        "lo": lo,
        "dims": dims,
        "voxel": voxel,
        "slots": slots,
        "face": face,
        "gap": gap,
    }


def _discs(tris: Tensor) -> Tensor:
    """Per face a disc that holds it, [F, 2, 4]: centre and radius, then the unit normal."""
    centre = tris.mean(1)
    radius = (tris - centre[:, None]).norm(dim=-1).amax(1) * (1 + 1e-4) + 1e-6
    normal = torch.linalg.cross(tris[:, 1] - tris[:, 0], tris[:, 2] - tris[:, 0])
    normal = torch.nn.functional.normalize(normal, dim=-1, eps=1e-30)
    disc = torch.cat([centre, radius[:, None]], -1)
    return torch.stack([disc, torch.nn.functional.pad(normal, (0, 1))], 1).contiguous()


def guess_warp(
    field: SkinningField,
    points: Float[Tensor, "n 3"],
    maps: Float[Tensor, "V 3 4"],
    max_distance: float,
) -> Float[Tensor, "n 3"]:
    """First guesses: the inverse map of the posed vertex that the voxel of a point names.

    Where the voxel is empty it is a corner of the closest posed face within twice ``max_distance``,
    beyond that the point itself.
    """
    from .kernels.launch import launch, launch_one, view
    from .kernels.newton import EMPTY, first_guess, splat_verts

    rest = field.rest.detach().contiguous()
    skinned = ((maps[..., :3] * rest[:, None, :]).sum(-1) + maps[..., 3]).contiguous()
    inverse, _ = invert_linear(maps[..., :3], MIN_DET)
    inverse = inverse.contiguous()
    low, high = skinned.amin(0), skinned.amax(0)
    # corner and voxel size stay on the device; the reach is kept free around the body
    border = math.ceil(_SPLAT)
    voxel = ((high - low).amax() / (_GRID - 2 * border)).clamp(min=1e-3)
    frame = torch.cat([low - border * voxel, voxel[None]])
    nearest = torch.full((_GRID**3,), EMPTY, device=points.device)
    args = [view(skinned, 3), view(frame), _GRID, _SPLAT, view(nearest)]
    launch_one(splat_verts, len(skinned), args, points)
    posed = field.posed_index(skinned)
    faces = field.near_lists()["faces"]
    guess = torch.zeros_like(points)
    args = [view(points, 3), view(frame), _GRID, view(nearest), _mesh_id(posed), view(faces, 3)]
    args += [min(2 * max_distance, 1e10), view(rest, 3), view(skinned, 3), view(inverse, 3)]
    launch(first_guess, len(points), [*args, view(guess, 3)], points)
    return guess


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
    from .kernels.launch import launch, view
    from .kernels.newton import solve

    points, maps = points.contiguous(), maps.contiguous()
    if guess is None:
        guess = guess_warp(field, points, maps, plan.max_distance)
    count, device, lists = len(points), points.device, field.near_lists()
    rest = torch.zeros_like(points)
    weights = torch.zeros(count, field.weights.shape[1], device=device)
    face = torch.zeros(count, dtype=torch.int32, device=device)
    residual = torch.zeros(count, device=device)
    invertible = torch.zeros(count, dtype=torch.bool, device=device)
    limits = (plan.stop, ARRIVED, MIN_DET, min(plan.max_distance, 1e10))
    args = [view(points, 3), view(guess, 3), _mesh_id(field.index), view(lists["tris"], 3)]
    args += [view(lists["discs"], 4), view(lists["faces"], 3), lists["lo"], lists["dims"]]
    args += [lists["voxel"], view(lists["slots"]), view(lists["face"]), view(lists["gap"])]
    args += [view(maps, 4), view(lists["weights"]), view(bones.joints, 3), view(bones.inverses, 4)]
    args += [plan.starts, plan.iterations, int(plan.gradients), limits]
    out = [view(rest, 3), view(weights), view(face), view(residual), view(invertible)]
    launch(solve, count, [*args, *out], points)
    residual = torch.where(face >= 0, residual, math.inf)
    return Roots(rest, face.clamp(min=0).long(), residual, invertible), weights


def newton_torch(
    field: SkinningField,
    points: Float[Tensor, "n 3"],
    maps: Float[Tensor, "V 3 4"],
    bones: Bones,
    plan: Plan,
    guess: Float[Tensor, "n 3"],
) -> Roots:
    """The plain twin of :func:`newton_warp`, in the dtype of the input."""
    best = nowhere(guess)
    for start in range(min(plan.starts, bones.joints.shape[0] + 1)):
        todo = (best.residual > ARRIVED).nonzero().squeeze(-1)
        first = guess if start == 0 else bones.guess(points, start - 1)
        found = _descend(field, points[todo], maps, plan, first[todo])
        best = keep_better(best, _spread(found, todo, best))
    return best


def _descend(
    field: SkinningField, points: Tensor, maps: Tensor, plan: Plan, guess: Tensor
) -> Roots:
    """One start: Newton steps (or re-queries) that keep the best iterate."""
    rest, best = guess, nowhere(guess)
    for step in range(plan.iterations + 1):
        hit = field.index.query(rest, plan.max_distance)
        at = field_at(rest, hit.face, field.rest, field.faces, maps)
        error = points - at.image
        residual = torch.where(hit.found, error.norm(dim=-1), math.inf)
        inverse, ok = invert_linear(at.linear, MIN_DET)
        best = keep_better(best, Roots(rest, hit.face, residual, ok))
        active = hit.found & (best.residual > plan.stop)
        if step == plan.iterations or not bool(active.any()):
            break
        if plan.gradients:
            full, regular = invert_linear(field_jacobian(at), MIN_DET)
            inverse = torch.where(regular[:, None, None], full, inverse)
            ok = ok | regular
        move = apply_linear(inverse, error)
        move = move * (LONGEST_STEP / move.norm(dim=-1, keepdim=True).clamp(min=LONGEST_STEP))
        rest = torch.where((active & ok)[:, None], rest + move, rest)
    return best


def nowhere(guess: Float[Tensor, "n 3"]) -> Roots:
    """Roots that anything is better than."""
    face = torch.zeros(len(guess), dtype=torch.long, device=guess.device)
    residual = torch.full((len(guess),), math.inf, dtype=guess.dtype, device=guess.device)
    return Roots(guess.clone(), face, residual, torch.zeros_like(face, dtype=torch.bool))


def _spread(found: Roots, rows: Tensor, old: Roots) -> Roots:
    """Roots of some rows among all rows, elsewhere nothing."""
    all_rows = nowhere(old.points)
    return Roots(
        all_rows.points.index_copy(0, rows, found.points),
        all_rows.face.index_copy(0, rows, found.face),
        all_rows.residual.index_copy(0, rows, found.residual),
        all_rows.invertible.index_copy(0, rows, found.invertible),
    )


def keep_better(old: Roots, new: Roots) -> Roots:
    """Per point the one with the smaller residual; the old one where both are equal."""
    take = new.residual < old.residual
    return Roots(
        torch.where(take[:, None], new.points, old.points),
        torch.where(take, new.face, old.face),
        torch.where(take, new.residual, old.residual),
        torch.where(take, new.invertible, old.invertible),
    )
