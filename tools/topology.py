"""How the faces of a mesh hang together: open, branching and turned edges, holes, pieces; numpy."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from monopart.geometry.mesh_graph import components


@dataclass(frozen=True, eq=False)
class Topology:
    """Edges, vertices and pieces of a mesh.

    Attributes:
        open_edges: [A, 2] edges of one face.
        branching_edges: [B, 2] edges of three faces or more.
        turned_edges: [C, 2] edges whose two faces run along them in the same direction.
        pinched_verts: [D] vertices where fans of faces meet that share no edge there.
        repeated_faces: [E] faces whose three vertices another face has, the first one left out.
        piece: [F] piece of each face, joined by edges, numbered from 0.
        holes: number of connected borders.
        euler: vertices − edges + faces, of vertices in use.
    """

    open_edges: Int[np.ndarray, "a 2"]
    branching_edges: Int[np.ndarray, "b 2"]
    turned_edges: Int[np.ndarray, "c 2"]
    pinched_verts: Int[np.ndarray, "d"]
    repeated_faces: Int[np.ndarray, "e"]
    piece: Int[np.ndarray, "f"]
    holes: int
    euler: int

    @property
    def num_pieces(self) -> int:
        """Number of pieces."""
        return int(self.piece.max(initial=-1)) + 1

    @property
    def closed(self) -> bool:
        """Every edge has two faces or, where it branches, an even number."""
        return not len(self.open_edges)


def topology(faces: Int[np.ndarray, "f 3"], num_verts: int) -> Topology:
    """How faces hang together.

    Args:
        faces: vertex indices in range, each face with three different ones.
        num_verts: number of vertices.

    Returns:
        What was found.

    >>> found = topology(np.array([[0, 1, 2], [0, 2, 3]]), 4)
    >>> found.holes, found.euler, len(found.open_edges)
    (1, 1, 4)
    """
    ends = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    forward = ends[:, 0] < ends[:, 1]
    face = np.repeat(np.arange(len(faces)), 3)
    if not len(faces):
        none, no = np.zeros((0, 2), np.int64), np.zeros(0, np.int64)
        return Topology(none, none, none, no, no, no, 0, 0)
    edges, name, count = np.unique(
        np.sort(ends, 1), axis=0, return_inverse=True, return_counts=True
    )
    name = name.reshape(-1)
    ahead = np.bincount(name, forward, len(edges)).astype(int)
    open_edges = edges[count == 1]
    piece = np.unique(components(len(faces), _joined(name, face)), return_inverse=True)[1].reshape(
        -1
    )
    rim = np.unique(open_edges)
    walk = components(num_verts, open_edges)
    return Topology(
        open_edges=open_edges,
        branching_edges=edges[count > 2],
        turned_edges=edges[(count == 2) & (ahead != 1)],
        pinched_verts=_pinched(faces, name),
        repeated_faces=_repeated(faces),
        piece=piece,
        holes=len(np.unique(walk[rim])),
        euler=len(np.unique(faces)) - len(edges) + len(faces),
    )


def _joined(name: np.ndarray, of: np.ndarray) -> np.ndarray:
    """Pairs of things (faces, corners) that carry one name, in a chain."""
    order = np.argsort(name, kind="stable")
    same = name[order][1:] == name[order][:-1]
    return np.stack([of[order][:-1][same], of[order][1:][same]], 1)


def _pinched(faces: np.ndarray, name: np.ndarray) -> np.ndarray:
    """Vertices whose corners fall into several fans; `name` is the edge from each corner on."""
    corner = np.arange(faces.size).reshape(-1, 3)
    vertex = faces.reshape(-1)
    # an edge joins the corners at both its ends: those at its start and those at its end
    start, end = corner.reshape(-1), np.roll(corner, -1, 1).reshape(-1)
    both = np.concatenate([start, end])
    last = np.maximum(vertex[start], vertex[end])
    key = np.tile(2 * name, 2) + (vertex[both] == np.tile(last, 2))
    fan = components(faces.size, _joined(key, both))
    pairs = np.unique(np.stack([vertex, fan], 1), axis=0)
    found, count = np.unique(pairs[:, 0], return_counts=True)
    return found[count > 1]


def _repeated(faces: np.ndarray) -> np.ndarray:
    _, first = np.unique(np.sort(faces, 1), axis=0, return_index=True)
    extra = np.ones(len(faces), bool)
    extra[first] = False
    return np.flatnonzero(extra)
