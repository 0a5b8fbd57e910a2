"""Topology of a mesh under seams: which edges are joined, corners after cutting, charts, loops."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

Faces = Int[np.ndarray, "F 3"]


@dataclass(frozen=True, eq=False)
class MeshEdges:
    """Undirected edges of a triangle mesh; only two faces of one orientation can be joined."""

    faces: Faces
    """Vertex indices, (F, 3)."""
    verts: Int[np.ndarray, "E 2"]
    """The two vertices of each edge, the lower index first."""
    of_face: Int[np.ndarray, "F 3"]
    """Edge of the side from corner k to corner k + 1."""
    sides: Int[np.ndarray, "E 2"]
    """The two half-edges (3 · face + corner) of an edge that can be joined, else −1."""

    @classmethod
    def of(cls, faces: Faces) -> "MeshEdges":
        """Edges of faces; those of one face, of three and more, or of two that disagree are seams.

        >>> MeshEdges.of(np.array([[0, 1, 2], [2, 1, 3]])).joinable.tolist()
        [False, False, True, False, False]
        """
        start, end = faces.reshape(-1), np.roll(faces, -1, 1).reshape(-1)
        low, high = np.minimum(start, end), np.maximum(start, end)
        base = int(faces.max(initial=0)) + 1
        key, edge = np.unique(low.astype(np.int64) * base + high, return_inverse=True)
        count = len(key)
        forward = start < end
        number = np.bincount(edge, minlength=count)
        ahead = np.bincount(edge, forward, minlength=count)
        sound = (number == 2) & (ahead == 1) & (key // base != key % base)
        sides = np.full((count, 2), -1, np.int64)
        for column, mask in enumerate((forward, ~forward)):
            half = np.flatnonzero(mask & sound[edge])
            sides[edge[half], column] = half
        verts = np.stack([key // base, key % base], 1)
        return cls(faces, verts, edge.reshape(-1, 3), sides)

    @property
    def joinable(self) -> Bool[np.ndarray, "E"]:
        """Edges that need not be seams."""
        return self.sides[:, 0] >= 0

    @cached_property
    def face_pairs(self) -> Int[np.ndarray, "E 2"]:
        """The two faces of each joinable edge, else −1."""
        return np.where(self.joinable[:, None], self.sides // 3, -1)

    def seams_of_labels(self, labels: Int[np.ndarray, "F"]) -> Bool[np.ndarray, "E"]:
        """Edges that cannot be joined, and those between faces of different labels."""
        pairs = self.face_pairs
        return ~self.joinable | (labels[pairs[:, 0]] != labels[pairs[:, 1]])


@dataclass(frozen=True, eq=False)
class CutMesh:
    """A mesh cut along its seams: manifold by construction, a vertex is a fan of corners."""

    edges: MeshEdges
    seams: Bool[np.ndarray, "E"]
    """Edges that are cut; holds all that cannot be joined."""
    faces: Faces
    """Vertices of the cut mesh, (F, 3)."""
    origin: Int[np.ndarray, "W"]
    """Vertex of the mesh from which each vertex of the cut mesh comes."""
    chart: Int[np.ndarray, "F"]
    """Connected component of each face, numbered by the first face of each."""

    @classmethod
    def of(cls, edges: MeshEdges, seams: Bool[np.ndarray, "E"]) -> "CutMesh":
        """Cut a mesh.

        >>> edges = MeshEdges.of(np.array([[0, 1, 2], [2, 1, 3]]))
        >>> len(CutMesh.of(edges, np.ones(5, bool)).origin)
        6
        """
        seams = seams | ~edges.joinable
        halves = edges.sides[~seams]
        after = halves - halves % 3 + (halves + 1) % 3
        count = edges.faces.size
        a = np.concatenate([halves[:, 0], after[:, 0]])
        b = np.concatenate([after[:, 1], halves[:, 1]])
        group = components(count, a, b)
        number = int(group.max(initial=-1)) + 1
        origin = np.zeros(number, np.int64)
        origin[group] = edges.faces.reshape(-1)
        pairs = edges.face_pairs[~seams]
        chart = components(len(edges.faces), pairs[:, 0], pairs[:, 1])
        return cls(edges, seams, group.reshape(-1, 3), origin, chart)

    @property
    def num_charts(self) -> int:
        """Number of connected components."""
        return int(self.chart.max(initial=-1)) + 1

    @cached_property
    def vert_chart(self) -> Int[np.ndarray, "W"]:
        """Chart of each vertex of the cut mesh."""
        out = np.zeros(len(self.origin), np.int64)
        out[self.faces.reshape(-1)] = np.repeat(self.chart, 3)
        return out

    @cached_property
    def border(self) -> Int[np.ndarray, "B 2"]:
        """Half-edges of the border as vertices of the cut mesh, each start once."""
        open_side = self.seams[self.edges.of_face]
        ends = np.stack([self.faces, np.roll(self.faces, -1, 1)], -1)
        return ends[open_side]

    @cached_property
    def loop(self) -> Int[np.ndarray, "W"]:
        """Border loop of each vertex, −1 inside."""
        out = np.full(len(self.origin), -1, np.int64)
        start = self.border[:, 0]
        local = np.full(len(self.origin), -1, np.int64)
        local[start] = np.arange(len(start))
        out[start] = components(len(start), local[start], local[self.border[:, 1]])
        return out

    @cached_property
    def euler(self) -> Int[np.ndarray, "C"]:
        """Euler characteristic of each chart: 1 for a disc, 2 for a closed sphere."""
        count = self.num_charts
        verts = np.bincount(self.vert_chart, minlength=count)
        faces = np.bincount(self.chart, minlength=count)
        open_side = self.seams[self.edges.of_face]
        border = np.bincount(self.chart, open_side.sum(1), minlength=count).astype(np.int64)
        return verts - (3 * faces + border) // 2 + faces

    def loops(self) -> list[np.ndarray]:
        """The border loops, each as vertices of the cut mesh in the order of their faces."""
        follow = np.full(len(self.origin), -1, np.int64)
        follow[self.border[:, 0]] = self.border[:, 1]
        nexts, seen = follow.tolist(), [False] * len(follow)
        loops = []
        for start in self.border[:, 0].tolist():
            ring, at = [], start
            while not seen[at]:
                seen[at] = True
                ring.append(at)
                at = nexts[at]
            if ring:
                loops.append(np.array(ring))
        return loops

    def uv_of_corners(self, uv: Float[np.ndarray, "W 2"]) -> Float[np.ndarray, "F 3 2"]:
        """Coordinates per face corner."""
        return uv[self.faces]


def components(
    count: int, a: Int[np.ndarray, "n"], b: Int[np.ndarray, "n"]
) -> Int[np.ndarray, "count"]:
    """Connected components of a graph, numbered by the first node of each.

    Args:
        count: number of nodes.
        a: first node of each edge.
        b: second node of each edge.

    Returns:
        Component of each node.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if count == 0:
        return np.zeros(0, np.int64)
    graph = coo_matrix((np.ones(len(a), bool), (a, b)), (count, count))
    _, label = connected_components(graph, directed=False)
    first = np.zeros(int(label.max()) + 1, np.int64)
    first[label[::-1]] = np.arange(count)[::-1]
    rank = np.zeros(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[label]
