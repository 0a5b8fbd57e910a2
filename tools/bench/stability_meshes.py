"""Meshes with defects, points around them, and the float64 oracle of the distance to them."""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from .stability_cases import DOUBLE, Inputs
from .stability_rotations import Make, axes

# --- the oracle: every face, in float64, from an orthogonal basis of its plane -----------------


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", a, b)


def _length(a: np.ndarray) -> np.ndarray:
    return np.sqrt(_dot(a, a))


def _segment_gap(p: np.ndarray, a: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Distances of points [N, 1, 3] to the segments from a along d, [F, 3]."""
    square = _dot(d, d)
    t = np.clip(_dot(p - a, d) / np.where(square > 0, square, 1.0), 0.0, 1.0)
    return _length(p - a - t[..., None] * d)


def exact_distance(faces: Tensor, points: np.ndarray, verts: np.ndarray) -> np.ndarray:
    """Distance to the nearest face, over all faces; degenerate ones are their edges."""
    # extended precision where the machine has it: needles cost half of the digits
    points, verts = points.astype(np.longdouble), verts.astype(np.longdouble)
    corners, out = verts[faces.numpy()], []
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac = b - a, c - a
    square = _dot(ab, ab)
    over = np.where(square > 0, 1, 0) / np.where(square > 0, square, 1)
    lean = _dot(ac, ab) * over
    up = ac - lean[:, None] * ab  # across the first edge
    height = _dot(up, up)
    flat = height <= 1e-30 * _dot(ac, ac)
    for chunk in np.array_split(points, max(1, len(points) * len(faces) // 100_000)):
        p = chunk[:, None] - a
        along = _dot(p, ab) * over
        rest = p - along[..., None] * ab
        w = _dot(rest, up) / np.where(flat, 1, height)
        v = along - w * lean
        inside = (v >= 0) & (w >= 0) & (v + w <= 1) & ~flat
        face = np.where(inside, _length(rest - w[..., None] * up), np.inf)
        edges = [_segment_gap(chunk[:, None], s, e - s) for s, e in ((a, b), (b, c), (c, a))]
        out.append(np.minimum(face, np.minimum.reduce(edges)).min(1))
    return np.concatenate(out).astype(np.float64) if out else np.zeros(0)


def scene(faces: Tensor, exact: np.ndarray, points: np.ndarray, verts: np.ndarray) -> np.ndarray:
    """The largest coordinate of mesh and point."""
    size = np.abs(np.nan_to_num(points)).max(1, initial=0)
    return np.maximum(np.maximum(size, np.abs(verts).max()), 1e-30)


# --- meshes and points -------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Mesh:
    """Vertices in float64 and faces."""

    verts: Tensor
    faces: Tensor


def ball(size: float = 1.0, away: float = 0.0, rings: int = 12) -> Mesh:
    """A bumpy closed surface of about a radius, faces seen from outside counter-clockwise."""
    polar = torch.linspace(0, torch.pi, rings + 1, dtype=DOUBLE)[1:-1, None]
    turn = 2 * torch.pi * torch.arange(2 * rings, dtype=DOUBLE) / (2 * rings)
    radius = 1 + 0.1 * torch.sin(3 * turn + 2 * polar)
    x, z = polar.sin() * turn.cos(), -polar.sin() * turn.sin()
    ring = radius[..., None] * torch.stack((x, polar.cos().expand_as(x), z), -1)
    poles = torch.tensor([[0.0, 1, 0], [0, -1, 0]], dtype=DOUBLE)
    verts = torch.cat((ring.reshape(-1, 3), poles))
    across, last = 2 * rings, (rings - 2) * 2 * rings
    faces = []
    for s in range(across):
        n = (s + 1) % across
        faces += [(len(verts) - 2, s, n), (len(verts) - 1, last + n, last + s)]
        for r in range(rings - 2):
            a, b = r * across + s, r * across + n
            faces += [(a, a + across, b), (b, a + across, b + across)]
    return Mesh(verts * size + away, torch.tensor(faces))


@functools.cache
def huge() -> Mesh:
    """A ball of a million triangles."""
    return ball(rings=501)


def soup(kind: str) -> Mesh:
    """A mesh with defects: needles, caps, faces without area, doubled vertices."""
    base = ball()
    verts, faces = base.verts.clone(), base.faces
    if kind == "duplicate":
        corners = verts[faces].reshape(-1, 3)
        return Mesh(corners, torch.arange(len(corners)).reshape(-1, 3))
    if kind == "single":
        return Mesh(
            torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=DOUBLE),
            faces.new_tensor([[0, 1, 2]]),
        )
    if kind == "degenerate":
        doubled = torch.stack((faces[:40, 0], faces[:40, 1], faces[:40, 1]), 1)
        points = faces[:40, :1].expand(-1, 3)
        return Mesh(verts, torch.cat((doubled, points, faces[40:])))
    if kind == "all degenerate":
        return Mesh(verts, torch.stack((faces[:, 0], faces[:, 1], faces[:, 1]), 1))
    return _needles(float(kind))


def _needles(width: float, count: int = 64) -> Mesh:
    """Triangles of length 1 and of a width, tip, base and obtuse corner in turn."""
    generator = torch.Generator().manual_seed(3)
    origin = 4 * torch.randn(count, 3, generator=generator, dtype=DOUBLE)
    along = axes(generator, count)
    side = torch.linalg.cross(along, axes(generator, count).roll(1, 0))
    side = side / side.norm(dim=1, keepdim=True).clamp_min(1e-3)
    shape = torch.tensor([1.0, 0.5, 0.0], dtype=DOUBLE).repeat(count)[:count, None]
    third = origin + shape * along + width * side
    verts = torch.stack((origin, origin + along, third), 1)
    order = [(0, 1, 2), (1, 2, 0), (2, 0, 1)]
    rows = [[3 * i + k for k in order[(i // 3) % 3]] for i in range(count)]
    return Mesh(verts.reshape(-1, 3), torch.tensor(rows))


def near(mesh: Mesh, gap: float, where: str = "face") -> Make:
    """Points at a distance from vertices, edges or inner points of faces."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        rows = torch.randint(0, len(mesh.faces), (count,), generator=generator)
        bary = torch.rand(count, 3, generator=generator, dtype=DOUBLE) + 0.05
        if where == "edge":
            bary[:, 2] = 0
        if where == "vertex":
            bary[:, 1:] = 0
        bary = bary / bary.sum(1, keepdim=True)
        point = (bary[..., None] * mesh.verts[mesh.faces[rows]]).sum(1)
        return point + gap * axes(generator, count), mesh.verts

    return make


def at(mesh: Mesh, place: Callable[[torch.Generator, int], Tensor]) -> Make:
    """Points of a rule, with the vertices of a mesh."""
    return lambda generator, count: (place(generator, count), mesh.verts)


def box() -> Mesh:
    """A cube of edge 2: its medial axis is known."""
    verts = torch.tensor([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for q in quads for t in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))]
    return Mesh(verts.double(), torch.tensor(faces))


def diagonals(generator: torch.Generator, count: int) -> Tensor:
    """Points of the diagonals of a cube: equally far from three faces."""
    t = torch.rand(count, 1, generator=generator, dtype=DOUBLE) * 0.9
    sign = torch.randint(0, 2, (count, 3), generator=generator) * 2.0 - 1
    return t * sign
