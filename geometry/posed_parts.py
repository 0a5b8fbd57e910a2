"""The parts of many posed bodies, ready to be asked: samples -> (sample, part) pairs -> rest.

This is the hot path of a part-based method as three calls that another method can use alone:
``shell.sample`` (rays to samples), ``pairs`` (closest surface of each part within its radius) and
``unskin`` (canonical point and UV of each pair). Poses are constants; only ``reskin`` is
differentiable, in its points.
"""

import copy
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .body import BodyModel, PosedBody
from .culling import BodyShell, ShellSamples
from .errors import InputError
from .face_tree import FaceTrees
from .index_checks import check_indices
from .parts import PartMap, rows_of_parts
from .rigid import append_last_row, invert_affine, transform_points
from .skinning import blend_transforms
from .surface import vertex_normals


@dataclass(frozen=True)
class PartPairs:
    """(sample, part) pairs sorted by part: each part owns one slice.

    Attributes:
        sample: [M] int64 row of the sample.
        part: [M] int64 part.
        face: [M] int64 closest face of that part, an index into the faces of the body.
        bary: [M, 2] first two barycentrics on it.
        counts: pairs of each part.
    """

    sample: Int[Tensor, "m"]
    part: Int[Tensor, "m"]
    face: Int[Tensor, "m"]
    bary: Float[Tensor, "m 2"]
    counts: tuple[int, ...]


@dataclass(frozen=True)
class RestPoints:
    """Where pairs lie in canonical space.

    Attributes:
        points: [M, 3] canonical points, metres.
        uv: [M, 2] UV of the closest surface point, interpolated inside its face.
        valid: [M] False where the blended transform has no inverse (det <= 1e-2).
    """

    points: Float[Tensor, "m 3"]
    uv: Float[Tensor, "m 2"]
    valid: Bool[Tensor, "m"]


@dataclass(frozen=True)
class PartHit:
    """Closest points on given parts of the only body of a :class:`PosedParts`.

    Attributes:
        face: [M] int64 face of the body.
        bary: [M, 3] barycentrics.
        uv: [M, 2] UV there.
        found: [M] False beyond the search radius.
    """

    face: Int[Tensor, "m"]
    bary: Float[Tensor, "m 3"]
    uv: Float[Tensor, "m 2"]
    found: Bool[Tensor, "m"]


def full_bary(bary: Float[Tensor, "m 2"]) -> Float[Tensor, "m 3"]:
    """All three barycentrics from the first two.

    Args:
        bary: first two barycentrics.

    Returns:
        The same with the third, which makes their sum 1; differentiable in bary.
    """
    return torch.cat([bary, 1.0 - bary.sum(-1, keepdim=True)], -1)


def _rows(transforms: Tensor) -> Tensor:
    """The upper three rows of affine maps, as [N, 3, 4], contiguous."""
    return transforms[..., :3, :].reshape(-1, 3, 4).contiguous()


class PosedParts:
    """Search structures of the parts of posed bodies, and the maps to canonical space."""

    def __init__(
        self,
        body: BodyModel,
        posed: PosedBody,
        canonical: PosedBody,
        parts: PartMap,
        radius: float | Float[Tensor, "k"] = 0.05,
        shell: BodyShell | None = None,
    ) -> None:
        """Build shells, search trees and blended maps.

        Args:
            body: the body model; its UVs must exist.
            posed: the bodies, batched [B] or single, local pose space, metres.
            canonical: one body in the canonical pose.
            parts: the part of each joint.
            radius: metres; a point farther than this from a part's surface does not belong to it.
            shell: the shell of these bodies where a caller has one, of the same radius and parts.

        Raises:
            InputError: the body has no UVs, or the shell is of another number of bodies.
        """
        if body.uv is None:
            raise InputError("body: expected UV coordinates, found none; unwrap the body first")
        verts = posed.verts.detach().reshape(-1, body.num_verts, 3).float().contiguous()
        self.verts, self.device = verts, verts.device
        self.faces = body.faces.to(verts.device)
        self.face_part = parts.face_parts(body.weights, body.faces).to(verts.device)
        self.num_parts = len(parts.names)
        self.rotation = posed.rotation.detach().reshape(-1, 3, 3).to(verts)
        self.translation = posed.translation.detach().reshape(-1, 3).to(verts)
        radii = torch.as_tensor(radius, dtype=torch.float32, device=verts.device)
        self.radius = radii.expand(self.num_parts).contiguous()
        self.shell = shell or BodyShell(verts, self.faces, self.radius, self.face_part)
        if len(self.shell.lo) != len(verts):
            raise InputError(
                f"shell: expected {len(verts)} bodies, found {len(self.shell.lo)}; build it from "
                "the vertices of these bodies"
            )
        self.corner_uv = body.uv.corner_uv.to(verts).contiguous()
        weights = body.weights.to(verts)
        flat = posed.transforms.detach().reshape(-1, body.num_joints, 4, 4).to(verts)
        self.posed_maps = _rows(blend_transforms(flat, weights))
        self.canonical_maps = _rows(blend_transforms(canonical.transforms.to(verts), weights))
        self.trees = FaceTrees(
            verts, self.faces, self.face_part, self.num_parts, canonical.verts.to(verts)
        )

    def unculled(self) -> "PosedParts":
        """The same bodies without voxel culling, for comparison: slower, the same pairs."""
        other = copy.copy(self)
        other.shell = self.shell.filled()
        return other

    def _search(
        self, points: Tensor, body: Tensor, candidates: Tensor, radius: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Per part and point: closest face within the part's radius (-1: none), barycentrics."""
        from .kernels.closest import closest_on_parts
        from .kernels.launch import launch, view

        count = points.shape[0]
        face = torch.empty(self.num_parts, count, dtype=torch.int32, device=self.device)
        bary = torch.empty(self.num_parts, count, 2, device=self.device)
        args = [
            *self.trees.args(),
            view(self.verts, 3),
            view(self.trees.corners, 3),
            view(points, 3),
        ]
        args += [view(body), view(candidates), view(radius), view(face), view(bary, 2)]
        launch(closest_on_parts, count, args, points)
        return face, bary

    def pairs(self, samples: ShellSamples) -> PartPairs:
        """Every (sample, part) whose part surface is within that part's radius.

        Args:
            samples: from ``self.shell.sample``.

        Returns:
            The pairs, sorted by part, then by sample.
        """
        face, bary = self._search(samples.points, samples.body, samples.candidates, self.radius)
        part, sample = torch.nonzero(face >= 0, as_tuple=True)
        counts = rows_of_parts(part, self.num_parts)
        return PartPairs(sample, part, face[part, sample].long(), bary[part, sample], counts)

    def unskin(self, samples: ShellSamples, pairs: PartPairs) -> RestPoints:
        """Canonical point B(w) A(w)^-1 p and UV of each pair (MonoPartNeRF, eq. 1, rigid term).

        Args:
            samples: the samples that the pairs index.
            pairs: from :meth:`pairs`.

        Returns:
            Canonical points in metres, UVs, and where the inverse exists.
        """
        from .kernels.closest import unskin_pairs
        from .kernels.launch import launch, view

        count = pairs.sample.shape[0]
        points = torch.zeros(count, 3, device=self.device)
        uv = torch.zeros(count, 2, device=self.device)
        valid = torch.zeros(count, dtype=torch.bool, device=self.device)
        args = [view(pairs.sample), view(samples.points, 3), view(samples.body)]
        args += [view(pairs.face), view(pairs.bary, 2), view(self.trees.corners, 3)]
        args += [view(self.corner_uv, 2), view(self.posed_maps, 4), view(self.canonical_maps, 4)]
        args += [self.verts.shape[1], 1e-2, view(points, 3), view(uv, 2), view(valid)]
        launch(unskin_pairs, count, args, samples.points)
        return RestPoints(points, uv, valid)

    def world_normals(self) -> Float[Tensor, "b v 3"]:
        """Which way the surface looks at the vertices, in the world.

        Returns:
            Unit normals that point outside, zero for a vertex without area; constants.
        """
        return vertex_normals(self.verts, self.faces) @ self.rotation.mT

    def interpolate(
        self,
        values: Float[Tensor, "b v c"],
        body: Int[Tensor, "m"],
        face: Int[Tensor, "m"],
        bary: Float[Tensor, "m 2"],
    ) -> Float[Tensor, "m c"]:
        """Values of vertices on points of the surface.

        Args:
            values: of the vertices of all bodies; no gradient.
            body: body of each point.
            face: face on which it lies, an index into the faces of the body.
            bary: first two barycentrics on it.

        Returns:
            Their means, weighted by the barycentrics; constants.

        Raises:
            InputError: a body or a face that is not there (not looked for on CUDA, where a look at
                the values would wait).
        """
        for name, index, end in (("body", body, len(values)), ("face", face, len(self.faces))):
            check_indices(name, index, end, "; pairs of points without a hit have none")
        table = values.detach().flatten(0, 1)
        if table.dtype == torch.float32 and table.shape[1] % 4 == 0:
            from .kernels.closest import interpolate_rows
            from .kernels.launch import launch, view

            out = table.new_empty(len(face), table.shape[1])
            args = [view(table.contiguous().unflatten(1, (-1, 4)), 4), view(body), view(face)]
            args += [view(bary.contiguous(), 2), view(self.trees.corners, 3), values.shape[1]]
            launch(interpolate_rows, len(face), [*args, view(out.unflatten(1, (-1, 4)), 4)], out)
            return out
        corners = self.faces[face] + body[:, None] * values.shape[1]
        return (table[corners] * full_bary(bary).to(table)[..., None]).sum(1)

    def on_part(
        self, points: Float[Tensor, "m 3"], part: Int[Tensor, "m"], reach: float = 0.2
    ) -> PartHit:
        """Closest surface of one given part to each point, on the first body.

        Args:
            points: positions in the frame of the body, metres.
            part: part of each point.
            reach: search radius, metres.
        """
        count = points.shape[0]
        queries = points.detach().float().contiguous()
        body = torch.zeros(count, dtype=torch.int32, device=self.device)
        radius = torch.full_like(self.radius, reach)
        face, bary = self._search(queries, body, (1 << part).int(), radius)
        rows = torch.arange(count, device=self.device)
        index = face[part, rows].long()
        found = index >= 0
        index = index * found
        two = bary[part, rows]
        full = full_bary(two)
        uv = (full[..., None] * self.corner_uv[index]).sum(-2)
        return PartHit(index, full, uv, found)

    def reskin(
        self,
        points: Float[Tensor, "m 3"],
        body: Int[Tensor, "m"],
        hit: PartHit,
        canonical: "PosedParts",
    ) -> Float[Tensor, "m 3"]:
        """Canonical points in pose space: A(w') B(w')^-1 c with the weights of a canonical hit.

        Args:
            points: canonical points, metres.
            body: body of each point.
            hit: their closest points on the canonical body.
            canonical: the canonical body, from which ``hit`` came.

        Returns:
            Posed points, metres; differentiable in points (the hit is held, as in eq. 2).
        """
        corners = self.faces[hit.face]
        away = _blend(canonical.canonical_maps, corners, hit.bary)
        there = _blend(self.posed_maps, corners + body[:, None] * self.verts.shape[1], hit.bary)
        inverse, _ = invert_affine(append_last_row(away))
        return transform_points(append_last_row(there), transform_points(inverse, points))


def _blend(maps: Tensor, corners: Tensor, bary: Tensor) -> Tensor:
    return (maps[corners] * bary[..., None, None]).sum(1)
