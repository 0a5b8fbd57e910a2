"""Slits and splits of discs: where they run, and the same on the other side of a symmetric mesh."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from .uv_energy import flat_triangles
from .uv_flatten import laplacian
from .uv_mesh import CutMesh
from .uv_newton import factorised
from .uv_seams import Surface, _shortest, path_edges

_SMOOTHING = 4
_POWER_STEPS = 12


def smoothed(cut: CutMesh, values: Float[np.ndarray, "F"]) -> Float[np.ndarray, "W"]:
    """Values of the faces, spread to the vertices of the cut mesh and a few edges on.

    Args:
        cut: the cut mesh.
        values: one per face.

    Returns:
        One per vertex.
    """
    count = len(cut.origin)
    flat = cut.faces.reshape(-1)
    degree = np.bincount(flat, minlength=count)
    for _ in range(_SMOOTHING):
        vertex = np.bincount(flat, np.repeat(values, 3), minlength=count) / degree
        values = vertex[cut.faces].mean(1)
    return np.bincount(flat, np.repeat(values, 3), minlength=count) / degree


def tip_slits(
    surface: Surface, cut: CutMesh, density: Float[np.ndarray, "F"], charts: Int[np.ndarray, "n"]
) -> Int[np.ndarray, "m"]:
    """Edges of a slit in each of some charts, from the peak of a density to the border.

    Args:
        surface: the mesh.
        cut: its cut; the charts are discs.
        density: excess energy per area of each face.
        charts: numbers of the charts.

    Returns:
        Edge indices.
    """
    distance, before = _shortest(surface.graph(cut), np.unique(cut.border))
    score = smoothed(cut, density)
    score = np.where((before >= 0) & np.isfinite(distance), score, -1.0)
    order = np.argsort(score, kind="stable")
    peak = np.full(cut.num_charts, -1, np.int64)
    peak[cut.vert_chart[order]] = order
    ends = peak[charts]
    ends = ends[score[ends] > 0]
    if surface.mirror is not None:
        ends = np.union1d(ends, _mirrored_ends(surface.mirror, cut, ends))
    return path_edges(surface, cut, before, ends)


def _mirrored_ends(mirror: np.ndarray, cut: CutMesh, ends: np.ndarray) -> np.ndarray:
    """Inner vertices of the cut mesh at the mirror image of some, none next to where it began."""
    inside = np.full(len(mirror), -1, np.int64)
    inner = np.flatnonzero(cut.loop < 0)
    inside[cut.origin[inner]] = inner
    found = inside[mirror[cut.origin[ends]]]
    return found[found >= 0]


def chart_mates(surface: Surface, cut: CutMesh) -> Int[np.ndarray, "C"]:
    """The chart that is the mirror image of each one, itself if it is its own, −1 for none.

    Args:
        surface: the mesh.
        cut: its cut.

    Returns:
        Chart numbers.
    """
    count = cut.num_charts
    mates = np.full(count, -1, np.int64)
    if surface.mirror is None:
        return mates
    image = _mirrored_faces(surface)
    votes = np.zeros(count * count, np.int64)
    known = image >= 0
    np.add.at(votes, cut.chart[known] * count + cut.chart[image[known]], 1)
    votes = votes.reshape(count, count)
    best = votes.argmax(1)
    size = np.bincount(cut.chart, minlength=count)
    good = (votes[np.arange(count), best] > 0.7 * size) & (best[best] == np.arange(count))
    mates[good] = best[good]
    return mates


def _mirrored_faces(surface: Surface) -> np.ndarray:
    """A face at the mirror image of each face: one that shares most of its mirrored corners."""
    from scipy.spatial import cKDTree

    mirror = surface.mirror
    if mirror is None:
        return np.full(len(surface.faces), -1, np.int64)
    centre = surface.verts[surface.faces].mean(1)
    image = surface.verts[mirror[surface.faces]].mean(1)
    return cKDTree(centre).query(image)[1]


def fiedler(
    surface: Surface, cut: CutMesh, start: Float[np.ndarray, "W"], mates: Int[np.ndarray, "C"]
) -> Float[np.ndarray, "W"]:
    """Slowest vibration of each chart, with the symmetry of the mesh.

    Args:
        surface: the mesh.
        cut: its cut.
        start: a first guess.
        mates: mirror image of each chart.

    Returns:
        Values at the vertices, of mean zero and unit size in every chart.

    Reference:
        Fiedler 1973; here the cotangent Laplacian with natural borders, by inverse iteration.
    """
    from scipy.sparse import diags

    flat = flat_triangles(surface.verts, surface.faces)
    double = flat[:, 0, 0] * flat[:, 1, 1]
    mass = np.bincount(cut.faces.reshape(-1), np.repeat(double / 6, 3), minlength=len(cut.origin))
    matrix = laplacian(cut, flat, "cotangent")
    total = np.bincount(cut.vert_chart, mass, minlength=cut.num_charts)
    shift = 1e-4 * mass / total[cut.vert_chart]
    factors = factorised((matrix + diags(shift)).tocsc())

    def unit(x: np.ndarray) -> np.ndarray:
        mean = np.bincount(cut.vert_chart, mass * x, minlength=len(total)) / total
        x = x - mean[cut.vert_chart]
        size = np.bincount(cut.vert_chart, mass * x * x, minlength=len(total)) / total
        return x / np.sqrt(np.maximum(size, 1e-300))[cut.vert_chart]

    x = unit(start)
    for _ in range(_POWER_STEPS):
        x = unit(factors.solve(mass * x))
    return unit(_symmetrised(surface, cut, x, mates))


def _symmetrised(surface: Surface, cut: CutMesh, x: np.ndarray, mates: np.ndarray) -> np.ndarray:
    """The field of a chart copied to its mirror image; its own image added where it is its own."""
    if surface.mirror is None or not (mates >= 0).any():
        return x
    count, base = cut.num_charts, len(surface.verts)
    key = cut.vert_chart * base + cut.origin
    order = np.argsort(key, kind="stable")
    wanted = np.where(mates >= 0, mates, 0)[cut.vert_chart] * base + surface.mirror[cut.origin]
    at = np.minimum(np.searchsorted(key[order], wanted), len(order) - 1)
    found = (key[order[at]] == wanted) & (mates >= 0)[cut.vert_chart]
    image = np.where(found, x[order[at]], np.nan)
    own = (mates == np.arange(count))[cut.vert_chart]
    copy = (mates < np.arange(count))[cut.vert_chart] & (mates >= 0)[cut.vert_chart]
    both = own & found
    agree = np.bincount(cut.vert_chart[both], (x * image)[both], minlength=count)
    sign = np.where(agree >= 0, 1.0, -1.0)[cut.vert_chart]
    out = np.where(both, (x + sign * np.nan_to_num(image)) / 2, x)
    # a copied chart whose image is not known at a vertex keeps its own value, by its own sign
    pair = copy & found
    agree = np.bincount(cut.vert_chart[pair], (x * image)[pair], minlength=count)
    sign = np.where(agree >= 0, 1.0, -1.0)[cut.vert_chart]
    return np.where(copy, np.where(found, image, sign * x), out)


def split_paths(
    surface: Surface,
    cut: CutMesh,
    field: Float[np.ndarray, "W"],
    level: Float[np.ndarray, "C"],
    charts: Int[np.ndarray, "n"],
) -> Int[np.ndarray, "m"]:
    """Edges of a path across each of some discs, near the level of a field and of least cost.

    Args:
        surface: the mesh.
        cut: its cut; the charts are discs.
        field: values at the vertices of the cut mesh.
        level: the value of each chart along which to cut.
        charts: numbers of the charts.

    Returns:
        Edge indices; a chart without an inner edge gets none.
    """
    field = field - level[cut.vert_chart]
    wanted = np.zeros(cut.num_charts, bool)
    wanted[charts] = True
    starts, ends = [], []
    for ring in cut.loops():
        if wanted[cut.vert_chart[ring[0]]]:
            pair = _crossings(field[ring])
            if pair is not None:
                starts.append(ring[pair[0]])
                ends.append(ring[pair[1]])
    if not starts:
        return np.zeros(0, np.int64)
    first = np.concatenate(starts)
    distance, before = _shortest(_across(surface, cut, field, first), first)
    stops = [e[int(np.argmin(distance[e]))] for e in ends]
    stops = np.array([s for s in stops if np.isfinite(distance[s])], np.int64)
    return path_edges(surface, cut, before, stops)


def _across(surface: Surface, cut: CutMesh, field: np.ndarray, first: np.ndarray) -> Any:
    """The graph in which no path touches the border on its way."""
    ends = surface.edges.verts
    near = np.zeros(len(surface.verts))
    np.maximum.at(near, cut.origin, np.abs(field))
    cost = surface.cost * (1 + 4 * near[ends].mean(1) ** 2)
    graph = surface.graph(cut, cost).tocoo()
    begin = np.zeros(len(cut.origin), bool)
    begin[first] = True
    border = cut.loop >= 0
    keep = (~border | begin)[graph.row] & ~begin[graph.col]
    from scipy.sparse import coo_matrix

    values = (graph.data[keep], (graph.row[keep], graph.col[keep]))
    return coo_matrix(values, graph.shape).tocsr()


def _crossings(values: Float[np.ndarray, "n"]) -> tuple[np.ndarray, np.ndarray] | None:
    """Places of a ring at which a path may begin and end: around two far changes of sign."""
    count = len(values)
    positive = values > 0
    change = np.flatnonzero(positive != np.roll(positive, -1))
    if count < 4:
        return None
    if len(change) < 2:  # the level misses the border: cut between two opposite places
        change = np.array([0, count // 2])
    gap = np.abs(change[:, None] - change[None])
    gap = np.minimum(gap, count - gap)
    i, j = np.unravel_index(int(gap.argmax()), gap.shape)
    reach = max(1, count // 16, 1)
    reach = min(reach, (int(gap[i, j]) - 1) // 2)
    window = np.arange(-reach, reach + 1)
    return (change[i] + window) % count, (change[j] + window) % count


def level_of(
    cut: CutMesh, field: Float[np.ndarray, "W"], weight: Float[np.ndarray, "F"]
) -> Float[np.ndarray, "C"]:
    """Weighted median of a field in each chart.

    Args:
        cut: the cut mesh.
        field: values at its vertices.
        weight: of each face.

    Returns:
        One value per chart.
    """
    value = field[cut.faces].mean(1)
    order = np.lexsort((value, cut.chart))
    chart, value, weight = cut.chart[order], value[order], weight[order]
    total = np.bincount(chart, weight, minlength=cut.num_charts)
    start = np.concatenate([[0.0], np.cumsum(total)[:-1]])
    share = (np.cumsum(weight) - start[chart]) / np.maximum(total[chart], 1e-300)
    reached = np.flatnonzero(share >= 0.5)
    _, first = np.unique(chart[reached], return_index=True)
    return value[reached[first]]


def seam_mask(count: int, *groups: Int[np.ndarray, "n"]) -> Bool[np.ndarray, "E"]:
    """Mask of some edges.

    Args:
        count: number of edges.
        *groups: their indices.

    Returns:
        The mask.
    """
    mask = np.zeros(count, bool)
    for group in groups:
        mask[group] = True
    return mask
