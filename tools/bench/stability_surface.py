"""Stress of closest surface, normals, UV look-up, consistency and culling."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.body import BodyModel
from monopart.geometry.consistency import consistency_loss, round_trip
from monopart.geometry.culling import BodyShell
from monopart.geometry.surface import SurfaceIndex, closest_point, vertex_normals
from monopart.geometry.uv import UVMap
from monopart.geometry.uv_lookup import UVHit

from .registry import load, load_open3d
from .stability_cases import DOUBLE, SINGLE, Family, Inputs, Stress, Way
from .stability_meshes import (
    Mesh,
    at,
    ball,
    box,
    diagonals,
    exact_distance,
    huge,
    near,
    scene,
    soup,
)
from .stability_rotations import Make, axes


def _near_huge(generator: torch.Generator, count: int) -> Inputs:
    return near(huge(), 0.03)(generator, count)


def _surface_families() -> tuple[Family, ...]:
    whole, cube = ball(), box()
    # a barycentric next to 0 has an absolute error: so has the gradient of that corner
    out = [
        Family("3 cm off", near(whole, 0.03), extra=whole.faces, step=1e-8),
        Family("1 µm off", near(whole, 1e-6), extra=whole.faces, smooth=False),
        Family("on faces", near(whole, 0.0), extra=whole.faces, smooth=False),
        Family("on edges", near(whole, 0.0, "edge"), extra=whole.faces, smooth=False),
        Family("on vertices", near(whole, 0.0, "vertex"), extra=whole.faces, smooth=False),
        Family("medial axis", at(cube, diagonals), extra=cube.faces, smooth=False),
        Family(
            "centre",
            at(cube, lambda g, n: torch.zeros(n, 3).double()),
            extra=cube.faces,
            smooth=False,
        ),
    ]
    for kind in ("degenerate", "all degenerate", "duplicate", "single"):
        mesh = soup(kind)
        smooth = kind == "single"
        out.append(Family(kind, near(mesh, 0.03), extra=mesh.faces, smooth=smooth, step=1e-7))
    for width in ("1e-2", "1e-3", "1e-4", "1e-5", "1e-7"):
        mesh = soup(width)
        out.append(Family(f"needles {width}", near(mesh, 0.01), extra=mesh.faces, smooth=False))
        out.append(Family(f"in needles {width}", near(mesh, 0.0), extra=mesh.faces, smooth=False))
    for name, size, away in (
        ("size 1e-3", 1e-3, 0.0),
        ("size 1e3", 1e3, 0.0),
        ("100 km away", 1.0, 1e5),
    ):
        mesh = ball(size, away)
        out.append(
            Family(
                name,
                near(mesh, 0.03 * size),
                extra=mesh.faces,
                step=1e-8 * size,
                smooth=not away,
            )
        )
    for gap in (1e3, 1e6):
        out.append(
            Family(
                f"{gap:g} m off", near(whole, gap), extra=whole.faces, step=1e-7 * gap, smooth=False
            )
        )
    for name, value in (("infinite", torch.inf), ("NaN", torch.nan)):
        place = at(whole, lambda g, n, v=value: torch.full((n, 3), v, dtype=DOUBLE))
        out.append(Family(name, place, extra=whole.faces, smooth=False))
    million = Family(
        "1e6 triangles",
        _near_huge,
        extra=lambda: huge().faces,
        smooth=False,
        cases=4,
        large=True,
    )
    return (*out, million)


def _bearable(backend: str) -> Callable[[Family], bool]:
    """Brute force takes minutes on a million triangles."""
    return lambda family: backend == "warp" or not family.large


def _surface_way(backend: str) -> Way:
    def run(faces: Tensor, points: Tensor, verts: Tensor) -> tuple[Tensor, Tensor]:
        hit = SurfaceIndex(verts, faces, backend).query(points)
        return hit.distance, hit.found

    # the search of the warp back end runs in float32: its choice of a face is that good
    double = 2e-7 if backend == "warp" else None
    return Way(f"monopart {backend}", run, True, serves=_bearable(backend), double=double)


def _foot_way(backend: str) -> Way:
    """The point that was found has to be at the distance that was found, and on its face."""

    def run(faces: Tensor, points: Tensor, verts: Tensor) -> tuple[Tensor, Tensor]:
        hit = closest_point(points, verts, faces, backend=backend)
        foot = (hit.bary[..., None] * verts[faces[hit.face]]).sum(1)
        return (points - foot).norm(dim=1), hit.found

    double = 2e-7 if backend == "warp" else None
    name, serves = f"monopart {backend}, by bary", _bearable(backend)
    return Way(name, run, True, differentiable=False, serves=serves, double=double)


def _open3d(faces: Tensor, points: Tensor, verts: Tensor) -> Tensor:
    open3d = load_open3d()
    core = open3d.core
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(core.Tensor(verts.numpy()), core.Tensor(faces.numpy().astype(np.uint32)))
    found = scene.compute_distance(core.Tensor(points.numpy()))
    return torch.from_numpy(found.numpy())


def _trimesh(faces: Tensor, points: Tensor, verts: Tensor) -> Tensor:
    mesh = load("trimesh").Trimesh(verts.numpy(), faces.numpy(), process=False)
    return torch.from_numpy(load("trimesh").proximity.closest_point(mesh, points.numpy())[1])


def _igl(faces: Tensor, points: Tensor, verts: Tensor) -> Tensor:
    call = load("igl").point_mesh_squared_distance
    found = call(points.numpy(), verts.numpy(), faces.numpy())[0]
    return torch.from_numpy(np.sqrt(np.asarray(found).reshape(-1)))


def _finite(family: Family) -> bool:
    """Peers have no mask to say that a point that is not finite has no answer."""
    return family.name not in ("infinite", "NaN")


def _small(family: Family) -> bool:
    return _finite(family) and not family.large


def _surface() -> Stress:
    peers = (
        Way("Open3D", _open3d, False, (SINGLE,), ("open3d",), False, _finite),
        Way("libigl", _igl, False, (DOUBLE,), ("igl",), False, _finite),
        Way("trimesh", _trimesh, False, (DOUBLE,), ("trimesh", "rtree"), False, _small),
    )
    ours = (_surface_way("torch"), _surface_way("warp"), _foot_way("torch"), _foot_way("warp"))
    return Stress(
        name="closest_point",
        title="closest surface (distance)",
        domain="any mesh with a face, points up to 1e9 m off; points that are not finite are not "
        "found; a mesh without faces is an error; faces that are flat by rounding are their edges",
        error="largest coordinate of mesh and point",
        families=_surface_families(),
        ways=(*ours, *peers),
        exact=exact_distance,
        scale=scene,
        wrt=(0, 1),
        cases=96,
    )


# --- normals and texture coordinates -----------------------------------------------------------


def exact_normals(faces: Tensor, verts: np.ndarray) -> np.ndarray:
    """Sums of cross products by a loop over faces, normalised."""
    out = np.zeros_like(verts)
    for face in faces.numpy():
        a, b, c = verts[face]
        out[face] += np.cross(b - a, c - a)
    length = np.linalg.norm(out, axis=1, keepdims=True)
    return np.where(length > 0, out / np.where(length > 0, length, 1.0), 0.0)


def _normals() -> Stress:
    families = []
    for name, mesh in (
        *(("1 m", ball()), ("1e-3 m", ball(1e-3)), ("1e-8 m", ball(1e-8)), ("1e3 m", ball(1e3))),
        *(("degenerate", soup("degenerate")), ("all degenerate", soup("all degenerate"))),
    ):
        size = float(mesh.verts.abs().max())
        smooth = "degenerate" not in name
        make = _only_verts(mesh)
        family = Family(name, make, extra=mesh.faces, smooth=smooth, step=1e-6 * size)
        families.append(family)
    return Stress(
        name="vertex_normals",
        title="vertex normals",
        domain="any mesh from 1e-8 m; a vertex without area gets a zero normal and no gradient",
        error="1",
        families=tuple(families),
        ways=(Way("monopart", lambda faces, verts: vertex_normals(verts, faces), True),),
        exact=exact_normals,
        rows_apart=False,
        cases=1,
        limit=2e-6,
    )


def _only_verts(mesh: Mesh) -> Make:
    return lambda generator, count: (mesh.verts,)


def _barycentric(kind: str) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        bary = torch.rand(count, 3, generator=generator, dtype=DOUBLE)
        if kind != "inside":
            bary[:, 2] = 0
        if kind == "corners":
            bary[:, 1] = 0
        return (bary / bary.sum(1, keepdim=True),)

    return make


def _uv() -> Stress:
    uv = BodyModel.default().uv
    corners = torch.rand(64, 3, 2, dtype=DOUBLE) if uv is None else uv.corner_uv.double()
    flat = corners[:, :1].expand(-1, 3, -1).contiguous()
    families = [
        Family(name, _barycentric(kind), extra=table)
        for name, kind, table in (
            *(("inside", "inside", corners), ("seams", "edges", corners)),
            *(("corners, poles", "corners", corners), ("charts without area", "inside", flat)),
        )
    ]

    def pick(table: Any, bary: Any) -> Any:
        return np.arange(len(bary)) % len(table)

    def run(table: Tensor, bary: Tensor) -> Tensor:
        face = torch.from_numpy(pick(table, bary))
        hit = UVHit(face, bary, torch.ones_like(face, dtype=torch.bool))
        return UVMap(table.to(bary)).at(hit)

    def exact(table: Tensor, bary: np.ndarray) -> np.ndarray:
        return np.einsum("nc,ncd->nd", bary, table.numpy()[pick(table, bary)])

    return Stress(
        name="uv",
        title="UV look-up",
        domain="any barycentrics; seams are sharp, as coordinates belong to corners of faces",
        error="1, the edge of the texture",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=exact,
    )


# --- consistency and culling -------------------------------------------------------------------


def _distances(value: float, spread: float = 0.0) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        noise = torch.rand(count, generator=generator, dtype=DOUBLE)
        return (value + spread * noise,)

    return make


def exact_loss(extra: None, distance: np.ndarray) -> np.ndarray:
    """Sum over those beyond 5 cm over their number, summed without rounding."""
    over = [float(d) for d in distance if d > float(np.float32(0.05))]
    return np.array([math.fsum(over) / max(1, len(over))])


def _consistency() -> Stress:
    families = (
        Family("empty", lambda g, n: (torch.zeros(0, dtype=DOUBLE),)),
        Family("none beyond", _distances(0.0, 0.04)),
        Family("some beyond", _distances(0.0, 0.1), smooth=False),
        Family("all beyond", _distances(0.1, 1.0)),
        Family("1e30 m", _distances(1e30), step=1e24),
    )

    def run(extra: None, distance: Tensor) -> Tensor:
        return consistency_loss(distance, float(np.float32(0.05)))[None]

    return Stress(
        name="consistency_loss",
        title="consistency loss",
        domain="any finite distances, none at all too; a NaN stays a NaN",
        error="the loss",
        families=families,
        ways=(Way("monopart", run, True),),
        exact=exact_loss,
        scale=lambda extra, exact, d: np.maximum(np.abs(exact), 1e-30),
        cases=4096,
    )


def _round_trip() -> Stress:
    def shifted(gap: float) -> Make:
        return lambda g, n: (torch.randn(n, 3, generator=g, dtype=DOUBLE), gap * axes(g, n))

    def run(extra: None, points: Tensor, shift: Tensor) -> Tensor:
        return round_trip(points, lambda p: p, lambda c: c + shift)

    families = [
        Family(f"{g:g} m", shifted(g), smooth=g > 0, step=1e-7 * max(g, 1.0))
        for g in (0.0, 1.0, 1e3)
    ]
    return Stress(
        name="round_trip",
        title="round trip",
        domain="any finite points; the gradient at distance 0 is 0",
        error="largest coordinate",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=lambda extra, p, s: np.linalg.norm(s, axis=1),
        scale=lambda extra, exact, p, s: np.abs(p).max(1) + np.abs(s).max(1),
        wrt=(0, 1),
    )


def _shell() -> Stress:
    """A point within the radius that the shell leaves out is an error as large as it is deep."""
    radius, families = 0.05, []
    for name, mesh, gap in (
        *(
            ("on the radius", ball(), 0.05),
            ("inside", ball(), 0.0499),
            ("needles", soup("1e-4"), 0.049),
        ),
        *(("degenerate", soup("degenerate"), 0.049), ("1 km away", ball(1.0, 1e3), 0.049)),
    ):
        make = near(mesh, gap)
        families.append(Family(name, make, extra=mesh.faces, smooth=False))

    def run(faces: Tensor, points: Tensor, verts: Tensor) -> Tensor:
        shell = BodyShell(verts, faces, radius)
        return shell.occupied(points).double()

    def exact(faces: Tensor, points: np.ndarray, verts: np.ndarray) -> np.ndarray:
        return exact_distance(faces, points, verts)

    def off(occupied: np.ndarray, distance: np.ndarray) -> np.ndarray:
        return np.where(occupied > 0, 0.0, np.maximum(radius - distance, 0.0))

    return Stress(
        name="shell",
        title="culling shell (missed depth)",
        domain="bodies within 1 km of the origin, any faces: no point of the radius is left out",
        error="1 m",
        families=tuple(families),
        ways=(Way("monopart", run, True, (SINGLE,), differentiable=False),),
        exact=exact,
        off=off,
        wrt=(),
        cases=96,
    )


def stresses() -> list[Stress]:
    """Operations on surfaces."""
    return [_surface(), _normals(), _uv(), _consistency(), _round_trip(), _shell()]
