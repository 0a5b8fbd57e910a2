"""Discs in the plane without flips: opened along more seams, relaxed, tested for overlap."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from .uv_energy import ISOMETRIC, RestShape, face_energy
from .uv_flatten import (
    arap_map,
    flipped_charts,
    harmonic_map,
    lscm_map,
    slim_start,
    smoothed_inside,
)
from .uv_mesh import CutMesh
from .uv_mirror import (
    chart_mates,
    extended,
    image_vertices,
    mirrored_edges,
    symmetric_edges,
    symmetric_start,
)
from .uv_newton import relaxed_charts
from .uv_overlap import overlapping_pairs
from .uv_seams import Surface, cut_to_discs
from .uv_split import fiedler, split_paths

_ROUNDS = 40
_WORSE = 0.05
"""Part by which a reflected chart may have more excess than its image before it is relaxed."""
_FAR = 20.0
"""How many times the excess of its image such a chart may have to be mended at all."""
_CRUSHED, _RINGS = 100.0, 3
"""Excess per area of a face that is laid out anew, and how many rings of others with it."""
_MEND_STEPS = 5
"""Newton steps after which such a chart is good enough: it starts near the lowest energy."""


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

    @cached_property
    def mates(self) -> Int[np.ndarray, "C"]:
        """The chart that is the mirror image of each one, see `chart_mates`."""
        return chart_mates(self.surface, self.cut)

    @property
    def corner_uv(self) -> Float[np.ndarray, "F 3 2"]:
        """Coordinates per face corner."""
        return self.uv[self.cut.faces]

    @property
    def face_excess(self) -> Float[np.ndarray, "F"]:
        """Energy of each face above that of an isometry."""
        return self.density * self.rest.area

    @cached_property
    def chart_excess(self) -> Float[np.ndarray, "C"]:
        """The same of each chart."""
        return np.bincount(self.cut.chart, self.face_excess, minlength=self.cut.num_charts)

    @property
    def chart_area(self) -> Float[np.ndarray, "C"]:
        """Area of each chart on the surface."""
        return np.bincount(self.cut.chart, self.rest.area, minlength=self.cut.num_charts)

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
        """After some Newton steps on the charts of some faces.

        Of two charts that mirror each other one is relaxed, and reflected onto the other.
        """
        count = self.cut.num_charts
        active = np.ones(count, bool)
        if faces is not None:
            active = np.bincount(self.cut.chart[faces], minlength=count) > 0
        follows = self._image[1] & active & active[self.mates]
        out = self._solved(steps, active & ~follows, gain)
        if not follows.any():
            return out
        out, near, alone = out._reflected(follows)
        return out._solved(min(steps, _MEND_STEPS), near, gain)._solved(steps, alone, gain)

    @cached_property
    def _image(self) -> "tuple[np.ndarray, np.ndarray]":
        return image_vertices(self.surface, self.cut, self.mates)

    def _solved(self, steps: int, charts: Bool[np.ndarray, "C"], gain: float) -> "Atlas":
        some = np.flatnonzero(charts[self.cut.chart])
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
        return self.moved(uv)

    def moved(self, uv: Float[np.ndarray, "W 2"]) -> "Atlas":
        """Other coordinates on the same cut."""
        out = Atlas(self.surface, self.rest, self.cut, uv)
        for name in ("mates", "_image"):  # they depend on the cut alone
            if name in self.__dict__:
                out.__dict__[name] = self.__dict__[name]
        return out

    def _reflected(
        self, follows: Bool[np.ndarray, "C"]
    ) -> "tuple[Atlas, Bool[np.ndarray, 'C'], Bool[np.ndarray, 'C']]":
        """Some charts as the mirror images of theirs; those that are worse, and those that stay."""
        image = np.where(follows[self.cut.vert_chart], self._image[0], -2)
        uv = np.where(image[:, None] >= 0, self.uv[image] * [-1.0, 1.0], self.uv)
        trial = self.moved(extended(self.surface, self.cut, uv, image != -1))
        for rings in range(_RINGS):
            trial = trial._mended(follows, rings, False)._mended(follows, rings, True)
        excess = trial.chart_excess
        lead = excess[self.mates]
        worse = follows & ~(excess <= (1 + _WORSE) * lead + _WORSE * 1e-2 * trial.chart_area)
        stays = worse & ~(excess <= np.maximum(self.chart_excess, _FAR * lead))
        back = stays[self.cut.vert_chart][:, None]
        return self.moved(np.where(back, self.uv, trial.uv)), worse & ~stays, stays

    def _mended(self, charts: Bool[np.ndarray, "C"], rings: int, border: bool) -> "Atlas":
        """Flipped faces of some charts, and some rings around them, laid out anew if that helps."""
        cut = self.cut
        bad = faces = charts[cut.chart] & ~(self.density < _CRUSHED)
        if not bad.any():
            return self
        free = np.zeros(len(cut.origin), bool)
        for _ in range(rings + 1):
            free[cut.faces[faces]] = True
            faces = charts[cut.chart] & free[cut.faces].any(1)
        uv = extended(self.surface, cut, self.uv, ~free) if border else self.uv
        trial = self.moved(smoothed_inside(cut, self.surface.flat, uv, free))
        before = np.bincount(cut.chart, bad, minlength=cut.num_charts)
        after = np.bincount(cut.chart, ~(trial.density < _CRUSHED), minlength=cut.num_charts)
        helps = (after < before)[cut.vert_chart][:, None]
        return self.moved(np.where(helps, trial.uv, self.uv))

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
            return _started(Atlas(surface, rest, cut, uv))
        seams = seams.copy()
        seams[halves(surface, cut, bad, rest.area)] = True
    cut = CutMesh.of(surface.edges, np.ones(len(seams), bool))
    uv = np.zeros((len(cut.origin), 2))
    uv[cut.faces[:, 1:]] = np.linalg.inv(rest.inverse).transpose(0, 2, 1)
    return Atlas(surface, rest, cut, uv)


def _started(atlas: Atlas) -> Atlas:
    """The first iterations; one of two charts that mirror each other is spared them."""
    follows = atlas._image[1]
    uv = slim_start(atlas.cut, atlas.surface.verts, atlas.uv, np.flatnonzero(~follows))
    return atlas.moved(uv)._reflected(follows)[0]


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
    seams = symmetric_start(surface, seams)
    for _ in range(_ROUNDS):
        seams = cut_to_discs(surface, seams)
        cut = CutMesh.of(surface.edges, seams)
        sizes = np.bincount(cut.chart, area, minlength=cut.num_charts)
        large = np.flatnonzero(sizes > share * area.sum() * (1 + 1e-6))
        mates = chart_mates(surface, cut)
        leads = large[~((mates[large] >= 0) & (mates[large] < large))]
        extra = halves(surface, cut, leads, area)
        owner = cut.chart[np.maximum(cut.edges.face_pairs[extra, 0], 0)]
        own = [
            symmetric_edges(surface, cut, extra[owner == c]) for c in leads[mates[leads] == leads]
        ]
        others = extra[mates[owner] != owner]
        image = mirrored_edges(surface, extra[mates[owner] > owner])
        extra = np.concatenate([*own, others, image])
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
