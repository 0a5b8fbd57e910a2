"""Which charts to slit and which to split: the largest gain for a seam and a chart comes first."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from .uv_charts import Atlas, first_guess, halves
from .uv_energy import ISOMETRIC
from .uv_mirror import mirrored_edges, symmetric_edges
from .uv_split import charts_after, fiedler, separators, sign_changes, split_paths, tip_slits

_ROUNDS = 80
_TRIAL_STEPS = (5, 12)
_FINAL_STEPS = (15, 40)
"""Fewest and most Newton steps; the most up to `_LARGE` faces, fewer in proportion above."""
_LARGE = 50_000
_NEAR = 1.5
"""Excess, in that of the target, below which the charts are relaxed before more are cut."""
_CHART_PRICE = 0.15
"""What a chart costs, as a length of seam, in units of the square root of the area."""
_SEAM_PRICE = 0.1
"""What any seam costs, however short."""

Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class Move:
    """A slit or a split of one chart, or of two that mirror each other, tried out."""

    edges: Int[np.ndarray, "n"]
    faces: Int[np.ndarray, "m"]
    corner_uv: np.ndarray
    """Coordinates of the corners of the faces after the move."""
    gain: float
    """Energy by which it falls."""
    price: float


def refined(
    atlas: Atlas, target: float, max_charts: int | None, progress: Progress | None = None
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
    atlas = atlas.relaxed(_steps(_FINAL_STEPS, atlas))
    atlas = _towards(atlas, target, max_charts, progress)
    for _ in range(_ROUNDS):
        pairs = atlas.overlaps()
        if len(pairs) == 0:
            break
        atlas = _separated(atlas, pairs)
    return atlas


def _steps(bounds: tuple[int, int], atlas: Atlas) -> int:
    least, most = bounds
    return max(least, min(most, most * _LARGE // max(len(atlas.cut.faces), 1)))


def _towards(
    atlas: Atlas, target: float, max_charts: int | None, progress: Progress | None
) -> Atlas:
    known: dict[tuple[int, ...], Move] = {}
    near = False
    for _ in range(_ROUNDS):
        energy = atlas.mean_energy
        if not near and energy - ISOMETRIC < _NEAR * (target - ISOMETRIC):
            # what the trials left undone is a part of the excess by now
            atlas, near = atlas.relaxed(_steps(_FINAL_STEPS, atlas)), True
            energy = atlas.mean_energy
            known.clear()
        if progress is not None:
            progress("charts", min(0.99, (target - 4) / max(energy - 4, 1e-9)))
        full = max_charts is not None and atlas.cut.num_charts >= max_charts
        if energy <= target or full:
            break
        moves = _moves(atlas, target, known)
        chosen = _best(moves, atlas, target)
        if not chosen:
            break
        corner = atlas.corner_uv.copy()
        for move in chosen:
            corner[move.faces] = move.corner_uv
        seams = np.concatenate([move.edges for move in chosen])
        opened = atlas.opened(seams)
        atlas = opened.carried(opened.cut, corner)
    return atlas.relaxed(_steps(_FINAL_STEPS, atlas), gain=1e-4)


def _best(moves: list[Move], atlas: Atlas, target: float) -> list[Move]:
    """The moves of the best ratio of gain to price, not more than are needed."""
    surplus = float(atlas.face_excess.sum() - (target - ISOMETRIC) * atlas.rest.area.sum())
    order = sorted(range(len(moves)), key=lambda i: (-moves[i].gain / moves[i].price, i))
    chosen: list[Move] = []
    for i in order:
        move = moves[i]
        best = moves[order[0]].gain / moves[order[0]].price
        if (
            move.gain <= 0
            or len(move.edges) == 0
            or surplus <= 0
            or move.gain / move.price < 0.4 * best
        ):
            break
        chosen.append(move)
        surplus -= move.gain
    return chosen


def _units(atlas: Atlas) -> list[tuple[int, ...]]:
    """Charts that are changed together: a chart and its mirror image, or one alone."""
    return [
        (chart, int(mate)) if mate > chart else (chart,)
        for chart, mate in enumerate(atlas.mates)
        if mate < 0 or mate >= chart
    ]


def _moves(atlas: Atlas, target: float, known: dict[tuple[int, ...], Move]) -> list[Move]:
    """The best move of each unit; those that are not known yet are tried out, all at once."""
    cut = atlas.cut
    excess = np.bincount(cut.chart, atlas.face_excess, minlength=cut.num_charts)
    first = np.full(cut.num_charts, len(cut.chart))
    np.minimum.at(first, cut.chart, np.arange(len(cut.chart)))
    size = np.bincount(cut.chart, minlength=cut.num_charts)
    open_sides = np.bincount(
        cut.chart, cut.seams[cut.edges.of_face].sum(1), minlength=cut.num_charts
    ).astype(int)
    units = _units(atlas)
    weight = [float(excess[list(u)].sum()) for u in units]
    surplus = float(excess.sum() - (target - ISOMETRIC) * atlas.rest.area.sum())
    floor = min(0.3 * max(weight), 0.02 * surplus)
    units = [u for u, w in zip(units, weight, strict=True) if w >= floor]
    keys = [tuple(int(x) for c in u for x in (first[c], size[c], open_sides[c])) for u in units]
    fresh = [i for i, key in enumerate(keys) if key not in known]
    if fresh:
        for i, move in zip(fresh, _tried(atlas, [units[i] for i in fresh]), strict=True):
            known[keys[i]] = move
    return [known[key] for key in keys]


def _tried(atlas: Atlas, units: list[tuple[int, ...]]) -> list[Move]:
    """For each unit the better one of a slit and a split."""
    cut, surface = atlas.cut, atlas.surface
    leads = np.array([u[0] for u in units])
    density = atlas.density
    mean = np.bincount(cut.chart, atlas.face_excess) / np.bincount(cut.chart, atlas.rest.area)
    slits = tip_slits(surface, cut, density, leads)
    splits = halves(surface, cut, leads, atlas.rest.area * (density + 0.1 * mean[cut.chart]))
    options = [_moves_of(atlas, units, edges) for edges in (slits, splits)]
    return [max(pair, key=lambda m: m.gain / m.price) for pair in zip(*options, strict=True)]


def _moves_of(atlas: Atlas, units: list[tuple[int, ...]], edges: np.ndarray) -> list[Move]:
    cut, surface = atlas.cut, atlas.surface
    chart = cut.chart[np.maximum(cut.edges.face_pairs[edges, 0], 0)]
    groups = []
    for unit in units:
        lead = unit[0]
        own = edges[chart == lead]
        if len(unit) > 1:
            own = np.union1d(own, mirrored_edges(surface, own))
        elif atlas.mates[lead] == lead:
            own = symmetric_edges(surface, cut, own[~cut.seams[own]])
        groups.append(own[~cut.seams[own]])
    trial = atlas.opened(np.concatenate(groups))
    active = np.isin(cut.chart, np.concatenate(units))
    trial = trial.relaxed(_steps(_TRIAL_STEPS, atlas), active)
    corner, before, after = trial.corner_uv, atlas.face_excess, trial.face_excess
    scale = float(np.sqrt(atlas.rest.area.sum()))
    # what was cut besides, to come to discs, belongs to the move: its coordinates need it
    fresh = np.flatnonzero(trial.cut.seams & ~cut.seams)
    owner = cut.chart[cut.edges.face_pairs[fresh, 0]]
    moves = []
    for unit in units:
        own = fresh[np.isin(owner, unit)]
        faces = np.flatnonzero(np.isin(cut.chart, unit))
        new = len(np.unique(trial.cut.chart[faces])) - len(unit)
        price = _SEAM_PRICE + float(surface.length[own].sum()) / scale + _CHART_PRICE * new
        gain = float(before[faces].sum() - after[faces].sum())
        moves.append(Move(own, faces, corner[faces], gain, price))
    return moves


def _separated(atlas: Atlas, pairs: Int[np.ndarray, "n 2"]) -> Atlas:
    """Every chart that lies on itself cut in two, so that most of the faces that meet part.

    Of two such charts that mirror each other one is told where, the other is cut there too.
    """
    cut, surface, area = atlas.cut, atlas.surface, atlas.rest.area
    folded = np.bincount(cut.chart[pairs[:, 0]], minlength=cut.num_charts) > 0
    follows = folded & (atlas.mates >= 0) & (atlas.mates < np.arange(len(folded)))
    follows &= folded[atlas.mates]
    pairs = pairs[~follows[cut.chart[pairs[:, 0]]]]
    charts = np.flatnonzero(folded & ~follows)
    meets = np.bincount(pairs.reshape(-1), minlength=len(cut.chart)) > 0
    start = first_guess(surface)[cut.origin]
    slow = fiedler(surface, cut, start, area, charts)
    heavy = area * (meets + 0.01)
    around = fiedler(surface, cut, start, heavy, charts)
    fields = [(separators(surface, cut, pairs, f), heavy) for f in (slow, around)]
    fields += [(slow, area), (around, heavy)]
    options = [split_paths(surface, cut, field, weight, charts) for field, weight in fields]
    options.append(sign_changes(cut, fields[0][0]))
    edges = _parting(atlas, pairs, options)
    if len(edges) == 0:
        return atlas.opened(cut.edges.of_face[pairs[:, 0]].reshape(-1))
    lead = cut.chart[np.maximum(cut.edges.face_pairs[edges, 0], 0)]
    image = mirrored_edges(surface, edges[np.isin(atlas.mates[lead], np.flatnonzero(follows))])
    edges = np.union1d(edges, image[~cut.seams[image]])
    active = folded[cut.chart]
    return atlas.opened(edges).relaxed(_steps(_TRIAL_STEPS, atlas), active)


def _parting(atlas: Atlas, pairs: np.ndarray, options: list[np.ndarray]) -> np.ndarray:
    """Of ways to cut the charts, for each the one that parts most pairs for its length.

    The last way, along every line, makes many charts: it is for those that no other helps.
    """
    cut = atlas.cut
    before = np.bincount(cut.chart[pairs[:, 0]], minlength=cut.num_charts)
    stays, least = before.copy(), np.full(cut.num_charts, np.inf)
    best: dict[int, np.ndarray] = {}
    for number, option in enumerate(options):
        edges = option[~cut.seams[option]]
        owner = cut.chart[np.maximum(cut.edges.face_pairs[edges, 0], 0)]
        after = charts_after(cut, edges)
        joined = after[pairs[:, 0]] == after[pairs[:, 1]]
        remain = np.bincount(cut.chart[pairs[joined, 0]], minlength=cut.num_charts)
        length = np.bincount(owner, atlas.surface.length[edges], minlength=cut.num_charts)
        price = (remain + 0.05 * before) * length
        better = (before > 0) & (np.bincount(owner, minlength=cut.num_charts) > 0) & (price < least)
        if number == len(options) - 1:
            better &= 2 * stays > before
        for chart in np.flatnonzero(better).tolist():
            best[chart] = edges[owner == chart]
        stays[better], least[better] = remain[better], price[better]
    return np.concatenate([np.zeros(0, np.int64), *best.values()])
