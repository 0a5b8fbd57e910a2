"""Seams of a symmetric mesh brought to its other side."""

import numpy as np
from jaxtyping import Bool, Float, Int

from .uv_mesh import CutMesh
from .uv_seams import Surface, _shortest, edge_index, path_edges
from .uv_split import charts_after

_SLIVER = 0.03
"""Share of a chart below which what mirrored seams leave between them is no chart of its own."""
_KNOWN = 0.9
"""Share of the vertices of a chart that must have an image for the chart to be one."""
_LAYERS = 10


def mirrored_edges(surface: Surface, some: Int[np.ndarray, "n"]) -> Int[np.ndarray, "m"]:
    """Edges at the mirror image of some edges; where there is none, a short way around.

    Args:
        surface: a mesh with a mirror plane; without one there is no image.
        some: edge indices.

    Returns:
        Edge indices, each once.
    """
    if surface.mirror is None or len(some) == 0:
        return np.zeros(0, np.int64)
    image = np.sort(surface.mirror[surface.edges.verts[some]], 1)
    image = image[image[:, 0] != image[:, 1]]
    base = len(surface.verts)
    known = surface.edges.verts[:, 0] * base + surface.edges.verts[:, 1]
    there = np.isin(image[:, 0] * base + image[:, 1], known)
    pairs = [image[there], *(_way_around(surface, a, b) for a, b in image[~there].tolist())]
    return edge_index(surface.edges, np.concatenate(pairs))


def _way_around(surface: Surface, a: int, b: int) -> np.ndarray:
    """The two edges over the common neighbour that makes the shortest way, if there is one."""
    ends = surface.edges.verts
    next_a = ends[(ends == a).any(1)].sum(1) - a
    next_b = ends[(ends == b).any(1)].sum(1) - b
    common = np.intersect1d(next_a, next_b)
    if len(common) == 0:
        return np.zeros((0, 2), np.int64)
    places = surface.verts
    way = np.linalg.norm(places[common] - places[a], axis=1)
    way = way + np.linalg.norm(places[common] - places[b], axis=1)
    middle = int(common[way.argmin()])
    return np.sort(np.array([[a, middle], [middle, b]]), 1)


def symmetric_edges(
    surface: Surface, cut: CutMesh, some: Int[np.ndarray, "n"]
) -> Int[np.ndarray, "m"]:
    """The half of some edges that is longer, and its mirror image, without slivers between them.

    Args:
        surface: a mesh; without a mirror plane the edges stay as they are.
        cut: its cut; the edges are not cut yet.
        some: edge indices.

    Returns:
        Edge indices, each once.
    """
    if surface.side is None or len(some) == 0:
        return some
    place = surface.side[surface.edges.verts[some]].mean(1)
    near = 1e-3 * float(surface.length.mean())
    left, right = some[place > near], some[place < -near]
    longer = left if surface.length[left].sum() >= surface.length[right].sum() else right
    middle = some[np.abs(place) <= near]
    both = np.unique(np.concatenate([longer, middle, mirrored_edges(surface, longer)]))
    return _without_slivers(surface, cut, both[~cut.seams[both]])


def _without_slivers(surface: Surface, cut: CutMesh, some: np.ndarray) -> np.ndarray:
    """Edges between small pieces and their longest neighbours left out, the plane put in."""
    area, pairs = surface.rest.area, surface.edges.face_pairs
    piece = charts_after(cut, some)
    whole = np.bincount(cut.chart, area, minlength=cut.num_charts)
    tiny = np.bincount(piece, area)[piece] < _SLIVER * whole[cut.chart]
    if surface.side is None or not tiny.any():
        return some
    right = surface.side[surface.faces].mean(1) > 0
    inner = np.flatnonzero(~cut.seams)
    a, b = pairs[inner].T
    middle = inner[tiny[a] & tiny[b] & (right[a] != right[b])]
    some = np.union1d(some, middle)
    piece = charts_after(cut, some)
    gone = np.zeros(len(cut.seams), bool)
    small = np.zeros(int(piece.max()) + 1, bool)
    small[piece[tiny]] = True
    for number in np.flatnonzero(small):
        own = piece[pairs[some]] == number
        rows = np.flatnonzero(own.sum(1) == 1)
        other = piece[pairs[some[rows]]][~own[rows]]
        shared = np.bincount(other, surface.length[some[rows]] * ~small[other])
        if shared.any():
            gone[some[rows[other == shared.argmax()]]] = True
    return some[~gone[some]]


def symmetric_start(surface: Surface, seams: Bool[np.ndarray, "E"]) -> Bool[np.ndarray, "E"]:
    """Closed spheres that are their own mirror image slit along a path that is its own too.

    Args:
        surface: the mesh.
        seams: edges that are cut already.

    Returns:
        Edges to cut.
    """
    cut = CutMesh.of(surface.edges, seams)
    mates = chart_mates(surface, cut)
    seams = seams.copy()
    if surface.mirror is None:
        return seams
    for chart in np.flatnonzero((cut.euler == 2) & (mates == np.arange(len(mates)))):
        some = np.flatnonzero(cut.vert_chart == chart)
        graph = surface.graph(cut)
        distance, _ = _shortest(graph, some[:1])
        begin = some[[distance[some].argmax()]]
        image = some[cut.origin[some] == surface.mirror[cut.origin[begin[0]]]]
        distance, before = _shortest(graph, begin)
        # a vertex near the plane has its image beside it: a slit has to reach farther than that
        image = image[distance[image] > 0.2 * distance[some].max()]
        path = path_edges(surface, cut, before, image)
        seams[symmetric_edges(surface, cut, path)] = True
    return seams


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
    key, votes = np.unique(cut.chart * count + cut.chart[surface.face_image], return_counts=True)
    order = np.lexsort((-votes, key // count))
    _, first = np.unique(key[order] // count, return_index=True)
    best, most = key[order][first] % count, votes[order][first]
    size = np.bincount(cut.chart, minlength=count)
    good = (most > 0.7 * size) & (best[best] == np.arange(count))
    mates[good] = best[good]
    return mates


def image_vertices(
    surface: Surface, cut: CutMesh, mates: Int[np.ndarray, "C"]
) -> tuple[Int[np.ndarray, "W"], Bool[np.ndarray, "C"]]:
    """Where a chart can take the coordinates of its vertices from: its image of a lower number.

    Args:
        surface: the mesh.
        cut: its cut.
        mates: of `chart_mates`.

    Returns:
        The vertex of the cut mesh at the mirror image of each, −1 for none; and the charts that
        have such an image, but for a few vertices at faces that have none.
    """
    out = np.full(len(cut.origin), -1, np.int64)
    lead = mates[cut.chart]
    rows = np.flatnonzero((lead >= 0) & (lead < cut.chart))
    vert = cut.faces[rows].reshape(-1)
    corner = surface.corner_image[rows].reshape(-1)
    image = cut.faces.reshape(-1)[corner]
    right = (corner >= 0) & (cut.vert_chart[image] == np.repeat(lead[rows], 3))
    out[vert[right]] = image[right]
    # an edge that is cut on one side alone: one vertex has two images, or is that of two
    torn = np.zeros(cut.num_charts, bool)
    torn[cut.vert_chart[vert[right & (out[vert] != image)]]] = True
    some = np.flatnonzero(out >= 0)
    torn[cut.vert_chart[some[np.bincount(out[some], minlength=len(out))[out[some]] > 1]]] = True
    known = np.bincount(cut.vert_chart, out >= 0, minlength=cut.num_charts)
    size = np.bincount(cut.vert_chart, minlength=cut.num_charts)
    return out, ~torn & (known > _KNOWN * size)


def extended(
    surface: Surface, cut: CutMesh, uv: Float[np.ndarray, "W 2"], known: Bool[np.ndarray, "W"]
) -> Float[np.ndarray, "W 2"]:
    """Coordinates of some vertices by those beside them and the shapes of the faces between.

    Args:
        surface: the mesh.
        cut: its cut.
        uv: coordinates of its vertices.
        known: which of them are right.

    Returns:
        Coordinates; a vertex far from those that are known stays.
    """
    z = uv[:, 0] + 1j * uv[:, 1]
    rows = np.flatnonzero(~known[cut.faces].all(1))
    flat = surface.flat[rows]
    rest = np.pad(flat[:, 0] + 1j * flat[:, 1], ((0, 0), (1, 0)))
    for _ in range(_LAYERS):
        total, number = np.zeros(len(z), complex), np.zeros(len(z))
        for k in range(3):
            ends = cut.faces[rows][:, [k, k - 2, k - 1]].T
            some = ~known[ends[0]] & known[ends[1]] & known[ends[2]]
            (p, q, r), (a, b, c) = rest[some][:, [k, k - 2, k - 1]].T, ends[:, some]
            np.add.at(total, a, z[b] + (p - q) / (r - q) * (z[c] - z[b]))
            np.add.at(number, a, 1)
        fresh = number > 0
        if not fresh.any():
            break
        z[fresh] = total[fresh] / number[fresh]
        known = known | fresh
    return np.stack([z.real, z.imag], 1)


def seam_symmetry(surface: Surface, seams: Bool[np.ndarray, "E"]) -> float:
    """Share of the seams, by length, whose mirror image is a seam too.

    Args:
        surface: the mesh.
        seams: mask of its edges.

    Returns:
        A share in [0, 1]; 1 without seams, NaN for a mesh without a mirror plane.
    """
    if surface.mirror is None:
        return float("nan")
    image = np.sort(surface.mirror[surface.edges.verts], 1)
    base = len(surface.verts)
    known = surface.edges.verts[:, 0] * base + surface.edges.verts[:, 1]
    both = np.isin(image[:, 0] * base + image[:, 1], known[seams])
    total = float(surface.length[seams].sum())
    return float(surface.length[seams & both].sum()) / total if total > 0 else 1.0
