"""What is wrong with a mesh: one list of findings with counts and the worst places; no torch.

Faces and vertices are named by their numbers in the file. Edges are judged after vertices at one
place are taken as one, since files cut meshes along the seams of their textures.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from monopart.geometry.mesh_graph import face_areas, weld_by_place

from .intersections import self_intersections, uv_faults
from .meshio import WEIGHTS_SUM, Mesh
from .pictures import front_and_back
from .topology import Topology, topology

Severity = Literal["error", "warning", "note"]
_SHOWN = 10
_FLAT = 1e-12  # area of a face without area, in squares of the diagonal of the mesh


@dataclass(frozen=True)
class Offender:
    """One place where something is wrong."""

    indices: tuple[int, ...]
    """Numbers of the faces or vertices, see `Finding.of`."""
    value: float | None = None
    """How bad it is, in the unit of the finding."""
    place: tuple[float, float, float] | None = None
    """Where it is, in the frame of the mesh."""


@dataclass(frozen=True)
class Finding:
    """One kind of fault, and how often it was found."""

    name: str
    """Short name, for scripts."""
    severity: Severity
    """Errors make the report fail, warnings and notes do not."""
    count: int
    """How many were found; none is a finding too."""
    total: int
    """Of how many."""
    of: str
    """What is counted: faces, vertices, edges, pairs of faces."""
    text: str
    """One sentence for people."""
    worst: tuple[Offender, ...] = ()
    """The worst first, at most ten."""

    @property
    def amount(self) -> str:
        """Count and what is counted, in words."""
        if self.of.startswith("pairs"):
            return f"{self.count} {self.of} (of {self.total})"
        return f"{self.count} of {self.total} {self.of}"


@dataclass(frozen=True)
class CheckReport:
    """All findings of a mesh."""

    name: str
    """The mesh."""
    findings: tuple[Finding, ...]
    """In a fixed order; those with a count of 0 passed."""
    numbers: dict[str, float] = field(default_factory=dict)
    """Vertices, faces, pieces, holes, Euler number, area, volume (closed meshes), diagonal."""
    faulty: Bool[np.ndarray, "F"] | None = None
    """Faces with an error, or at a vertex or an edge with one."""

    @property
    def ok(self) -> bool:
        """No error was found."""
        return not any(f.count and f.severity == "error" for f in self.findings)

    def __getitem__(self, name: str) -> Finding:
        """The finding of a name."""
        return next(f for f in self.findings if f.name == name)

    def as_dict(self) -> dict[str, object]:
        """The report as what JSON holds."""
        return {
            "name": self.name,
            "ok": self.ok,
            "numbers": self.numbers,
            "findings": [{**vars(f), "worst": [vars(o) for o in f.worst]} for f in self.findings],
        }

    def lines(self) -> list[str]:
        """The report as lines of text, faults first."""
        order = ("error", "warning", "note")
        found = sorted((f for f in self.findings if f.count), key=lambda f: order.index(f.severity))
        lines = [f"{f.severity}: {f.amount}: {f.text}" for f in found]
        return [*lines, f"{self.name}: {'ok' if self.ok else 'faults found'}"]


class _Checker:
    """The mesh in the forms that the checks need."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.verts, self.faces = mesh.verts, mesh.faces
        self.finite = np.asarray(np.isfinite(self.verts).all(axis=1))
        size = np.abs(self.verts[self.finite]).max(initial=0.0)
        # far from 1 squares overflow or vanish; a power of two changes no digit
        self.unit = 1.0 if size == 0 else 2.0 ** np.floor(np.log2(size))
        clean = np.where(self.finite[:, None], self.verts, 0.0) / self.unit
        self.scaled = clean
        self.welded = self._welded()
        self.faulty = np.zeros(len(self.faces), bool)
        self.sound = self.finite[self.faces].all(axis=1)
        used = clean[np.unique(self.faces[self.sound])]
        self.diagonal = float(np.linalg.norm(np.ptp(used, axis=0))) if len(used) else 0.0

    def _welded(self) -> np.ndarray:
        first = weld_by_place(self.scaled)
        first[~self.finite] = np.flatnonzero(~self.finite)
        return first

    def mark(self, rows: np.ndarray, of: str) -> None:
        """Remember the faces of an error: those given, or those at all given vertices of a row."""
        if "faces" in of:
            self.faulty[rows] = True
        elif rows.ndim == 1:
            self.faulty |= np.isin(self.welded[self.faces], self.welded[rows]).any(axis=1)
        else:
            ends = np.sort(self.welded[self.faces][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
            both = np.unique(np.concatenate([rows, ends]), axis=0, return_inverse=True)[1].reshape(
                -1
            )
            hit = np.isin(both[len(rows) :], both[: len(rows)])
            self.faulty |= hit.reshape(-1, 3).any(axis=1)

    def faults(
        self,
        name: str,
        severity: Severity,
        of: str,
        total: int,
        text: str,
        rows: np.ndarray,
        values: np.ndarray | None = None,
    ) -> Finding:
        """A finding; rows [N] or [N, K] of faces or vertices, values larger for worse ones."""
        rows = np.asarray(rows, np.int64)
        if severity == "error" and len(rows):
            self.mark(rows, of)
        order = np.arange(len(rows)) if values is None else np.argsort(-values, kind="stable")
        worst = []
        for k in order[:_SHOWN]:
            indices = np.atleast_1d(rows[k])
            verts = self.faces[indices].reshape(-1) if "faces" in of else indices
            with np.errstate(invalid="ignore", over="ignore"):
                place = self.verts[verts].mean(0)
            shown = tuple(place.tolist()) if np.isfinite(place).all() else None
            value = None if values is None else float(values[k])
            worst.append(Offender(tuple(indices.tolist()), value, shown))
        return Finding(name, severity, len(rows), total, of, text, tuple(worst))


def check_mesh(
    mesh: Mesh, *, symmetry_plane: float | None = 0.0, intersections: bool = True
) -> CheckReport:
    """Look for all that makes a mesh unfit for other tools.

    Args:
        mesh: any mesh; it may be broken in any way that `Mesh` lets pass.
        symmetry_plane: x of the plane that left and right are compared in, metres; None to not.
        intersections: also look for faces that cut each other, which takes longest (200 000 faces:
            about ten seconds).

    Returns:
        The report; its `ok` says that there is no error.

    >>> report = check_mesh(Mesh(np.eye(3), np.array([[0, 1, 2]])))
    >>> report.ok, report["open_edges"].count
    (True, 3)
    """
    data = _Checker(mesh)
    whole = _whole(data)
    shape = topology(data.welded[data.faces[whole]], len(data.verts))
    findings = [*_numbers_and_faces(data, whole), *_edges(data, shape, whole)]
    if intersections:
        findings.append(_cuts(data, whole))
    findings += [*_texture(data), *_weights(data)]
    if symmetry_plane is not None:
        findings.append(_symmetry(data, symmetry_plane))
    return CheckReport(mesh.name, tuple(findings), _facts(data, shape, whole), data.faulty)


def check_picture(mesh: Mesh, report: CheckReport, height: int = 640) -> Float[np.ndarray, "h w 3"]:
    """The mesh in grey from front and back, faces with an error in red.

    Args:
        mesh: the mesh, y up and front at +z.
        report: its report.
        height: rows of a view.

    Returns:
        sRGB in [0, 1].
    """
    good, bad = np.array([0.72, 0.74, 0.78]), np.array([0.9, 0.1, 0.1])
    faulty = np.zeros(mesh.num_faces, bool) if report.faulty is None else report.faulty
    colors = np.where(faulty[:, None], bad, good)
    legend = [(f"{int(faulty.sum())} faces with an error", bad), ("no error", good)]
    return front_and_back(mesh.verts, mesh.faces, colors, legend, height)


def _whole(data: _Checker) -> np.ndarray:
    """Faces with three different finite vertices."""
    corner = data.welded[data.faces]
    twice = (corner == np.roll(corner, 1, 1)).any(1)
    return np.flatnonzero(data.sound & ~twice)


def _numbers_and_faces(data: _Checker, whole: np.ndarray) -> Iterator[Finding]:
    verts, faces = len(data.verts), len(data.faces)
    bad = np.flatnonzero(~data.finite)
    text = "have NaN or infinite coordinates"
    yield data.faults("not_finite", "error", "vertices", verts, text, bad)
    missing = 0 if faces else 1
    text = "the mesh has no faces"
    yield Finding("empty", "error", missing, 1, "meshes", text)
    twice = np.setdiff1d(np.flatnonzero(data.sound), whole)
    area = face_areas(data.scaled, data.faces)
    thin = whole[area[whole] <= _FLAT * data.diagonal**2]
    flat = np.concatenate([twice, thin])
    text = "have no area"
    yield data.faults("degenerate", "error", "faces", faces, text, flat, -area[flat])
    unused = np.setdiff1d(np.arange(verts), data.faces)
    text = "belong to no face"
    yield data.faults("unused_vertices", "warning", "vertices", verts, text, unused)
    double = np.flatnonzero(data.welded != np.arange(verts))
    text = "lie exactly where another does (cut along texture seams, or not merged)"
    yield data.faults("duplicate_vertices", "note", "vertices", verts, text, double)


def _edges(data: _Checker, shape: Topology, whole: np.ndarray) -> Iterator[Finding]:
    faces = len(data.faces)
    edges = (3 * len(whole) + len(shape.open_edges)) // 2

    def of_edges(name: str, severity: Severity, text: str, rows: np.ndarray) -> Finding:
        length = np.linalg.norm(np.diff(data.scaled[rows], axis=1)[:, 0], axis=1) * data.unit
        return data.faults(name, severity, "edges", edges, text, rows, length)

    text = f"belong to one face: the mesh is not watertight ({shape.holes} holes)"
    yield of_edges("open_edges", "warning", text, shape.open_edges)
    text = "belong to three faces or more"
    yield of_edges("branching_edges", "error", text, shape.branching_edges)
    text = "have faces on both sides that are wound against each other"
    yield of_edges("turned_edges", "error", text, shape.turned_edges)
    text = "hold fans of faces together that share no edge there"
    pinched = shape.pinched_verts
    yield data.faults("pinched_vertices", "error", "vertices", len(data.verts), text, pinched)
    text = "have the same vertices as another"
    again = whole[shape.repeated_faces]
    yield data.faults("duplicate_faces", "error", "faces", faces, text, again)
    inside_out = _inside_out(data, shape, whole)
    text = "are wound so that their closed piece is inside out"
    yield data.faults("inside_out", "warning", "faces", faces, text, inside_out)


def _volumes(data: _Checker, shape: Topology, whole: np.ndarray) -> np.ndarray:
    """Signed volume of each piece, in cubes of the unit."""
    a, b, c = np.moveaxis(data.scaled[data.faces[whole]], 1, 0)
    middle = a.mean(0) if len(a) else 0.0
    six = ((a - middle) * np.cross(b - middle, c - middle)).sum(1)
    return np.bincount(shape.piece, six / 6, shape.num_pieces)


def _inside_out(data: _Checker, shape: Topology, whole: np.ndarray) -> np.ndarray:
    corner = data.welded[data.faces[whole]]
    odd = np.unique(np.concatenate([shape.open_edges, shape.turned_edges]))
    spoiled = np.unique(shape.piece[np.isin(corner, odd).any(1)])
    negative = np.flatnonzero(_volumes(data, shape, whole) < 0)
    return whole[np.isin(shape.piece, np.setdiff1d(negative, spoiled))]


def _cuts(data: _Checker, whole: np.ndarray) -> Finding:
    pairs = whole[self_intersections(data.scaled, data.welded[data.faces[whole]])]
    text = "cut, touch or cover each other"
    of = "pairs of faces"
    return data.faults("self_intersections", "error", of, len(data.faces), text, pairs)


def _texture(data: _Checker) -> Iterator[Finding]:
    uv = data.mesh.corner_uv
    if uv is None:
        return
    faces = len(data.faces)
    fine = np.isfinite(uv).all((1, 2))
    text = "have NaN or infinite texture coordinates"
    yield data.faults("uv_not_finite", "error", "faces", faces, text, np.flatnonzero(~fine))
    known = np.flatnonzero(fine)
    found = uv_faults(uv[known], data.scaled, data.faces[known])
    text = "are turned over in the texture"
    yield data.faults("uv_flipped", "error", "faces", faces, text, known[found.flipped])
    text = "have no area in the texture"
    yield data.faults("uv_flat", "error", "faces", faces, text, known[found.flat])
    text = "lie over each other in the texture"
    of = "pairs of faces"
    over = known[found.overlaps]
    yield data.faults("uv_overlaps", "error", of, faces, text, over, found.depth)
    beyond = np.maximum(uv[known] - 1, -uv[known]).max((1, 2), initial=0.0)
    out = beyond > 1e-6
    text = "leave the unit square of the texture"
    yield data.faults("uv_outside", "warning", "faces", faces, text, known[out], beyond[out])


def _weights(data: _Checker) -> Iterator[Finding]:
    weights = data.mesh.weights
    if weights is None:
        return
    verts = len(data.verts)
    fine = np.isfinite(weights).all(1)
    text = "have NaN or infinite weights"
    bad = np.flatnonzero(~fine)
    yield data.faults("weights_not_finite", "error", "vertices", verts, text, bad)
    known = np.flatnonzero(fine)
    rows = weights[known]
    none = ~rows.any(1)
    text = "have no weights"
    yield data.faults("unweighted", "error", "vertices", verts, text, known[none])
    gap = np.abs(rows.sum(1) - 1)
    wrong = ~none & (gap > WEIGHTS_SUM)
    text = f"have weights whose sum is off 1 by more than {WEIGHTS_SUM:g}"
    off = known[wrong]
    yield data.faults("weights_sum", "error", "vertices", verts, text, off, gap[wrong])
    below = -rows.min(1, initial=0.0)
    text = "have negative weights"
    negative = below > 0
    off = known[negative]
    yield data.faults("weights_negative", "error", "vertices", verts, text, off, below[negative])


def _symmetry(data: _Checker, plane: float) -> Finding:
    from scipy.spatial import KDTree

    known = np.flatnonzero(data.finite)
    points = data.scaled[known]
    gap = np.zeros(len(points))
    if len(points):
        mirror = points * [-1, 1, 1] + np.array([2 * plane / data.unit, 0, 0])
        gap = KDTree(points).query(mirror)[0]
    off = gap > 1e-3 * data.diagonal
    text = f"have no vertex at their mirror image in x = {plane:g}, to a thousandth of the diagonal"
    values = gap[off] * data.unit
    total = len(data.verts)
    return data.faults("asymmetric", "note", "vertices", total, text, known[off], values)


def _facts(data: _Checker, shape: Topology, whole: np.ndarray) -> dict[str, float]:
    facts: dict[str, float] = {
        "vertices": len(data.verts),
        "faces": len(data.faces),
        "pieces": shape.num_pieces,
        "holes": shape.holes,
        "euler": shape.euler,
        "diagonal": data.diagonal * data.unit,
    }
    with np.errstate(over="ignore"):
        facts["area"] = float(face_areas(data.scaled, data.faces[whole]).sum() * data.unit**2)
        if shape.closed and not len(shape.turned_edges) and len(whole):
            facts["volume"] = float(_volumes(data, shape, whole).sum() * data.unit**3)
    return {name: float(value) for name, value in facts.items() if np.isfinite(value)}
