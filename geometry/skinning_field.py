"""The forward skinning field of a rest surface: weights, maps and the Jacobian at every point.

The weights of a rest-space point are those of its closest rest-surface point, linear on a triangle.
So x(p) = A(w(p)) p, A(w) = sum of w_j T_j, has the Jacobian A(w) + sum over corners of
(A_c p) (grad b_c)^T with b_c the barycentrics of the closest point, on a face, an edge or a corner.
"""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .body import BodyModel
from .errors import InputError
from .surface import SurfaceIndex, closest_on_triangle


@runtime_checkable
class Mapped(Protocol):
    """What a search needs of the forward field at rest points."""

    @property
    def image(self) -> Tensor:
        """[N, 3] posed points, metres."""
        ...

    @property
    def linear(self) -> Tensor:
        """[N, 3, 3] linear part of the blended maps."""
        ...

    def jacobian(self) -> Float[Tensor, "n 3 3"]:
        """The Jacobian of the image in the points."""
        ...


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

    def jacobian(self) -> Float[Tensor, "n 3 3"]:
        """The Jacobian of the image in the points, see `field_jacobian`."""
        return field_jacobian(self)


def vertex_maps(
    transforms: Float[Tensor, "J 4 4"], weights: Float[Tensor, "V J"]
) -> Float[Tensor, "V 3 4"]:
    """Blended 3x4 maps of the vertices.

    Args:
        transforms: joint transforms, rest to posed.
        weights: skinning weights of the vertices.

    Returns:
        The maps; that of a point on a face is their barycentric mix, exactly. Differentiable.
    """
    return (weights @ transforms[:, :3, :].flatten(1)).unflatten(-1, (3, 4))


def field_at(
    points: Float[Tensor, "n 3"],
    face: Int[Tensor, "n"],
    rest: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    maps: Float[Tensor, "V 3 4"],
) -> FieldPoint:
    """The forward field where the closest face is known.

    Args:
        points: rest-space points, metres.
        face: closest rest face of each.
        rest: rest vertices, metres.
        faces: vertex indices of the rest surface.
        maps: from `vertex_maps`.

    Returns:
        The field; differentiable in points, rest vertices and maps.
    """
    corners = faces[face]
    triangles = rest[corners]
    bary = closest_on_triangle(points, triangles)
    corner_maps = maps[corners]
    images = (corner_maps[..., :3] * points[:, None, None, :]).sum(-1) + corner_maps[..., 3]
    image = (bary[..., None] * images).sum(1)
    linear = (bary[..., None, None] * corner_maps[..., :3]).sum(1)
    return FieldPoint(image, bary, linear, images, triangles)


def _bary_gradients(bary: Tensor, triangles: Tensor) -> Tensor:
    """Gradients [N, 3 corners, 3] of the barycentrics of the closest point."""
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
    """The Jacobian of the forward field in the rest points, analytic.

    Args:
        at: the field at the points.

    Returns:
        A(w) + sum over corners of (A_c p) (grad b_c)^T, on the closest face, edge or corner.
    """
    gradients = _bary_gradients(at.bary, at.triangles)
    return at.linear + (at.corner_images[..., :, None] * gradients[..., None, :]).sum(1)


class SkinningField:
    """Skinning weights of every point around a rest surface: those of the closest surface point.

    Holds the search structures of one shape; they are built on first use and shared by all poses.

    >>> body = BodyModel.default()
    >>> field = SkinningField(body)
    >>> torch.allclose(field.weights_at(body.v_template), body.weights, atol=1e-5)
    True
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
            rest_verts: shaped rest vertices, metres (``body.shaped(betas)[0]``); None is the mean
                shape.
            backend: "warp" (float32 search and solver), "torch" (brute-force reference) or "auto"
                (warp).

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
        self.weights32 = self.weights.float().contiguous()
        # a face at each vertex, -1 for a vertex that no face uses
        self.some_face = torch.full((len(rest),), -1, dtype=torch.int32, device=rest.device)
        number = torch.arange(len(self.faces), dtype=torch.int32, device=rest.device)
        for corner in range(3):
            self.some_face[self.faces[:, corner]] = number

    def weights_at(
        self, points: Float[Tensor, "n 3"], max_distance: float = math.inf
    ) -> Float[Tensor, "n J"]:
        """Skinning weights of rest-space points; zeros beyond ``max_distance`` of the surface."""
        hit = self.index.query(points, max_distance)
        return self.mix(hit.face, hit.bary) * hit.found[:, None]

    def mix(self, face: Int[Tensor, "n"], bary: Float[Tensor, "n 3"]) -> Float[Tensor, "n J"]:
        """Weights of surface points given by face and barycentrics."""
        corners = self.faces[face]
        first, second, third = (self.weights[corners[:, k]] for k in range(3))
        return first * bary[:, :1] + second * bary[:, 1:2] + third * bary[:, 2:]

    def maps(self, transforms: Float[Tensor, "J 4 4"]) -> Float[Tensor, "m 3 4"]:
        """Blended maps that `at` mixes: those of the vertices. Differentiable."""
        return vertex_maps(transforms, self.weights)

    def search(
        self, points: Float[Tensor, "n 3"], max_distance: float
    ) -> tuple[Int[Tensor, "n"], Bool[Tensor, "n"]]:
        """Closest face of rest points, and whether it is within ``max_distance``."""
        hit = self.index.query(points, max_distance)
        return hit.face, hit.found

    def at(
        self,
        points: Float[Tensor, "n 3"],
        face: Int[Tensor, "n"],
        maps: Float[Tensor, "m 3 4"],
        rest: Float[Tensor, "V 3"] | None = None,
    ) -> Mapped:
        """The forward field where `search` found ``face``; ``rest`` carries gradients."""
        return field_at(points, face, self.rest if rest is None else rest, self.faces, maps)

    def weights_on(
        self, points: Float[Tensor, "n 3"], face: Int[Tensor, "n"], rest: Float[Tensor, "V 3"]
    ) -> Float[Tensor, "n J"]:
        """Skinning weights where `search` found ``face``; differentiable in points and rest."""
        return self.mix(face, closest_on_triangle(points, rest[self.faces[face]]))

    def posed_index(self, verts: Float[Tensor, "V 3"]) -> SurfaceIndex:
        """Search structure of the posed surface, refit from pose to pose."""
        if self._posed is None:
            self._posed = SurfaceIndex(verts, self.faces, self.backend)
        else:
            self._posed.refit(verts)
        return self._posed
