"""The shell around posed bodies: what lies farther than a radius from every surface is skipped.

Voxels are marked conservatively: a voxel without a part's bit holds no point within the radius of
that part, so that skipping it is exact. One object holds the shells of many bodies (the frames of a
capture), and its methods take the index of the body of every ray or point.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .cameras import Rays
from .errors import InputError

_MOST_VOXELS = 2**31 - 1  # the kernels number them with 32 bits


@dataclass(frozen=True)
class ShellSamples:
    """Samples of rays inside the shell, ray after ray, front to back.

    Attributes:
        points: [M, 3] positions, metres, in the frame of the bodies.
        depth: [M] distance along the ray.
        ray: [M] int32 index of the ray.
        body: [M] int32 index of the body.
        candidates: [M] int32, bit k set where part k may be within its radius.
        ray_start: [R + 1] int64, ray r owns rows ray_start[r] to ray_start[r + 1].
        dense: number of lattice samples in the boxes of the bodies: what a renderer without shell
            evaluates.
    """

    points: Float[Tensor, "m 3"]
    depth: Float[Tensor, "m"]
    ray: Int[Tensor, "m"]
    body: Int[Tensor, "m"]
    candidates: Int[Tensor, "m"]
    ray_start: Int[Tensor, "r1"]
    dense: int

    def rows(self, keep: Bool[Tensor, "m"]) -> "ShellSamples":
        """The samples of a mask, over the same rays and in the same order.

        Args:
            keep: True for the samples to keep.
        """
        before = torch.cat([self.ray_start.new_zeros(1), keep.long().cumsum(0)])
        kept = before[self.ray_start]
        index = torch.nonzero(keep).squeeze(-1)
        return ShellSamples(
            self.points[index],
            self.depth[index],
            self.ray[index],
            self.body[index],
            self.candidates[index],
            kept,
            self.dense,
        )


def _vertex_reach(verts: Tensor, faces: Tensor) -> Tensor:
    """Per vertex, how far a point of its triangles may be from the nearest corner, over all bodies.

    No point of a triangle is farther than (longest edge)/sqrt(3) from the nearest corner.
    """
    sides = torch.stack([faces, faces.roll(-1, dims=1)], -1)
    single = sides.amin(-1) * verts.shape[1] + sides.amax(-1)  # two faces share an edge
    edges, row = single.unique(return_inverse=True)
    along = verts[:, edges // verts.shape[1]] - verts[:, edges % verts.shape[1]]
    length = along.square_().sum(-1).amax(0).sqrt()
    longest = length[row].amax(1) / 3**0.5
    reach = torch.zeros(verts.shape[1], dtype=verts.dtype, device=verts.device)
    return reach.scatter_reduce(0, faces.reshape(-1), longest.repeat_interleave(3), "amax")


def _vertex_bits(faces: Tensor, face_part: Tensor, num_verts: int) -> Tensor:
    """Per vertex, the bits of the parts whose faces use it."""
    bits = torch.zeros(num_verts, dtype=torch.int32, device=faces.device)
    for part in face_part.unique().tolist():
        used = faces[face_part == part].unique()
        bits[used] |= 1 << part
    return bits


class BodyShell:
    """Voxels within a radius of the surfaces of one or many posed bodies.

    >>> from monopart.geometry.body import BodyModel, BodyPose
    >>> body = BodyModel.default()
    >>> shell = BodyShell(body(BodyPose.zeros(body)).verts, body.faces, 0.05)
    >>> shell.occupied(torch.tensor([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])).tolist()
    [True, False]
    """

    def __init__(
        self,
        verts: Float[Tensor, "*b v 3"],
        faces: Int[Tensor, "f 3"],
        radius: float | Float[Tensor, "k"],
        face_part: Int[Tensor, "f"] | None = None,
        voxel: float = 0.02,
        grid: Int[Tensor, "g"] | None = None,
    ) -> None:
        """Mark the voxels.

        Args:
            verts: posed vertices of one body or of several, metres.
            faces: vertex indices, shared by the bodies.
            radius: metres; one number, or one per part.
            face_part: part of each face, 0 to 30; None is one part.
            voxel: edge of a voxel, metres.
            grid: bits of all voxels, int32: the ``grid`` of an earlier shell of the same arguments,
                where a caller kept it; no voxel is then marked.

        Raises:
            InputError: radius or voxel not positive, more than 31 parts, non-finite vertices, more
                than 2³¹ voxels (vertices in millimetres, say), or a grid of another size.
        """
        verts = verts.detach().reshape(-1, *verts.shape[-2:]).float()
        parts = torch.zeros_like(faces[:, 0]) if face_part is None else face_part
        count = int(parts.max()) + 1
        radii = torch.as_tensor(radius, dtype=torch.float32, device=verts.device)
        radii = radii.expand(count) if radii.ndim == 0 else radii
        if count > 31 or len(radii) < count:
            raise InputError(f"face_part: expected 1-31 parts with a radius each, found {count}")
        if not (bool((radii > 0).all()) and voxel > 0):
            raise InputError(f"radius, voxel: expected metres > 0, found {radius}, {voxel}")
        if not bool(verts.isfinite().all()):
            raise InputError("verts: expected finite positions, found NaN or infinity")
        self.radius = radii
        self.voxel = voxel
        self.num_parts = count
        self._build(verts.contiguous(), faces.long(), parts, grid)

    def _build(self, verts: Tensor, faces: Tensor, face_part: Tensor, grid: Tensor | None) -> None:
        bits = _vertex_bits(faces, face_part, verts.shape[1])
        # the largest radius of its parts, the reach of its triangles, half a voxel diagonal
        owned = (bits[:, None] >> torch.arange(self.num_parts, device=bits.device)) & 1
        radius = (owned * self.radius[: self.num_parts]).amax(1)
        half = self.voxel * 3**0.5 / 2
        reach = (radius + _vertex_reach(verts, faces) + half * 1.0001).contiguous()
        margin = float(reach.max())
        self.lo = (verts.amin(1) - margin).contiguous()
        extent = verts.amax(1) + margin - self.lo
        wanted = float((extent.double() / self.voxel).ceil().prod(1).sum())
        if wanted > _MOST_VOXELS:
            raise InputError(
                f"verts: expected bodies of at most {_MOST_VOXELS} voxels of {self.voxel} m, found "
                f"{wanted:.3g}; state vertices in metres, or the voxel in their unit"
            )
        self.dims = (extent / self.voxel).ceil().int().clamp(min=1).contiguous()
        cells = self.dims.long().prod(1)
        self.offset = (cells.cumsum(0) - cells).contiguous()
        total = int(cells.sum())
        if grid is not None and (grid.shape != (total,) or grid.dtype != torch.int32):
            raise InputError(
                f"grid: expected {total} int32 voxels of these bodies, found {tuple(grid.shape)} "
                f"of {grid.dtype}; leave it out, then the voxels are marked"
            )
        self.grid = self._marked(verts, bits, reach, total) if grid is None else grid

    def _marked(self, verts: Tensor, bits: Tensor, reach: Tensor, total: int) -> Tensor:
        from .kernels.launch import launch, view
        from .kernels.shell import splat_bodies

        self.grid = torch.zeros(total, dtype=torch.int32, device=verts.device)
        bodies, count = verts.shape[:2]
        share = count if verts.device.type == "cpu" else 1  # vertices of one work item
        args = [view(verts, 3), view(bits), view(reach), *self._grid_args(), share]
        launch(splat_bodies, bodies * (count // share), args, verts, smallest=2)
        return self.grid

    def _grid_args(self) -> list:
        from .kernels.launch import view

        return [
            view(self.lo, 3),
            view(self.dims, 3),
            view(self.offset),
            self.voxel,
            view(self.grid),
        ]

    def filled(self) -> "BodyShell":
        """The same boxes with every voxel marked for every part: a renderer without skipping."""
        other = copy.copy(self)
        other.grid = torch.full_like(self.grid, (1 << self.num_parts) - 1)
        return other

    @staticmethod
    def joined(shells: Sequence["BodyShell"]) -> "BodyShell":
        """One shell of the bodies of several shells, in order.

        Args:
            shells: of the same radii, parts and voxels.

        Raises:
            InputError: no shell, or shells of different voxels or numbers of parts.
        """
        kinds = {(s.voxel, s.num_parts) for s in shells}
        if len(kinds) != 1:
            raise InputError(
                f"shells: expected some of one voxel size and number of parts, found {kinds}; "
                "build them alike"
            )
        other = copy.copy(shells[0])
        other.lo = torch.cat([s.lo for s in shells])
        other.dims = torch.cat([s.dims for s in shells])
        other.grid = torch.cat([s.grid for s in shells])
        cells = other.dims.long().prod(1)
        other.offset = (cells.cumsum(0) - cells).contiguous()
        return other

    def _bodies(self, body: Tensor | int, count: int) -> Tensor:
        if isinstance(body, int):
            return torch.full((count,), body, dtype=torch.int32, device=self.grid.device)
        return body.int().contiguous()

    def bits(
        self, points: Float[Tensor, "n 3"], body: Int[Tensor, "n"] | int = 0
    ) -> Int[Tensor, "n"]:
        """Parts that may be within their radius of each point, as bits.

        Args:
            points: positions in the frame of the bodies, metres.
            body: index of the body, one for all or one per point.

        Returns:
            int32; bit k for part k. A cleared bit is certain, a set one is not.
        """
        from .kernels.launch import launch, view
        from .kernels.shell import look_up

        queries = points.detach().float().contiguous()
        out = torch.zeros(len(queries), dtype=torch.int32, device=queries.device)
        index = self._bodies(body, len(queries))
        args = [view(queries, 3), view(index), *self._grid_args(), view(out)]
        launch(look_up, len(queries), args, queries)
        return out

    def occupied(
        self, points: Float[Tensor, "n 3"], body: Int[Tensor, "n"] | int = 0
    ) -> Bool[Tensor, "n"]:
        """Whether a point may be within the radius of the surface; False is certain.

        Args:
            points: positions in the frame of the bodies, metres.
            body: index of the body, one for all or one per point.

        Returns:
            True for every point within the radius and for some just outside.
        """
        return self.bits(points, body) != 0

    def intervals(
        self, rays: Rays, body: Int[Tensor, "n"] | int = 0
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"], Bool[Tensor, "n"]]:
        """First and last distance at which each ray is inside the shell.

        Args:
            rays: [N] rays in the frame of the bodies, unit directions.
            body: index of the body, one for all or one per ray.

        Returns:
            near and far in metres along the ray (0 where missed), and the mask of hits; False for
            a ray without a direction, or that is not finite.
        """
        from .kernels.launch import launch, view
        from .kernels.shell import ray_intervals

        origins, directions = _flat(rays)
        count = len(origins)
        near, far = torch.zeros(2, count, device=origins.device).unbind(0)
        hit = torch.zeros(count, dtype=torch.bool, device=origins.device)
        index = self._bodies(body, count)
        out = [view(near), view(far), view(hit)]
        args = [view(origins, 3), view(directions, 3), view(index), *self._grid_args(), *out]
        launch(ray_intervals, count, args, origins)
        return near, far, hit

    def sample(
        self,
        rays: Rays,
        step: float,
        body: Int[Tensor, "n"] | int = 0,
        jitter: Float[Tensor, "n"] | None = None,
    ) -> ShellSamples:
        """Samples on a lattice of distances along each ray, inside the shell only.

        Args:
            rays: [N] rays in the frame of the bodies, unit directions.
            step: distance of neighbouring samples, metres.
            body: index of the body, one for all or one per ray.
            jitter: offset of the lattice in steps, in [0, 1); None is the middle, 0.5.

        Returns:
            The samples, sorted by ray and front to back; none of a ray without a direction, or that
            is not finite.

        Raises:
            InputError: the step is not positive.
        """
        from .kernels.launch import launch, view
        from .kernels.shell import count_samples, fill_samples

        if not step > 0:
            raise InputError(f"step: expected metres > 0, found {step}; use 0.01")
        origins, directions = _flat(rays)
        count, device = len(origins), origins.device
        shift = torch.full((count,), 0.5, device=device) if jitter is None else jitter.float()
        index = self._bodies(body, count)
        common = [view(origins, 3), view(directions, 3), view(index), view(shift.contiguous())]
        common += [step, *self._grid_args()]
        kept, dense = torch.zeros(2, count, dtype=torch.int32, device=device).unbind(0)
        launch(count_samples, count, [*common, view(kept), view(dense)], origins)
        ray_start = torch.zeros(count + 1, dtype=torch.int64, device=device)
        torch.cumsum(kept, 0, out=ray_start[1:])
        total, in_boxes = torch.stack([ray_start[-1], dense.sum()]).tolist()
        points = torch.zeros(total, 3, device=device)
        depth = torch.zeros(total, device=device)
        ints = torch.zeros(3, total, dtype=torch.int32, device=device)
        ray, owner, candidates = ints.unbind(0)
        out = [view(points, 3), view(depth), view(ray), view(owner), view(candidates)]
        launch(fill_samples, count, [*common, view(ray_start), *out], origins)
        return ShellSamples(points, depth, ray, owner, candidates, ray_start, in_boxes)


def _flat(rays: Rays) -> tuple[Tensor, Tensor]:
    origins = rays.origins.detach().float().expand_as(rays.directions)
    return origins.contiguous(), rays.directions.detach().float().contiguous()
