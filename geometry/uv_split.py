"""Slits and splits of discs: where they run, and the same on the other side of a symmetric mesh."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from .uv_flatten import laplacian
from .uv_mesh import CutMesh, components
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
    score = np.where((before >= 0) & np.isfinite(distance), score * distance, -1.0)
    order = np.argsort(score, kind="stable")
    peak = np.full(cut.num_charts, -1, np.int64)
    peak[cut.vert_chart[order]] = order
    ends = peak[charts]
    ends = ends[score[ends] > 0]
    return path_edges(surface, cut, before, ends)


def _some(cut: CutMesh, charts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Faces of some charts, their vertices, and the faces in terms of those."""
    rows = np.flatnonzero(np.isin(cut.chart, charts))
    used, local = np.unique(cut.faces[rows], return_inverse=True)
    return rows, used, local.reshape(-1, 3)


def fiedler(
    surface: Surface,
    cut: CutMesh,
    start: Float[np.ndarray, "W"],
    weight: Float[np.ndarray, "F"],
    charts: Int[np.ndarray, "n"],
) -> Float[np.ndarray, "W"]:
    """Slowest vibration of some charts, if their faces weigh as much as given.

    Args:
        surface: the mesh.
        cut: its cut.
        start: a first guess.
        weight: mass of each face; where there is little, the field hardly changes.
        charts: numbers of the charts.

    Returns:
        Values at the vertices, of weighted mean zero and unit size in each of the charts; zero in
        others.

    Reference:
        Fiedler 1973; here the cotangent Laplacian with natural borders, by inverse iteration.
    """
    from scipy.sparse import diags

    out = np.zeros(len(cut.origin))
    rows, used, faces = _some(cut, charts)
    if len(rows) == 0:
        return out
    flat = surface.flat[rows]
    # rounding leaves excess below zero, and a flat chart has none: a little of the area joins it
    weight = np.maximum(weight[rows], 0.0) + 1e-6 * (flat[:, 0, 0] * flat[:, 1, 1]) + 1e-30
    mass = np.bincount(faces.reshape(-1), np.repeat(weight / 3, 3), minlength=len(used))
    matrix = laplacian(faces, len(used), flat, "cotangent")
    _, chart = np.unique(cut.vert_chart[used], return_inverse=True)
    total = np.maximum(np.bincount(chart, mass), 1e-300)
    shift = 1e-4 * mass / total[chart]
    # a chart without excess or area still needs a diagonal
    scale = float(matrix.diagonal().mean())
    factors = factorised((matrix + diags(shift + 1e-9 * max(scale, 1e-300))).tocsc())

    def unit(x: np.ndarray) -> np.ndarray:
        mean = np.bincount(chart, mass * x) / total
        x = x - mean[chart]
        size = np.bincount(chart, mass * x * x) / total
        x = np.divide(x, np.sqrt(size)[chart], out=x, where=size[chart] > 0)
        return np.clip(x, -1e3, 1e3)

    x = unit(start[used])
    for _ in range(_POWER_STEPS):
        x = unit(factors.solve(mass * x))
    out[used] = x
    return out


def split_paths(
    surface: Surface,
    cut: CutMesh,
    field: Float[np.ndarray, "W"],
    weight: Float[np.ndarray, "F"],
    charts: Int[np.ndarray, "n"],
) -> Int[np.ndarray, "m"]:
    """Edges of a path of least cost across each of some discs, along a zero line of a field.

    Where the field is zero along several lines, the one that halves the weight best is followed.
    A path that halves it much worse than the line itself gives way to the line.

    Args:
        surface: the mesh.
        cut: its cut; the charts are discs.
        field: values at the vertices of the cut mesh.
        weight: of each face.
        charts: numbers of the charts.

    Returns:
        Edge indices; a chart without an inner edge gets none.
    """
    lines = [line for line in _zero_lines(cut, field, weight, charts) if line is not None]
    edges = _paths(surface, cut, field, [line for line in lines if line.ends is not None])
    return _mended(cut, edges, lines, weight)


def _paths(surface: Surface, cut: CutMesh, field: np.ndarray, lines: "list[_Line]") -> np.ndarray:
    """Edges of the cheapest paths between the border near both ends of each line."""
    if not lines:
        return np.zeros(0, np.int64)
    follow = np.full(len(cut.origin), -1, np.int64)
    follow[cut.border[:, 0]] = cut.border[:, 1]
    back = np.full(len(cut.origin), -1, np.int64)
    back[cut.border[:, 1]] = cut.border[:, 0]
    size = np.bincount(cut.vert_chart[cut.border[:, 0]], minlength=cut.num_charts)
    starts, stops = [], []
    for line in lines:
        reach = max(1, int(size[line.chart]) // 40)
        near_first, near_last = (_along(follow, back, end, reach) for end in line.ends or ())
        near_last = near_last[~np.isin(near_last, near_first)]
        starts.append(np.setdiff1d(near_first, near_last))
        stops.append(near_last)
    begin = np.concatenate(starts)
    distance, before = _shortest(_across(surface, cut, field, begin), begin)
    best = [e[int(np.argmin(distance[e]))] for e in stops if len(e)]
    reached = np.array([v for v in best if np.isfinite(distance[v])], np.int64)
    return path_edges(surface, cut, before, reached)


def _mended(
    cut: CutMesh, edges: np.ndarray, lines: "list[_Line]", weight: np.ndarray
) -> np.ndarray:
    """Paths, each replaced by its line where it leaves a much larger piece of the chart whole."""
    owner = cut.chart[np.maximum(cut.edges.face_pairs[edges, 0], 0)]
    piece = charts_after(cut, edges)
    mass = np.bincount(piece, weight)
    of_piece = np.zeros(len(mass), np.int64)
    of_piece[piece] = cut.chart
    whole = np.bincount(cut.chart, weight, minlength=cut.num_charts)
    largest = np.zeros(cut.num_charts)
    np.maximum.at(largest, of_piece, mass)
    out = []
    for line in lines:
        lighter = whole[line.chart] - largest[line.chart]
        good = line.ends is not None and lighter >= 0.5 * line.balance
        out.append(edges[owner == line.chart] if good else line.edges)
    return np.concatenate([np.zeros(0, np.int64), *out])


def sign_changes(cut: CutMesh, field: Float[np.ndarray, "W"]) -> Int[np.ndarray, "n"]:
    """Uncut edges between faces above zero and faces below it.

    Args:
        cut: the cut mesh.
        field: values at its vertices.

    Returns:
        Edge indices.
    """
    above = field[cut.faces].mean(1) > 0
    uncut = np.flatnonzero(~cut.seams)
    pairs = cut.edges.face_pairs[uncut]
    return uncut[above[pairs[:, 0]] != above[pairs[:, 1]]]


def charts_after(cut: CutMesh, edges: Int[np.ndarray, "n"]) -> Int[np.ndarray, "F"]:
    """Chart of each face once some more edges are cut.

    Args:
        cut: the cut mesh.
        edges: edge indices.

    Returns:
        Chart numbers.
    """
    seams = cut.seams.copy()
    seams[edges] = True
    pairs = cut.edges.face_pairs[~seams]
    return components(len(cut.chart), pairs[:, 0], pairs[:, 1])


@dataclass(frozen=True, eq=False)
class _Line:
    """Edges between faces above and below zero that part a disc in two."""

    chart: int
    ends: tuple[int, int] | None
    """The two border vertices at its ends; none where it touches the border oftener."""
    edges: np.ndarray
    balance: float
    """Weight on its lighter side."""


def _along(follow: np.ndarray, back: np.ndarray, start: int, reach: int) -> np.ndarray:
    """Border vertices up to some steps before and after one."""
    out, ahead, behind = [start], start, start
    for _ in range(reach):
        ahead, behind = int(follow[ahead]), int(back[behind])
        out += [ahead, behind]
    return np.unique(out)


def _zero_lines(
    cut: CutMesh, field: np.ndarray, weight: np.ndarray, charts: np.ndarray
) -> list[_Line | None]:
    """The line that halves the weight of each chart best."""
    above = field[cut.faces].mean(1) > 0
    uncut = np.flatnonzero(~cut.seams)
    pairs = cut.edges.face_pairs[uncut]
    same = above[pairs[:, 0]] == above[pairs[:, 1]]
    island = components(len(above), pairs[same, 0], pairs[same, 1])
    mass = np.bincount(island, weight)
    order = np.argsort(cut.chart[pairs[~same, 0]], kind="stable")
    line_edges, line_pairs = uncut[~same][order], island[pairs[~same]][order]
    chart = cut.chart[pairs[~same, 0]][order]
    out: list[_Line | None] = []
    for number in charts:
        some = slice(*np.searchsorted(chart, [number, number + 1]))
        out.append(_best_line(cut, int(number), line_edges[some], line_pairs[some], mass))
    return out


def _best_line(
    cut: CutMesh, chart: int, edges: np.ndarray, pairs: np.ndarray, mass: np.ndarray
) -> _Line | None:
    if len(edges) == 0:
        return None
    low, high = pairs.min(1), pairs.max(1)
    key, which = np.unique(low * len(mass) + high, return_inverse=True)
    tree = np.stack([key // len(mass), key % len(mass)], 1)
    balance = _balance(tree, mass)
    half = cut.edges.sides[edges, 0]
    a = cut.faces.reshape(-1)[half]
    b = cut.faces.reshape(-1)[half - half % 3 + (half + 1) % 3]
    order = np.argsort(-balance, kind="stable")
    top = float(balance[order[0]])
    for line in order[balance[order] >= max(0.5 * top, 1e-300)]:
        own = np.concatenate([a[which == line], b[which == line]])
        verts, degree = np.unique(own, return_counts=True)
        ends = verts[(degree == 1) & (cut.loop[verts] >= 0)]
        if len(ends) == 2:
            some = edges[which == line]
            return _Line(chart, (int(ends[0]), int(ends[1])), some, float(balance[line]))
    if top > 0:
        return _Line(chart, None, edges[which == order[0]], top)
    nodes, local = np.unique(pairs, return_inverse=True)
    return _around(chart, edges, local.reshape(-1, 2), mass[nodes])


def _around(chart: int, edges: np.ndarray, pairs: np.ndarray, mass: np.ndarray) -> _Line:
    """The line around the heaviest of what is left of a disc without its heaviest island.

    Both sides are whole, so a field that is mere noise makes two charts of one, not hundreds.
    """
    core = int(mass.argmax())
    free = (pairs != core).all(1)
    group = components(len(mass), pairs[free, 0], pairs[free, 1])
    weight = np.bincount(group, mass)
    weight[group[core]] = -1.0
    inside = group == int(weight.argmax())
    balance = min(float(mass[inside].sum()), float(mass[~inside].sum()))
    return _Line(chart, None, edges[inside[pairs[:, 0]] != inside[pairs[:, 1]]], balance)


def _balance(tree: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """For each edge of a small tree the mass on its lighter side."""
    out = np.zeros(len(tree))
    nodes, local = np.unique(tree, return_inverse=True)
    local = local.reshape(-1, 2)
    for i in range(len(tree)):
        others = np.delete(local, i, 0)
        side = components(len(nodes), others[:, 0], others[:, 1])
        here = mass[nodes[side == side[local[i, 0]]]].sum()
        there = mass[nodes[side == side[local[i, 1]]]].sum()
        out[i] = min(here, there) if side[local[i, 0]] != side[local[i, 1]] else 0.0
    return out


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


def separators(
    surface: Surface, cut: CutMesh, pairs: Int[np.ndarray, "n 2"], field: Float[np.ndarray, "W"]
) -> Float[np.ndarray, "W"]:
    """A field that is positive on one face of each pair and negative on the other.

    Args:
        surface: the mesh.
        cut: its cut.
        pairs: faces of one chart that a path has to separate.
        field: which of two faces is the high one, at the vertices.

    Returns:
        Values at the vertices; zero in charts of no pair.
    """
    from scipy.sparse import diags

    value = field[cut.faces].mean(1)
    swap = value[pairs[:, 0]] < value[pairs[:, 1]]
    high = np.unique(np.where(swap, pairs[:, 1], pairs[:, 0]))
    low = np.unique(np.where(swap, pairs[:, 0], pairs[:, 1]))
    rows, used, local = _some(cut, np.unique(cut.chart[pairs[:, 0]]))
    matrix = laplacian(local, len(used), surface.flat[rows], "uniform")
    count = len(cut.origin)
    held = np.full(count, 1e-6)
    pull = np.zeros(count)
    for faces, sign in ((high, 1.0), (low, -1.0)):
        np.add.at(held, cut.faces[faces].reshape(-1), 10.0)
        np.add.at(pull, cut.faces[faces].reshape(-1), sign * 10.0)
    out = np.zeros(count)
    out[used] = factorised((matrix + diags(held[used])).tocsc()).solve(pull[used])
    return out
