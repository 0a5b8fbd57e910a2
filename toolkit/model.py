"""The avatar: part fields, residuals and appearance over the geometry of posed bodies."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from monopart.fields.distance_prior import DistancePrior
from monopart.fields.hash_grid import GridSpec
from monopart.fields.occupancy import PartOccupancy, visible_samples
from monopart.fields.part_field import PartField
from monopart.fields.part_union import union_by_density
from monopart.fields.residual import UVT_GRID, ResidualField
from monopart.fields.volume import Composite, composite
from monopart.geometry.body import BodyModel, PosedBody
from monopart.geometry.cameras import Rays
from monopart.geometry.culling import ShellSamples
from monopart.geometry.moving_parts import MovingParts
from monopart.geometry.parts import PartMap, rows_of_parts
from monopart.geometry.posed_parts import PartPairs, PosedParts, RestPoints
from monopart.geometry.stages import stage

from .appearance import Appearance, FrameInput, fuses
from .config import Config, DeformConfig, GeometryConfig
from .corrections import PoseCorrections
from .light import Light
from .sizes import field_spec, part_radii
from .skipping import EVERY, Skipping

HIDDEN = 10.0  # optical depth in front of a sample that hides it: 5e-5 of the light is left


@dataclass(frozen=True)
class Shaded:
    """Density and colour of samples, and how they came about.

    Attributes:
        sigma: [N] density, 1/m.
        color: [N, 3].
        pairs: the evaluated (sample, part) pairs.
        canonical: [M, 3] canonical points of the pairs after the residual.
        residual: [M, 3] backward residuals, or None.
        counts: samples, pairs and colours that were evaluated.
        place: [M, 3 or 4] what the residuals depend on, in [0, 1], or None.
    """

    sigma: Tensor
    color: Tensor
    pairs: PartPairs
    canonical: Tensor
    residual: Tensor | None
    counts: dict[str, int]
    place: Tensor | None = None


@dataclass(frozen=True)
class Deformed:
    """Canonical points after the residual; equal in value, each with the gradients of its use.

    Attributes:
        canonical: [M, 3] for the fields.
        asked: [M, 3] for the distance prior: no gradient to the residual.
        held: [M, 3] for the deformation terms: none to the pose.
        residual: [M, 3] or None.
        place: [M, C] where the residual was looked up, or None.
    """

    canonical: Tensor
    asked: Tensor
    held: Tensor
    residual: Tensor | None
    place: Tensor | None


@dataclass(frozen=True)
class Rendered:
    """Colours of rays and what it took.

    Attributes:
        color: [R, 3] over black.
        opacity: [R].
        depth: [R] expected distance along the ray, metres.
        stats: counts of rays, samples and pairs.
        samples: the samples.
        shaded: their densities and colours.
        weights: [N] share of each sample in its ray.
    """

    color: Tensor
    opacity: Tensor
    depth: Tensor
    stats: dict[str, int]
    samples: ShellSamples
    shaded: Shaded
    weights: Tensor | None = None


def select(pairs: PartPairs, rows: Tensor, num_parts: int) -> PartPairs:
    """The pairs of the given ascending rows."""
    part = pairs.part[rows]
    counts = rows_of_parts(part, num_parts)
    return PartPairs(pairs.sample[rows], part, pairs.face[rows], pairs.bary[rows], counts)


class AvatarModel(torch.nn.Module):
    """All that is learned about a person; geometry comes in per batch."""

    def __init__(
        self,
        config: Config,
        body: BodyModel,
        canonical: PosedBody,
        frames: int,
        prior: DistancePrior | None = None,
        light: Light | None = None,
    ) -> None:
        """Build the modules.

        Args:
            config: the configuration.
            body: the body model.
            canonical: the body of the person in the canonical pose.
            frames: number of training frames.
            prior: the distance prior of that body where the caller has it; None makes one.
            light: how light falls on the person; None: the colours see none.
        """
        super().__init__()
        self.config = config
        self.parts = PartMap.preset(config.geometry.parts, body.num_joints)
        self.num_parts = len(self.parts.names)
        lo, hi = part_boxes(body, canonical, self.parts, config.geometry)
        spec, deform = config.field, config.deform
        self.light = light
        sizes = field_spec(spec, self.num_parts, config.appearance, self.light is not None)
        self.field = PartField(lo, hi, sizes)
        self.prior = None
        if spec.prior_slope:
            self.prior = prior or DistancePrior(canonical.verts, body.faces)
        self.backward_residual = self.forward_residual = None
        if deform.residual:
            self.backward_residual = self._residual_field(deform)
            if config.loss.consistency:
                self.forward_residual = self._residual_field(deform)
        self.codes = None
        if config.appearance.code and not fuses(config.appearance):
            codes = 0.01 * torch.randn(frames, config.appearance.code)
            self.codes = torch.nn.Parameter(codes)
        self.appearance = Appearance(config.appearance, lo, hi, frames)
        self.occupancy = PartOccupancy(self.field.lo, self.field.edge)
        self.corrections = None
        if config.refine.poses:
            betas = body.num_betas if config.refine.shape else 0
            self.corrections = PoseCorrections(frames, body.num_joints, betas)
        self.rigid = False  # leaves the residuals out: the poses are learned first

    @property
    def interval(self) -> float:
        """What a density is multiplied by for the opacity of a sample, metres (1 without unit)."""
        return self.config.geometry.step if self.config.field.use_step else 1.0

    def _residual_field(self, spec: DeformConfig) -> ResidualField:
        grid = GridSpec(UVT_GRID.levels, 2, spec.log2_size, UVT_GRID.base, UVT_GRID.growth)
        axes = 3 if spec.input == "uvt" else 4
        return ResidualField(self.num_parts, spec.scale, grid, spec.hidden, axes)

    def residual_place(
        self, points: Tensor, uv: Tensor, part: Tensor, time: Tensor
    ) -> Float[Tensor, "n c"]:
        """What a residual depends on (METHOD section 3), in [0, 1].

        Args:
            points: [N, 3] canonical points, metres.
            uv: [N, 2] texture coordinates of the surface below.
            part: [N] part of each point.
            time: [N] time of each point.

        Returns:
            (u, v, t), or (x, y, z, t) in the box of the part.
        """
        spec = self.config.deform
        time = (spec.time_span * time).clamp(0.0, 1.0)
        if spec.input == "uvt":
            return torch.cat([uv, time[:, None]], -1)
        inside = (points.detach() - self.field.lo[part]) / self.field.edge[part, None]
        return torch.cat([inside.clamp(0.0, 1.0), time[:, None]], -1)

    def density_of(
        self,
        points: Tensor,
        part: Tensor,
        counts: tuple[int, ...],
        asked: Tensor,
        code: Tensor | None = None,
    ) -> tuple:
        """Density, geometry features and hash features of canonical points sorted by part.

        The prior is `asked` at the same points with the gradients that it shall have.
        """
        with stage("hash encode"):
            encoded = self.field.encode(points, part)
        prior: Tensor | float = 0.0
        with stage("density"):
            if self.prior is not None:
                spec = self.config.field
                distance = self.prior(asked)
                prior = (spec.prior_slope * (spec.prior_margin - distance)).clamp(-8.0, 8.0)
            sigma, geometry = self.field.density(encoded, counts, prior, code)
        return sigma, geometry, encoded

    def _kept(
        self, samples: ShellSamples, pairs: PartPairs, rest: RestPoints, prune: float
    ) -> tuple[Tensor, Tensor]:
        """Rows of the pairs worth evaluating, and the occupancy cells of those rows."""
        cell = self.occupancy.cells_of(rest.points, pairs.part)
        keep = rest.valid
        if prune > 0:
            step = self.interval
            # A cell is empty when one step through it absorbs less than `prune`.
            keep = keep & self.occupancy.keep(cell, prune / step)
            wall = torch.zeros_like(samples.depth)
            opaque = self.occupancy.floor[cell] * step
            wall.scatter_reduce_(0, pairs.sample, opaque, "amax")
            seen = visible_samples(wall, samples.ray_start, samples.ray, HIDDEN)
            keep = keep & seen[pairs.sample]
        rows = torch.nonzero(keep).squeeze(-1)
        return rows, cell[rows]

    def _deformed(self, points: Tensor, uv: Tensor, pairs: PartPairs, time: Tensor) -> Deformed:
        if self.backward_residual is None or self.rigid:
            return Deformed(points, points, points, None, None)
        place = self.residual_place(points, uv, pairs.part, time)
        residual = self.backward_residual(place, pairs.part, pairs.counts)
        canonical = points + residual
        # The prior moves poses and no residuals, the deformation terms do the opposite.
        held = points.detach() + residual if points.requires_grad else canonical
        return Deformed(canonical, points + residual.detach(), held, residual, place)

    def shade(
        self,
        bodies: PosedParts,
        frames: FrameInput,
        samples: ShellSamples,
        prune: float = 0.0,
        skip: Skipping = EVERY,
    ) -> Shaded:
        """Density and colour of samples.

        Args:
            bodies: posed bodies in their local frames.
            frames: time and code of each body.
            samples: samples of rays inside the shell.
            prune: skip canonical cells that absorb less than this per sample; 0 skips none.
            skip: `colors` off evaluates the colour of every pair, for comparison.
        """
        with stage("part search"):
            pairs = bodies.pairs(samples)
        with stage("unskin"):
            rest = bodies.unskin(samples, pairs)
        found = len(pairs.sample)
        with stage("occupancy"):
            rows, cell = self._kept(samples, pairs, rest, prune)
            points, uv = rest.points[rows], rest.uv[rows]
            pairs = select(pairs, rows, self.num_parts)
            owner = samples.body[pairs.sample].long()
            if isinstance(bodies, MovingParts):
                rest = bodies.follow(samples, pairs)
                points, uv = rest.points, rest.uv
        with stage("residual"):
            moved = self._deformed(points, uv, pairs, frames.time[owner])
        canonical = moved.canonical
        code = None
        if self.config.appearance.density_sees_fusion:
            code = self.appearance(frames, canonical, pairs.part, owner, pairs.counts)
        sigma, geometry, encoded = self.density_of(
            canonical, pairs.part, pairs.counts, moved.asked, code
        )
        if self.training:
            with stage("occupancy"):
                self.occupancy.see(cell, sigma)
        total = len(samples.depth)
        with stage("union"):
            union = union_by_density(sigma, pairs.sample, pairs.part, total, self.num_parts)
        with stage("colour"):
            every = torch.arange(len(sigma), device=sigma.device), pairs.counts
            rows, counted = (union.winner, union.counts) if skip.colors else every
            of = pairs.part[rows], owner[rows]
            code = (  # the density may have seen it already
                self.appearance(frames, canonical[rows], *of, counted)
                if code is None
                else code.index_select(0, rows)
            )
            if self.light is not None:
                code = self.light(bodies, frames.lit, of[1], pairs, rows, code)
            rgb = self.field.color(encoded[rows], geometry[rows], code, counted)
            shown = rgb if skip.colors else rgb[union.winner]
            color = rgb.new_zeros(total, 3).index_copy(0, pairs.sample[union.winner], shown)
        counts = {
            "samples_evaluated": total,
            "pairs_found": found,
            "pairs_evaluated": len(pairs.sample),
            "colors_evaluated": len(rows),
            "samples_reached": len(union.winner),  # one winner for each sample that has a pair
        }
        return Shaded(union.sigma, color, pairs, moved.held, moved.residual, counts, moved.place)

    def render_rays(
        self,
        bodies: PosedParts,
        frames: FrameInput,
        rays: Rays,
        body: Tensor | int = 0,
        jitter: Tensor | None = None,
        prune: float = 0.0,
        skip: Skipping = EVERY,
    ) -> Rendered:
        """Colours of rays over black, every sample evaluated: the differentiable way.

        Args:
            bodies: posed bodies in their local frames.
            frames: time and code of each body.
            rays: [R] rays in the local frame of their body.
            body: body of each ray.
            jitter: [R] offsets of the sample lattice in steps.
            prune: see :meth:`shade`.
            skip: see :meth:`shade`.
        """
        step = self.config.geometry.step
        with stage("shell sampling"):
            samples = bodies.shell.sample(rays, step, body, jitter)
        shaded = self.shade(bodies, frames, samples, prune, skip)
        with stage("compositing"):
            delta = torch.full_like(samples.depth, self.interval)
            out = composite(shaded.sigma, shaded.color, delta, samples.ray_start, samples.depth)
        stats = {
            "rays": len(rays.directions),
            "samples_dense": samples.dense,
            "samples_shell": len(samples.depth),
            **shaded.counts,
        }
        return Rendered(out.color, out.opacity, distance(out), stats, samples, shaded, out.weights)


def distance(out: Composite) -> Tensor:
    """Expected distance of rays that were composited with the depth of their samples."""
    return torch.zeros_like(out.opacity) if out.depth is None else out.depth


def part_boxes(
    body: BodyModel, canonical: PosedBody, parts: PartMap, spec: GeometryConfig
) -> tuple[Tensor, Tensor]:
    """Canonical box of each part's faces with a margin, metres: lower and upper corners [K, 3]."""
    face_part = parts.face_parts(body.weights, body.faces)
    beyond = spec.canonical_margin - spec.radius  # room for residuals
    margins = [radius + beyond for radius in part_radii(spec, len(parts.names))]
    lo, hi = [], []
    for part in range(len(parts.names)):
        used = body.faces[face_part == part].unique()
        corners = canonical.verts[used] if len(used) else canonical.verts.mean(0, keepdim=True)
        lo.append(corners.amin(0) - margins[part])
        hi.append(corners.amax(0) + margins[part])
    return torch.stack(lo), torch.stack(hi)
