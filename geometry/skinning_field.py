"""The forward skinning field of a rest surface: weights, maps and the Jacobian at every point.

The weights of a rest-space point are those of its closest rest-surface point, linear on a triangle.
So x(p) = A(w(p)) p, A(w) = sum of w_j T_j, has the Jacobian A(w) + sum over corners of
(A_c p) (grad b_c)^T with b_c the barycentrics of the closest point, on a face, an edge or a corner.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .body import BodyModel
from .errors import InputError
from .surface import SurfaceIndex, closest_on_triangle

# lists of the possible closest faces near the rest surface: metres, metres, faces per voxel
_VOXEL, _REACH, _LISTED = 0.015, 0.06, 64


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
        self._lists: dict[str, Any] | None = None

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

    def posed_index(self, verts: Float[Tensor, "V 3"]) -> SurfaceIndex:
        """Search structure of the posed surface, refit from pose to pose."""
        if self._posed is None:
            self._posed = SurfaceIndex(verts, self.faces, self.backend)
        else:
            self._posed.refit(verts)
        return self._posed

    def near_lists(self) -> dict[str, Any]:
        """Per voxel near the rest surface its possible closest faces, built once in about 1 s."""
        if self._lists is None:
            self._lists = _build_lists(self)
        return self._lists


def mesh_id(index: SurfaceIndex) -> Any:
    """Warp's handle of the mesh of an index.

    Args:
        index: with the warp back end.

    Returns:
        A launch argument.
    """
    return index._mesh.id  # type: ignore[union-attr]


def _build_lists(field: SkinningField) -> dict[str, Any]:
    from .kernels.launch import launch, view
    from .kernels.near_faces import list_faces, mark_near

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
    mesh = mesh_id(field.index)
    launch(mark_near, count, [mesh, lo, dims, voxel, reach, view(near)], rest)
    cells = near.nonzero().squeeze(-1)
    slots = torch.full((count,), -1, dtype=torch.int32, device=rest.device)
    slots[cells] = torch.arange(len(cells), dtype=torch.int32, device=rest.device)
    entries = torch.full((len(cells), _LISTED, 2), -1.0, device=rest.device)
    cells = cells.int()
    args = [mesh, view(tris, 3), view(cells), lo, dims, voxel, view(entries, 2)]
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
        "near": entries,
    }


def _discs(tris: Tensor) -> Tensor:
    """Per face a disc that holds it, [F, 2, 4]: centre and radius, then the unit normal."""
    centre = tris.mean(1)
    radius = (tris - centre[:, None]).norm(dim=-1).amax(1) * (1 + 1e-4) + 1e-6
    normal = torch.linalg.cross(tris[:, 1] - tris[:, 0], tris[:, 2] - tris[:, 0])
    normal = torch.nn.functional.normalize(normal, dim=-1, eps=1e-30)
    disc = torch.cat([centre, radius[:, None]], -1)
    return torch.stack([disc, torch.nn.functional.pad(normal, (0, 1))], 1).contiguous()
