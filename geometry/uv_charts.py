"""Discs in the plane without flips: opened along more seams, relaxed, tested for overlap."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from .uv_energy import ISOMETRIC, RestShape, face_energy
from .uv_flatten import arap_map, flipped_charts, harmonic_map, lscm_map, slim_start
from .uv_mesh import CutMesh
from .uv_mirror import chart_mates, mirrored_edges
from .uv_newton import relaxed_charts
from .uv_overlap import overlapping_pairs
from .uv_seams import Surface, cut_to_discs
from .uv_split import fiedler, split_paths

_ROUNDS = 40


@dataclass(frozen=True, eq=False)
class Atlas:
    """Discs and their coordinates, without a flip."""

    surface: Surface
    rest: RestShape
    cut: CutMesh
    uv: Float[np.ndarray, "W 2"]

    @cached_property
    def density(self) -> Float[np.ndarray, "F"]:
        """Energy per area of each face above that of an isometry."""
        return face_energy(self.rest.jacobians(self.corner_uv)) - ISOMETRIC

    @property
    def corner_uv(self) -> Float[np.ndarray, "F 3 2"]:
        """Coordinates per face corner."""
        return self.uv[self.cut.faces]

    @property
    def face_excess(self) -> Float[np.ndarray, "F"]:
        """Energy of each face above that of an isometry."""
        return self.density * self.rest.area

    @property
    def mean_energy(self) -> float:
        """Mean energy per area."""
        return ISOMETRIC + float(self.face_excess.sum() / self.rest.area.sum())

    def opened(self, extra: Int[np.ndarray, "n"]) -> "Atlas":
        """The same coordinates with more seams: a start without flips for what comes next."""
        seams = self.cut.seams.copy()
        seams[extra] = True
        cut = CutMesh.of(self.surface.edges, seams)
        if (cut.euler != 1).any():
            cut = CutMesh.of(self.surface.edges, cut_to_discs(self.surface, seams))
        return self.carried(cut, self.corner_uv)

    def carried(self, cut: CutMesh, corner_uv: Float[np.ndarray, "F 3 2"]) -> "Atlas":
        """Coordinates of corners on another cut."""
        uv = np.zeros((len(cut.origin), 2))
        uv[cut.faces.reshape(-1)] = corner_uv.reshape(-1, 2)
        return Atlas(self.surface, self.rest, cut, uv)

    def relaxed(
        self, steps: int, faces: Bool[np.ndarray, "F"] | None = None, gain: float = 1e-3
    ) -> "Atlas":
        """After some Newton steps on the charts of some faces."""
        some = np.arange(len(self.cut.faces)) if faces is None else np.flatnonzero(faces)
        if len(some) == 0:
            return self
        uv = relaxed_charts(
            self.cut.faces[some],
            self.rest.of_faces(some),
            self.cut.chart[some],
            self.uv,
            steps,
            gain,
        )
        return Atlas(self.surface, self.rest, self.cut, uv)

    def overlaps(self, faces: Bool[np.ndarray, "F"] | None = None) -> Int[np.ndarray, "n 2"]:
        """Pairs of faces (of some) of one chart that lie on each other."""
        some = np.arange(len(self.cut.faces)) if faces is None else np.flatnonzero(faces)
        if len(some) == 0:
            return np.zeros((0, 2), np.int64)
        _, chart = np.unique(self.cut.chart[some], return_inverse=True)
        return some[overlapping_pairs(_apart(self.corner_uv[some], chart))]


def _apart(corner: np.ndarray, chart: np.ndarray) -> np.ndarray:
    """Charts moved so far from each other that they cannot meet."""
    count = int(chart.max(initial=-1)) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    for k in range(3):
        np.minimum.at(low, chart, corner[:, k])
        np.maximum.at(high, chart, corner[:, k])
    step = 1.25 * float((high - low).max(initial=1e-30))
    width = int(np.ceil(np.sqrt(count)))
    place = np.stack([np.arange(count) % width, np.arange(count) // width], 1) * step
    return corner + (place - low)[chart][:, None]


def first_atlas(surface: Surface, seams: Bool[np.ndarray, "E"]) -> Atlas:
    """Discs along given seams, flattened without a flip; what cannot be is split until it can.

    Args:
        surface: the mesh.
        seams: edges that must be cut.

    Returns:
        The discs.
    """
    rest = surface.rest
    for _ in range(_ROUNDS):
        seams = cut_to_discs(surface, seams)
        cut = CutMesh.of(surface.edges, seams)
        uv = harmonic_map(cut, surface.verts, "uniform")
        # a face may be so thin that rounding flips its Jacobian alone
        endless = ~np.isfinite(face_energy(rest.jacobians(uv[cut.faces])))
        bad = np.union1d(flipped_charts(cut, uv), np.unique(cut.chart[endless]))
        if len(bad) == 0:
            uv = slim_start(cut, surface.verts, uv, np.arange(cut.num_charts))
            return Atlas(surface, rest, cut, uv)
        seams = seams.copy()
        seams[halves(surface, cut, bad, rest.area)] = True
    cut = CutMesh.of(surface.edges, np.ones(len(seams), bool))
    uv = np.zeros((len(cut.origin), 2))
    uv[cut.faces[:, 1:]] = np.linalg.inv(rest.inverse).transpose(0, 2, 1)
    return Atlas(surface, rest, cut, uv)


def shared_out(
    surface: Surface, seams: Bool[np.ndarray, "E"], share: float
) -> Bool[np.ndarray, "E"]:
    """Add the seams that leave no chart with more than a share of the area, and only discs.

    Args:
        surface: the mesh.
        seams: edges that must be cut.
        share: of the whole area.

    Returns:
        Edges to cut.
    """
    area = surface.rest.area
    for _ in range(_ROUNDS):
        seams = cut_to_discs(surface, seams)
        cut = CutMesh.of(surface.edges, seams)
        sizes = np.bincount(cut.chart, area, minlength=cut.num_charts)
        large = np.flatnonzero(sizes > share * area.sum() * (1 + 1e-6))
        mates = chart_mates(surface, cut)
        leads = large[~((mates[large] >= 0) & (mates[large] < large))]
        extra = halves(surface, cut, leads, area)
        owner = cut.chart[np.maximum(cut.edges.face_pairs[extra, 0], 0)]
        extra = np.concatenate([extra, mirrored_edges(surface, extra[mates[owner] > owner])])
        extra = extra[~seams[extra]]
        if len(extra) == 0:
            break
        seams = seams.copy()
        seams[extra] = True
    return seams


def atlas_by_method(
    surface: Surface, seams: Bool[np.ndarray, "E"], method: Literal["arap", "lscm", "harmonic"]
) -> Atlas:
    """Discs flattened by a method that may flip faces.

    Args:
        surface: the mesh.
        seams: edges that must be cut.
        method: "harmonic", "lscm" or "arap".

    Returns:
        The discs; each scaled to its area.
    """
    cut = CutMesh.of(surface.edges, cut_to_discs(surface, seams))
    maps = {"harmonic": harmonic_map, "lscm": lscm_map, "arap": arap_map}
    uv = maps[method](cut, surface.verts)
    return Atlas(surface, surface.rest, cut, uv)


def halves(
    surface: Surface, cut: CutMesh, charts: Int[np.ndarray, "n"], weight: Float[np.ndarray, "F"]
) -> Int[np.ndarray, "m"]:
    """Edges that cut some discs in two, along the zero line of their slowest vibration.

    Args:
        surface: the mesh.
        cut: its cut.
        charts: numbers of the discs.
        weight: mass of each face.

    Returns:
        Edge indices.
    """
    field = fiedler(surface, cut, first_guess(surface)[cut.origin], weight, charts)
    return split_paths(surface, cut, field, weight, charts)


def first_guess(surface: Surface) -> Float[np.ndarray, "V"]:
    """A linear field along no axis, to start the search for the slowest vibration.

    Args:
        surface: the mesh.

    Returns:
        Values at the vertices of the mesh.
    """
    spread = np.ptp(surface.verts, axis=0) if len(surface.verts) else np.ones(3)
    return surface.verts @ (np.array([0.31, 1.0, 0.17]) * np.maximum(spread, 1e-30))
