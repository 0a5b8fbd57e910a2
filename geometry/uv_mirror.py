"""Seams of a symmetric mesh brought to its other side."""

import numpy as np
from jaxtyping import Bool, Int

from .uv_mesh import CutMesh
from .uv_seams import Surface, edge_index


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


def symmetric_edges(surface: Surface, some: Int[np.ndarray, "n"]) -> Int[np.ndarray, "m"]:
    """The half of some edges that is longer, and its mirror image; a path that is its own stays.

    Args:
        surface: a mesh; without a mirror plane the edges stay as they are.
        some: edge indices.

    Returns:
        Edge indices, each once.
    """
    if surface.side is None or len(some) == 0 or _own_image(surface, some):
        return some
    place = surface.side[surface.edges.verts[some]].mean(1)
    near = 1e-3 * float(surface.length.mean())
    left, right = some[place > near], some[place < -near]
    longer = left if surface.length[left].sum() >= surface.length[right].sum() else right
    middle = some[np.abs(place) <= near]
    return np.unique(np.concatenate([longer, middle, mirrored_edges(surface, longer)]))


def _own_image(surface: Surface, some: np.ndarray) -> bool:
    """Whether the image of most vertices of some edges lies within an edge or two of them."""
    from scipy.spatial import KDTree

    used = np.unique(surface.edges.verts[some])
    places = surface.verts[used]
    image = surface.verts[np.zeros(0, np.int64) if surface.mirror is None else surface.mirror[used]]
    distance = KDTree(places).query(image)[0]
    return bool((distance <= 1.5 * surface.length[some].mean()).mean() > 0.8)


def chart_mates(surface: Surface, cut: CutMesh) -> Int[np.ndarray, "C"]:
    """The chart that is the mirror image of each one, itself if it is its own, −1 for none.

    Args:
        surface: the mesh.
        cut: its cut.

    Returns:
        Chart numbers.
    """
    from scipy.spatial import KDTree

    count = cut.num_charts
    mates = np.full(count, -1, np.int64)
    if surface.mirror is None:
        return mates
    centre = surface.verts[surface.faces].mean(1)
    image = KDTree(centre).query(surface.verts[surface.mirror[surface.faces]].mean(1))[1]
    key, votes = np.unique(cut.chart * count + cut.chart[image], return_counts=True)
    order = np.lexsort((-votes, key // count))
    _, first = np.unique(key[order] // count, return_index=True)
    best, most = key[order][first] % count, votes[order][first]
    size = np.bincount(cut.chart, minlength=count)
    good = (most > 0.7 * size) & (best[best] == np.arange(count))
    mates[good] = best[good]
    return mates


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
