"""Stress of what a body is asked in space: signs, shells along rays, parts, diffused weights."""

import dataclasses
import functools
from typing import Any

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.body import BodyModel, BodyPose, PosedBody
from monopart.geometry.cameras import Rays
from monopart.geometry.culling import BodyShell
from monopart.geometry.diffused_weights import DiffusedField
from monopart.geometry.parts import PartMap
from monopart.geometry.posed_parts import PosedParts
from monopart.geometry.skinning import blend_transforms
from monopart.geometry.surface import SurfaceIndex, closest_point, signed_distance, vertex_normals
from monopart.geometry.unskin_roots import inverse_skin_all

from .stability_cases import DOUBLE, SINGLE, Family, Inputs, Stress, Way
from .stability_meshes import Mesh, at, ball, box, exact_distance, near, scene, soup
from .stability_rotations import Make, axes

# --- the sign of a distance --------------------------------------------------------------------


def _winding(faces: Tensor, points: np.ndarray, verts: np.ndarray) -> np.ndarray:
    """Solid angle of the mesh over 4π: 1 inside of it, 0 outside."""
    corners = verts[faces.numpy()]
    a, b, c = (corners[:, k] - points[:, None] for k in range(3))
    x, y, z = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    volume = np.einsum("nfi,nfi->nf", a, np.cross(b, c))
    dots = (np.einsum("nfi,nfi->nf", p, q) for p, q in ((a, b), (b, c), (c, a)))
    ab, bc, ca = dots
    return np.arctan2(volume, x * y * z + ab * z + bc * x + ca * y).sum(1) / (2 * np.pi)


def exact_signed(faces: Tensor, points: np.ndarray, verts: np.ndarray) -> np.ndarray:
    """The distance over all faces, negative inside."""
    inside = _winding(faces, np.nan_to_num(points), verts) > 0.5
    return np.where(inside, -1, 1) * exact_distance(faces, points, verts)


def _signed() -> Stress:
    whole, cube = ball(), box()
    shapes = (
        *(("outside", near(whole, 0.03), whole), ("1e-5 m off", near(whole, 1e-5), whole)),
        *(
            ("on faces", near(whole, 0.0), whole),
            ("on vertices", near(whole, 0.0, "vertex"), whole),
        ),
        ("in a cube", at(cube, lambda g, n: torch.rand(n, 3, generator=g).double() - 0.5), cube),
        ("1e6 m off", near(whole, 1e6), whole),
        ("infinite", at(whole, lambda g, n: torch.full((n, 3), torch.inf).double()), whole),
        ("NaN", at(whole, lambda g, n: torch.full((n, 3), torch.nan).double()), whole),
    )
    families = [
        Family(n, m, extra=mesh.faces, smooth=n == "outside", step=1e-8) for n, m, mesh in shapes
    ]
    for kind in ("duplicate", "all degenerate"):  # without normals across edges, or at all
        mesh = soup(kind)
        make = near(mesh, 0.03)
        families.append(Family(kind, make, extra=mesh.faces, smooth=False, inside=False))

    def run(faces: Tensor, points: Tensor, verts: Tensor) -> tuple[Tensor, Tensor]:
        hit = SurfaceIndex(verts, faces, "torch").query(points)
        found = signed_distance(points, hit, vertex_normals(verts, faces), faces)
        return found, hit.found

    return Stress(
        name="signed_distance",
        title="signed distance",
        domain="closed meshes whose corners are not sharper than their normals; on the surface the "
        "sign is that of rounding; points that are not finite are not found: +inf; a mesh without "
        "normals has no inside",
        error="largest coordinate of mesh and point",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=exact_signed,
        scale=scene,
        wrt=(0, 1),
        cases=96,
    )


# --- a shell along rays ------------------------------------------------------------------------

_RADIUS, _PACE = 0.05, 0.01


def _shot(kind: str, mesh: Mesh) -> Make:
    """Rays at points next to a mesh, from all around it."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        (target, _) = near(mesh, 0.04)(generator, count)
        directions = axes(generator, count)
        away = {"1 km off": 1e3, "inside": 0.0, "directions of 0": 0.0, "NaN": 0.0}.get(kind, 3.0)
        if kind == "along axes":
            directions = torch.eye(3, dtype=DOUBLE)[torch.arange(count) % 3]
        elif kind == "nearly parallel":
            directions = torch.eye(3, dtype=DOUBLE)[torch.arange(count) % 3] + 1e-13
        origins = target - away * directions
        if kind == "directions of 0":
            directions = 0 * directions
        elif kind == "NaN":
            directions = torch.full_like(directions, torch.nan)
        elif kind == "infinite origins":
            origins = torch.full_like(origins, torch.inf)
        return origins, directions

    return make


@dataclasses.dataclass(frozen=True)
class _Shelled:
    """A shell of voxels, and their marks for an oracle."""

    shell: BodyShell

    @functools.cached_property
    def marked(self) -> np.ndarray:
        x, y, z = (int(n) for n in self.shell.dims[0])
        return (self.shell.grid.numpy() != 0).reshape(z, y, x)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Whether points lie in marked voxels, in float64."""
        lo, dims = self.shell.lo[0].double().numpy(), self.shell.dims[0].numpy()
        cell = np.floor((points - lo) / self.shell.voxel)
        sound = np.isfinite(cell) & (cell >= 0) & (cell < dims)
        there = np.asarray(sound.all(-1))
        x, y, z = np.where(there[..., None], cell, 0).astype(np.int64).T
        return there & self.marked[z.T, y.T, x.T]


def exact_lattice(shelled: _Shelled, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Number of lattice places of each ray that lie in marked voxels, in float64."""
    places = (np.arange(int(2000.0 / _PACE)) + 0.5) * _PACE if len(origins) else np.zeros(0)
    out = np.zeros(len(origins))
    for i, (o, d) in enumerate(zip(origins, directions, strict=True)):
        if not np.isclose(np.linalg.norm(d), 1.0, atol=1e-3) or not np.isfinite(o).all():
            continue
        middle = float(-o @ d)
        near_by = places[np.abs(places - middle) < 4.0]
        out[i] = shelled.inside(o + near_by[:, None] * d).sum() * _PACE
    return out


def _shell_rays() -> list[Stress]:
    shelled = _Shelled(BodyShell(ball().verts.float(), ball().faces, _RADIUS))
    kinds = ("usual", "inside", "along axes", "nearly parallel", "1 km off")
    broken = ("directions of 0", "NaN", "infinite origins")
    families = tuple(Family(k, _shot(k, ball()), extra=shelled) for k in (*kinds, *broken))

    def sampled(shelled: _Shelled, origins: Tensor, directions: Tensor) -> Tensor:
        samples = shelled.shell.sample(Rays(origins, directions), _PACE)
        return samples.ray_start.diff().double() * _PACE

    def spanned(shelled: _Shelled, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Length within the interval that no lattice place in a marked voxel lies beyond."""
        near_at, far_at, hit = shelled.shell.intervals(Rays(origins, directions))
        samples = shelled.shell.sample(Rays(origins, directions), _PACE)
        ray = samples.ray.long()
        outside = torch.maximum(near_at[ray] - samples.depth, samples.depth - far_at[ray])
        missed = torch.where(hit[ray], outside.clamp_min(0.0), samples.depth)
        worst = torch.zeros(len(near_at)).scatter_reduce(0, ray, missed, "amax")
        return worst, torch.ones(len(worst), dtype=torch.bool)

    domain = "rays of unit directions from within 1 km, along axes too; those without a direction, "
    domain += "or that are not finite, meet nothing"
    count = Stress(
        name="shell_sample",
        title="samples in a shell (length)",
        domain=domain,
        error="1 km: the last place of a distance decides about samples next to a voxel's side",
        families=families,
        ways=(Way("monopart", sampled, True, (SINGLE,), differentiable=False),),
        exact=exact_lattice,
        scale=lambda extra, exact, o, d: 1.0,
        wrt=(),
        cases=64,
        limit=0.05,
    )
    span = dataclasses.replace(
        count,
        name="shell_intervals",
        title="intervals of a shell (samples left out)",
        error="1 m, and the distance of the origin",
        ways=(Way("monopart", spanned, True, (SINGLE,), differentiable=False),),
        exact=lambda shelled, o, d: np.zeros(len(o)),
        scale=lambda extra, exact, o, d: 1 + np.abs(np.nan_to_num(o, posinf=0)).max(1),
        limit=1e-6,
    )
    return [dataclasses.replace(count, error="1 m"), span]


# --- diffused weights --------------------------------------------------------------------------


@functools.cache
def _body() -> tuple[BodyModel, PosedBody]:
    body = BodyModel.default()
    pose = BodyPose.zeros(body)
    pose.pose[16:20, 2] = 0.5
    return body, body(pose)


@functools.cache
def _diffused(dtype: torch.dtype) -> DiffusedField:
    body = BodyModel.default().to(torch.zeros(1, dtype=dtype))
    return DiffusedField(body, voxel=0.04)


def _off_body(gap: float) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        verts = _body()[0].v_template.double()
        rows = torch.randint(0, len(verts), (count,), generator=generator)
        if not np.isfinite(gap):
            return (torch.full((count, 3), gap, dtype=DOUBLE),)
        return (verts[rows] + gap * axes(generator, count),)

    return make


def _diffused_weights() -> Stress:
    """Partition of unity: what all weights sum to, where there are any."""

    def run(extra: None, points: Tensor) -> tuple[Tensor, Tensor]:
        field = _diffused(points.dtype)
        weights = field.weights_at(points)
        found = field.search(points, torch.inf)[1]
        # weights in [0, 1] that sum to 1, all 0 where nothing was found
        low, high = weights.amin(1).clamp(max=0.0), weights.amax(1).clamp(min=1.0)
        wanted = torch.where(found, 1.0, 0.0).to(weights)
        return torch.stack((weights.sum(1) - wanted, low, high - 1.0), 1), torch.ones_like(found)

    shapes = (("on the surface", 0.0), ("3 cm", 0.03), ("at the reach", 0.1), ("10 m off", 10.0))
    shapes = (*shapes, ("1e30 m off", 1e30), ("infinite", torch.inf), ("NaN", torch.nan))
    families = [Family(name, _off_body(gap), smooth=False) for name, gap in shapes]
    return Stress(
        name="diffused_weights",
        title="diffused weights (sum and range)",
        domain="any point; beyond the reach, and where it is not finite, all weights are 0",
        error="1",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=lambda extra, points: np.zeros((len(points), 3)),
    )


# --- all roots of the skinning, and the parts of a posed body ----------------------------------


def _again(rest: Tensor, posed: PosedBody, weights: Tensor) -> Tensor:
    maps = blend_transforms(posed.transforms.double(), weights)
    return (maps[..., :3, :3] * rest[..., None, :]).sum(-1) + maps[..., :3, 3]


def _all_roots() -> Stress:
    def run(extra: None, points: Tensor) -> tuple[Tensor, Tensor]:
        body, posed = _body()
        like = body.to(points)
        pose = BodyPose.zeros(like)
        pose.pose[16:20, 2] = 0.5
        posed = like(pose)
        found = inverse_skin_all(points, posed, like)
        rest, verts = found.points.double().flatten(0, 1), like.v_template.double()
        hit = closest_point(torch.where(rest.isfinite(), rest, 0.0), verts, like.faces)
        weights = (hit.bary[..., None] * like.weights.double()[like.faces[hit.face]]).sum(1)
        return _again(rest, posed, weights), found.valid.flatten()

    shapes = (("on the surface", 0.0), ("3 cm", 0.03), ("10 m off", 10.0), ("1e6 m off", 1e6))
    shapes = (*shapes, ("infinite", torch.inf), ("NaN", torch.nan))
    families = [Family(name, _off_body(gap), smooth=False) for name, gap in shapes]
    return Stress(
        name="inverse_skin_all",
        title="all roots of the skinning (cycle error of valid ones)",
        domain="any point; slots without a further root, and points without one, are masked",
        error="1 m, the size of a body",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=lambda extra, points: np.repeat(points, 3, 0),
        cases=32,
        limit=1.01e-3,
        double=1.01e-3,
    )


@functools.cache
def _parts() -> tuple[PosedParts, PartMap]:
    body, posed = _body()
    parts = PartMap.default()
    return PosedParts(body, posed, body(BodyPose.zeros(body)), parts, 0.05), parts


def _pairs() -> Stress:
    """Every sample of rays at the body: the distance to each part, cut at the radius."""

    def run(extra: None, points: Tensor) -> Tensor:
        parts, _ = _parts()
        directions = torch.zeros_like(points)
        directions[:, 2] = 1.0
        start = points - 0.5 * _PACE * directions  # the first lattice place is the point itself
        samples = parts.shell.sample(Rays(start, directions), _PACE)
        pairs = parts.pairs(samples)
        corners = parts.verts[0][parts.faces[pairs.face]]
        full = torch.cat((pairs.bary, 1 - pairs.bary.sum(1, keepdim=True)), 1)
        foot = (full[..., None] * corners).sum(1)
        gap = (samples.points[pairs.sample] - foot).norm(dim=1)
        ray = samples.ray.long()[pairs.sample]
        first = samples.depth[pairs.sample] < _PACE
        out = points.new_full((len(points), parts.num_parts), 0.05)
        at_part = ray[first] * parts.num_parts + pairs.part[first]
        return out.flatten().scatter_reduce(0, at_part, gap[first], "amin").unflatten(0, out.shape)

    def exact(extra: None, points: np.ndarray) -> np.ndarray:
        parts, _ = _parts()
        verts, out = parts.verts[0].double().numpy(), []
        for k in range(parts.num_parts):
            out.append(exact_distance(parts.faces[parts.face_part == k], points, verts))
        return np.minimum(np.stack(out, 1), np.float32(0.05))

    def make(gap: float) -> Make:
        def points(generator: torch.Generator, count: int) -> Inputs:
            verts = _parts()[0].verts[0].double()
            rows = torch.randint(0, len(verts), (count,), generator=generator)
            return (verts[rows] + gap * axes(generator, count),)

        return points

    shapes = (("on vertices", 0.0), ("3 cm", 0.03), ("at the radius", 0.05), ("10 m off", 10.0))
    families = [Family(name, make(gap)) for name, gap in shapes]
    return Stress(
        name="posed_parts",
        title="parts within their radius (distance, at most 5 cm)",
        domain="finite samples of rays; a part is left out only beyond its radius",
        error="1 m, the size of a body",
        families=tuple(families),
        ways=(Way("monopart", run, True, (SINGLE,), differentiable=False),),
        exact=exact,
        wrt=(),
        cases=64,
    )


def _unskin_parts() -> Stress:
    """Rest points under the weights of their foot come back to where they were."""

    def run(extra: Any, points: Tensor) -> tuple[Tensor, Tensor]:
        parts, _ = _parts()
        directions = torch.zeros_like(points)
        directions[:, 2] = 1.0
        samples = parts.shell.sample(Rays(points - 0.005 * directions, directions), _PACE)
        pairs = parts.pairs(samples)
        rest = parts.unskin(samples, pairs)
        full = torch.cat((pairs.bary, 1 - pairs.bary.sum(1, keepdim=True)), 1).double()
        corners = parts.faces[pairs.face]
        away, there = (
            (m.double()[corners] * full[..., None, None]).sum(1)
            for m in (parts.posed_maps, parts.canonical_maps)
        )
        point = samples.points[pairs.sample].double()
        local = torch.linalg.solve(away[:, :, :3], (point - away[:, :, 3])[..., None])
        wanted = (there[:, :, :3] @ local)[..., 0] + there[:, :, 3]
        return rest.points.double() - wanted, rest.valid

    return Stress(
        name="posed_parts_unskin",
        title="canonical points of parts (against a solve in float64)",
        domain="|det| > 1e-2: others are masked",
        error="1 m, the size of a body",
        families=(Family("3 cm", _off_body(0.03)), Family("on vertices", _off_body(0.0))),
        ways=(Way("monopart", run, True, (SINGLE,), differentiable=False),),
        exact=lambda extra, points: np.zeros((1, 3)),
        off=lambda found, exact: np.abs(found).max(1, initial=0.0),
        wrt=(),
        cases=64,
        limit=2e-6,
    )


def stresses() -> list[Stress]:
    """Operations on bodies in space."""
    from . import stability_diffused, stability_moving

    own = [_signed(), *_shell_rays(), _diffused_weights(), _all_roots(), _pairs()]
    own += [_unskin_parts(), *stability_moving.stresses()]
    return [*own, *stability_diffused.stresses()]
