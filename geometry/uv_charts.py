"""Charts without flips or overlaps and of little stretch: cut, flatten, relax, split, again."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from .uv_energy import ISOMETRIC, RestShape, face_energy
from .uv_flatten import flipped_charts, harmonic_map, slim_start
from .uv_mesh import CutMesh
from .uv_newton import NewtonSolver
from .uv_overlap import face_signs, overlapping_pairs
from .uv_seams import Surface, cut_to_discs
from .uv_split import chart_mates, fiedler, level_of, seam_mask, split_paths, tip_slits

_ROUNDS = 60
_TRIAL_STEPS = 6
_FINAL_STEPS = 30


@dataclass(frozen=True, eq=False)
class Atlas:
    """Discs and their coordinates, without a flip."""

    surface: Surface
    rest: RestShape
    cut: CutMesh
    uv: Float[np.ndarray, "W 2"]

    @property
    def face_energy(self) -> Float[np.ndarray, "F"]:
        """Energy per area of each face."""
        return face_energy(self.rest.jacobians(self.uv[self.cut.faces]))

    def excess(self, chart: Int[np.ndarray, "F"] | None = None) -> Float[np.ndarray, "C"]:
        """Energy above that of an isometry, summed over the faces of each chart."""
        label = self.cut.chart if chart is None else chart
        return np.bincount(label, (self.face_energy - ISOMETRIC) * self.rest.area)

    @property
    def mean_energy(self) -> float:
        """Mean energy per area."""
        area = self.rest.area
        return float((self.face_energy * area).sum() / area.sum())

    def opened(self, extra: Int[np.ndarray, "n"]) -> "Atlas":
        """The same coordinates with more seams: a start without flips for what comes next."""
        seams = self.cut.seams | seam_mask(len(self.cut.seams), extra)
        cut = CutMesh.of(self.surface.edges, seams)
        uv = np.zeros((len(cut.origin), 2))
        uv[cut.faces.reshape(-1)] = self.uv[self.cut.faces.reshape(-1)]
        return Atlas(self.surface, self.rest, cut, uv)

    def relaxed(self, steps: int, faces: Bool[np.ndarray, "F"] | None = None) -> "Atlas":
        """After some Newton steps on the charts of some faces."""
        some = np.arange(len(self.cut.faces)) if faces is None else np.flatnonzero(faces)
        if len(some) == 0:
            return self
        used, local = np.unique(self.cut.faces[some], return_inverse=True)
        _, chart = np.unique(self.cut.chart[some], return_inverse=True)
        rest = self.rest.of_faces(some)
        solver = NewtonSolver(local.reshape(-1, 3), rest, chart, len(used))
        uv = self.uv.copy()
        uv[used] = solver.run(uv[used], steps)
        return Atlas(self.surface, self.rest, self.cut, uv)

    def overlapping(self) -> Int[np.ndarray, "n"]:
        """Charts that lie on themselves."""
        corner = self.uv[self.cut.faces]
        spread = _apart(corner, self.cut.chart)
        pairs = overlapping_pairs(spread)
        return np.unique(self.cut.chart[pairs[:, 0]])


def _apart(corner: np.ndarray, chart: np.ndarray) -> np.ndarray:
    """Charts moved so far from each other that they cannot meet, by whole numbers of a grid."""
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
    rest = RestShape.of(surface.verts, surface.faces)
    for _ in range(_ROUNDS):
        seams = cut_to_discs(surface, seams)
        cut = CutMesh.of(surface.edges, seams)
        uv = harmonic_map(cut, surface.verts, "uniform")
        bad = flipped_charts(cut, uv)
        if len(bad) == 0:
            uv = slim_start(cut, surface.verts, uv, np.arange(cut.num_charts))
            return Atlas(surface, rest, cut, uv)
        seams = seams | seam_mask(len(seams), _halves(surface, cut, bad))
    return _single_faces(surface, rest)


def _single_faces(surface: Surface, rest: RestShape) -> Atlas:
    """Every face by itself, in its own shape: the last resort, which cannot fail."""
    cut = CutMesh.of(surface.edges, np.ones(len(surface.edges.verts), bool))
    uv = np.zeros((len(cut.origin), 2))
    uv[cut.faces[:, 1:]] = np.linalg.inv(rest.inverse).transpose(0, 2, 1)
    return Atlas(surface, rest, cut, uv)


def _halves(
    surface: Surface, cut: CutMesh, charts: np.ndarray, weight: np.ndarray | None = None
) -> np.ndarray:
    """Edges that cut some discs in two, at the weighted middle of their slowest vibration."""
    mates = chart_mates(surface, cut)
    if surface.mirror is not None:
        charts = np.union1d(charts, mates[charts][mates[charts] >= 0])
    start = surface.verts[cut.origin] @ _long_axis(surface.verts)
    field = fiedler(surface, cut, start, mates)
    area = RestShape.of(surface.verts, surface.faces).area
    level = level_of(cut, field, area if weight is None else weight)
    return split_paths(surface, cut, field, level, charts)


def _long_axis(verts: np.ndarray) -> np.ndarray:
    """A direction that is none of the coordinate axes, for the first guess."""
    spread = np.ptp(verts, axis=0) if len(verts) else np.ones(3)
    return np.array([0.31, 1.0, 0.17]) * np.maximum(spread, 1e-30)


def refined(
    atlas: Atlas,
    target: float,
    max_charts: int | None,
    progress: Callable[[str, float], None] | None = None,
) -> Atlas:
    """Slit and split the charts of most stretch until the mean energy is at the target.

    Args:
        atlas: the discs.
        target: mean symmetric Dirichlet energy per area to reach, above 4.
        max_charts: do not make more charts for the sake of the target.
        progress: told the stage and the share that is done.

    Returns:
        Discs of at most the target energy, none of which lies on itself.
    """
    atlas = atlas.relaxed(_FINAL_STEPS)
    for number in range(_ROUNDS):
        energy = atlas.mean_energy
        if progress is not None:
            progress("charts", min(0.99, (target - 4) / max(energy - 4, 1e-9)))
        full = max_charts is not None and atlas.cut.num_charts >= max_charts
        if energy <= target or full:
            break
        atlas = _round(atlas, target, number)
    return without_overlap(atlas)


def _round(atlas: Atlas, target: float, number: int) -> Atlas:
    """One slit or one split in each of the charts of most excess."""
    cut, surface = atlas.cut, atlas.surface
    excess = atlas.excess()
    wanted = (target - ISOMETRIC) * atlas.rest.area.sum()
    worst = _worst(excess, wanted)
    mates = chart_mates(surface, cut)
    if surface.mirror is not None:
        worst = np.union1d(worst, mates[worst][mates[worst] >= 0])
    active = np.isin(cut.chart, worst)
    density = atlas.face_energy - ISOMETRIC
    slits = tip_slits(surface, cut, density, worst)
    weight = atlas.rest.area * (density + 0.5 * (density * atlas.rest.area).sum() / atlas.rest.area.sum())
    splits = _halves(surface, cut, worst, weight)
    by_slit = atlas.opened(slits).relaxed(_TRIAL_STEPS, active)
    by_split = atlas.opened(splits).relaxed(_TRIAL_STEPS, active)
    gain_slit = excess - by_slit.excess(cut.chart)
    gain_split = excess - by_split.excess(cut.chart)
    take_slit = gain_slit >= 0.7 * gain_split
    edge_chart = _edge_chart(cut)
    chosen = np.concatenate(
        [slits[take_slit[edge_chart[slits]]], splits[~take_slit[edge_chart[splits]]]]
    )
    atlas2 = atlas.opened(chosen)
    # start from what the trial found
    source = np.where(take_slit[cut.chart], 0, 1)
    corner = np.where(
        source[:, None, None] == 0, by_slit.uv[by_slit.cut.faces], by_split.uv[by_split.cut.faces]
    )
    uv = atlas2.uv.copy()
    uv[atlas2.cut.faces.reshape(-1)] = corner.reshape(-1, 2)
    return Atlas(surface, atlas.rest, atlas2.cut, uv).relaxed(_TRIAL_STEPS, active)


def _worst(excess: np.ndarray, wanted: float) -> np.ndarray:
    """The charts of most excess, enough of them to hold a good part of what is too much."""
    order = np.argsort(-excess, kind="stable")
    surplus = max(float(excess.sum()) - wanted, 0.0)
    share = np.cumsum(excess[order])
    count = int(np.searchsorted(share, 0.5 * surplus)) + 1
    return order[: min(count, len(order))]


def _edge_chart(cut: CutMesh) -> np.ndarray:
    """Chart of each uncut edge."""
    return cut.chart[np.maximum(cut.edges.face_pairs[:, 0], 0)]


def without_overlap(atlas: Atlas) -> Atlas:
    """Split what lies on itself until nothing does.

    Args:
        atlas: discs without a flip.

    Returns:
        Discs without a flip or an overlap.
    """
    for _ in range(_ROUNDS):
        bad = atlas.overlapping()
        if len(bad) == 0:
            return atlas
        splits = _halves(atlas.surface, atlas.cut, bad)
        active = np.isin(atlas.cut.chart, bad)
        atlas = atlas.opened(splits).relaxed(_TRIAL_STEPS, active)
    return atlas


def snap_is_sound(corner_uv: Float[np.ndarray, "F 3 2"]) -> bool:
    """Whether no face of a finished layout is flipped.

    Args:
        corner_uv: coordinates per face corner.

    Returns:
        True where all faces have a positive area, exactly.
    """
    return bool((face_signs(corner_uv) > 0).all())
