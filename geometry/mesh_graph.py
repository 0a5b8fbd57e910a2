"""Neighbourhoods of triangle meshes as weighted graphs, with numpy alone.

Vertices at the same place count as one, so a mesh that was cut along texture seams stays whole.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from .errors import InputError


@dataclass(frozen=True, eq=False)
class MeshGraph:
    """An undirected graph over the faces or the vertices of a mesh.

    Attributes:
        edges: [E, 2] pairs of nodes, each pair once, smaller node first.
        weights: [E] length of the border that a pair shares, metres.
        mass: [N] area of each node, square metres.
    """

    edges: Int[np.ndarray, "e 2"]
    weights: Float[np.ndarray, "e"]
    mass: Float[np.ndarray, "n"]

    @property
    def num_nodes(self) -> int:
        """Number of nodes."""
        return len(self.mass)


def check_mesh(verts: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> None:
    """Refuse vertices that are not finite and faces that name none of them.

    Args:
        verts: vertices.
        faces: vertex indices.

    Raises:
        InputError: NaN or infinite vertices, or indices out of range.
    """
    if not np.isfinite(verts).all():
        bad = int((~np.isfinite(verts).all(1)).sum())
        raise InputError(f"verts: expected finite numbers, found {bad} vertices with others; clean")
    if len(faces) and (faces.min() < 0 or faces.max() >= len(verts)):
        raise InputError(
            f"faces: expected indices in 0..{len(verts) - 1}, found {faces.min()}..{faces.max()}; "
            "use the faces that belong to these vertices"
        )


def weld_by_place(verts: Float[np.ndarray, "v 3"]) -> Int[np.ndarray, "v"]:
    """The first vertex at the place of each vertex; places are compared exactly.

    Args:
        verts: vertices.

    Returns:
        One vertex index per vertex, at most its own.

    >>> weld_by_place(np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 0]]))
    array([0, 1, 0])
    """
    if not len(verts):
        return np.zeros(0, np.int64)
    _, first, inverse = np.unique(verts + 0.0, axis=0, return_index=True, return_inverse=True)
    return first[inverse.reshape(-1)]


def face_areas(
    verts: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "f"]:
    """Area of each face.

    Args:
        verts: vertices, metres.
        faces: vertex indices.

    Returns:
        Square metres.

    >>> face_areas(np.eye(3), np.array([[0, 1, 2]])).round(3)
    array([0.866])
    """
    a, b, c = np.moveaxis(verts[faces], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _half_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sorted vertex pairs of the three edges of each face, and their faces."""
    pairs = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    return np.sort(pairs, 1), np.repeat(np.arange(len(faces)), 3)


def _summed(pairs: np.ndarray, weights: np.ndarray, mass: np.ndarray) -> "MeshGraph":
    """Graph of node pairs, repeated pairs added up, self-pairs dropped."""
    keep = pairs[:, 0] != pairs[:, 1]
    pairs, weights = np.sort(pairs[keep], 1), weights[keep]
    if not len(pairs):
        return MeshGraph(np.zeros((0, 2), np.int64), np.zeros(0), mass)
    edges, inverse = np.unique(pairs, axis=0, return_inverse=True)
    total = np.bincount(inverse.reshape(-1), weights, len(edges))
    return MeshGraph(edges.astype(np.int64), total, mass)


def face_graph(verts: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> MeshGraph:
    """Faces as nodes, joined where they share an edge; a weight is the length of the edge.

    Args:
        verts: vertices, metres.
        faces: vertex indices.

    Returns:
        The graph; three or more faces at one edge are joined in a chain.

    Raises:
        InputError: vertices that are not finite, or indices out of range.

    >>> square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    >>> face_graph(square, np.array([[0, 1, 2], [0, 2, 3]])).edges
    array([[0, 1]])
    """
    check_mesh(verts, faces)
    pairs, face = _half_edges(weld_by_place(verts)[faces])
    order = np.lexsort((face, pairs[:, 1], pairs[:, 0]))
    pairs, face = pairs[order], face[order]
    same = (pairs[1:] == pairs[:-1]).all(1) & (pairs[1:, 0] != pairs[1:, 1])
    joined = np.stack([face[:-1][same], face[1:][same]], 1)
    ends = pairs[1:][same]
    length = np.linalg.norm(verts[ends[:, 0]] - verts[ends[:, 1]], axis=1)
    return _summed(joined, length, face_areas(verts, faces))


def vertex_graph(verts: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> MeshGraph:
    """Vertices as nodes, joined by the edges of faces; a weight is the border between their cells.

    The cell of a vertex is a third of its faces, bounded by lines from centroids to edge midpoints.
    Vertices at one place are joined by a weight that no other reaches.

    Args:
        verts: vertices, metres.
        faces: vertex indices.

    Returns:
        The graph.

    Raises:
        InputError: vertices that are not finite, or indices out of range.

    >>> vertex_graph(np.eye(3), np.array([[0, 1, 2]])).edges.tolist()
    [[0, 1], [0, 2], [1, 2]]
    """
    check_mesh(verts, faces)
    pairs, face = _half_edges(faces)
    centre = verts[faces].mean(1)[face] if len(faces) else np.zeros((0, 3))
    wall = np.linalg.norm(verts[pairs].mean(1) - centre, axis=1)
    mass = np.zeros(len(verts))
    np.add.at(mass, faces, face_areas(verts, faces)[:, None] / 3)
    first = weld_by_place(verts)
    twins = np.flatnonzero(first != np.arange(len(verts)))
    glue = np.stack([first[twins], twins], 1)
    strong = np.full(len(twins), 1e3 * (wall.sum() + 1.0))
    return _summed(np.concatenate([pairs, glue]), np.concatenate([wall, strong]), mass)


def components(
    num_nodes: int, edges: Int[np.ndarray, "e 2"], joined: Bool[np.ndarray, "e"] | None = None
) -> Int[np.ndarray, "n"]:
    """Connected component of each node, named by its smallest node.

    Args:
        num_nodes: number of nodes.
        edges: pairs of nodes.
        joined: which edges count; None for all.

    Returns:
        One node index per node.

    >>> components(4, np.array([[0, 1], [2, 3], [1, 2]]), np.array([True, True, False]))
    array([0, 0, 2, 2])
    """
    name = np.arange(num_nodes)
    a, b = (edges if joined is None else edges[joined]).T
    while len(a):
        low = np.minimum(name[a], name[b])  # hook the larger name below the smaller
        np.minimum.at(name, name[a], low)
        np.minimum.at(name, name[b], low)
        while True:  # and follow the names to their roots
            root = name[name]
            if np.array_equal(root, name):
                break
            name = root
        open_ = name[a] != name[b]
        a, b = a[open_], b[open_]
    return name


def mirror_faces(
    verts: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    plane: float = 0.0,
    tolerance: float = 0.25,
) -> Int[np.ndarray, "f"]:
    """Mirror image of each face in the plane x = `plane`.

    Args:
        verts: vertices, metres; +x is the subject's left.
        faces: vertex indices.
        plane: x of the plane of symmetry, metres.
        tolerance: largest distance of mirrored centroids, in mean edge lengths.

    Returns:
        Face index per face, -1 where no face lies there; where it does, it is mutual.

    >>> square = np.array([[-1.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0]])
    >>> mirror_faces(square, np.array([[0, 3, 2], [3, 1, 2]]))
    array([1, 0])
    """
    from scipy.spatial import KDTree

    if not len(faces):
        return np.zeros(0, np.int64)
    centre = verts[faces].mean(1)
    edge = np.linalg.norm(verts[faces] - verts[np.roll(faces, 1, 1)], axis=2).mean()
    turned = centre * [-1, 1, 1] + [2 * plane, 0, 0]
    found = KDTree(centre).query(turned)
    gap, other = np.asarray(found[0]), np.asarray(found[1])
    mutual = (other[other] == np.arange(len(faces))) & (gap <= tolerance * edge)
    return np.where(mutual, other, -1)
