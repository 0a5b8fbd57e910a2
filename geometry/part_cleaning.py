"""Clean borders of parts: graph cut, no islands, left equal to right; numpy, no torch.

A graph cut weighs the length of a border against the area that it takes from the part whose joints
weigh most there. References: Y. Boykov, O. Veksler, R. Zabih, Fast approximate energy minimization
via graph cuts, 2001 (expansion moves); V. Kolmogorov, R. Zabih, What energy functions can be
minimized via graph cuts?, 2004 (the graph of a move); own code.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from .errors import InputError
from .mesh_graph import (
    MeshGraph,
    components,
    face_graph,
    mirror_faces,
    vertex_graph,
    weld_by_place,
)

_CAPACITY = 1 << 28  # the largest whole number that stands for a cost in the flow
_SWEEPS = 4


def remove_islands(labels: Int[np.ndarray, "n"], graph: MeshGraph) -> Int[np.ndarray, "n"]:
    """Give every piece of a label but its largest to the neighbours with the longest border.

    Args:
        labels: label of each node.
        graph: neighbours, lengths of borders, areas.

    Returns:
        Labels of which each is connected within each component of the graph.

    >>> line = MeshGraph(np.array([[0, 1], [1, 2], [2, 3]]), np.ones(3), np.array([2.0, 1, 1, 1]))
    >>> remove_islands(np.array([0, 1, 1, 0]), line)
    array([0, 1, 1, 1])
    """
    edges, count = graph.edges, graph.num_nodes
    if not count:
        return labels.copy()
    same = labels[edges[:, 0]] == labels[edges[:, 1]]
    piece = components(count, edges, same)
    body = components(count, edges)
    mass = np.bincount(piece, graph.mass, count)
    heads = np.flatnonzero(piece == np.arange(count))
    # heads by component and label, the largest piece first, then the first one
    order = heads[np.lexsort((heads, -mass[heads], labels[heads], body[heads]))]
    key = np.stack([body[order], labels[order]], 1)
    first = np.r_[True, (key[1:] != key[:-1]).any(1)]
    kept = np.isin(piece, order[first])
    return _grown(labels, kept, graph)


def _grown(labels: np.ndarray, kept: np.ndarray, graph: MeshGraph) -> np.ndarray:
    """Labels where kept; elsewhere, ring by ring, that of the longest border to labelled nodes."""
    labels, kept = labels.copy(), kept.copy()
    ends = np.concatenate([graph.edges, graph.edges[:, ::-1]])
    weights = np.concatenate([graph.weights, graph.weights])
    while True:
        ring = ~kept[ends[:, 0]] & kept[ends[:, 1]]
        if not ring.any():
            return labels
        node, label = ends[ring, 0], labels[ends[ring, 1]]
        votes, inverse = np.unique(np.stack([node, label], 1), axis=0, return_inverse=True)
        share = np.bincount(inverse.reshape(-1), weights[ring], len(votes))
        order = np.lexsort((votes[:, 1], -share, votes[:, 0]))
        best = order[np.r_[True, np.diff(votes[order, 0]) > 0]]
        labels[votes[best, 0]] = votes[best, 1]
        kept[votes[best, 0]] = True


def cut_energy(
    labels: Int[np.ndarray, "n"], costs: Float[np.ndarray, "n l"], graph: MeshGraph
) -> float:
    """Costs of the labels plus the length of all borders.

    Args:
        labels: label of each node.
        costs: cost of each label at each node, metres.
        graph: neighbours and lengths of borders.

    Returns:
        Metres.

    >>> pair = MeshGraph(np.array([[0, 1]]), np.array([2.0]), np.ones(2))
    >>> cut_energy(np.array([0, 1]), np.array([[0.5, 0], [0, 0.25]]), pair)
    2.75
    """
    apart = labels[graph.edges[:, 0]] != labels[graph.edges[:, 1]]
    return float(costs[np.arange(len(labels)), labels].sum() + graph.weights[apart].sum())


def smooth_labels(
    costs: Float[np.ndarray, "n l"], graph: MeshGraph, start: Int[np.ndarray, "n"] | None = None
) -> Int[np.ndarray, "n"]:
    """Labels of small cost and short borders, by expansion moves.

    With two labels the result is a minimum; with more it is within a factor of two of one.

    Args:
        costs: cost of each label at each node, metres; at least 0.
        graph: neighbours and lengths of borders, metres.
        start: first labels; None for those of least cost.

    Returns:
        Labels whose `cut_energy` is at most that of the start.

    Raises:
        InputError: costs that are negative or not finite.

    >>> line = MeshGraph(np.array([[0, 1], [1, 2]]), np.ones(2), np.ones(3))
    >>> smooth_labels(np.array([[0.0, 1], [0.3, 0.2], [0.0, 1]]), line)
    array([0, 0, 0])
    """
    if not np.isfinite(costs).all() or (costs.size and costs.min() < 0):
        raise InputError("costs: expected finite numbers ≥ 0, found others; clip them")
    labels = costs.argmin(1) if start is None else start.copy()
    energy = cut_energy(labels, costs, graph)
    for _ in range(_SWEEPS):
        before = energy
        for label in range(costs.shape[1]):
            moved = _expanded(labels, label, costs, graph)
            value = cut_energy(moved, costs, graph)
            if value < energy:
                labels, energy = moved, value
        if energy == before:
            break
    return labels


def _expanded(labels: np.ndarray, label: int, costs: np.ndarray, graph: MeshGraph) -> np.ndarray:
    """Best labelling in which every node keeps its label or takes `label`."""
    free = np.flatnonzero(labels != label)
    place = np.full(len(labels), -1)
    place[free] = np.arange(len(free))
    keep = costs[free, labels[free]].copy()  # cost of 0: the node keeps its label
    take = costs[free, label].copy()
    a, b = graph.edges.T
    weight = graph.weights
    # one end has the label already: the border is paid if the other end keeps its own
    for inner, outer in ((a, b), (b, a)):
        half = (place[inner] < 0) & (place[outer] >= 0)
        np.add.at(keep, place[outer[half]], weight[half])
    both = (place[a] >= 0) & (place[b] >= 0)
    a, b, weight, equal = a[both], b[both], weight[both], (labels[a] == labels[b])[both]
    # equal labels: w where one of the two moves. different ones: w unless both move,
    # = w - w x_b + w (1 - x_a) x_b
    np.add.at(keep, place[b[~equal]], weight[~equal])
    arcs = np.concatenate([np.stack([place[a], place[b]], 1), np.stack([place[b], place[a]], 1)])
    size = np.concatenate([weight, np.where(equal, weight, 0.0)])
    moved = labels.copy()
    moved[free[_cut(keep, take, arcs, size)]] = label
    return moved


def _cut(keep: np.ndarray, take: np.ndarray, arcs: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Nodes on the side of the sink in a minimum cut: those that take the label."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    count = len(keep)
    if not count:
        return np.zeros(0, bool)
    least = np.minimum(keep, take)
    keep, take = keep - least, take - least
    largest = float(max(keep.max(), take.max(), size.max(initial=0.0)))
    scale = _CAPACITY / largest if largest > 0 else 0.0
    source, sink, nodes = count, count + 1, np.arange(count)
    rows = np.concatenate([np.full(count, source), nodes, arcs[:, 0]])
    cols = np.concatenate([nodes, np.full(count, sink), arcs[:, 1]])
    # a node cut from the source takes the label, one cut from the sink keeps its own
    values = np.rint(np.concatenate([take, keep, size]) * scale).astype(np.int32)
    there = values > 0
    graph = csr_array((values[there], (rows[there], cols[there])), (count + 2, count + 2))
    flow = maximum_flow(graph, source, sink).flow
    left = (graph - flow).astype(np.int64)
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    reached = breadth_first_order(left, source, return_predecessors=False)
    taken = np.ones(count + 2, bool)
    taken[reached] = False
    return taken[:count]


def _mirrored_labels(labels: np.ndarray, mirror: np.ndarray, count: int) -> np.ndarray | None:
    """Label on the other side for each label, by vote of mirrored faces; None if it is unclear."""
    known = mirror >= 0
    if known.mean() < 0.5:
        return None
    votes = np.zeros((count, count), np.int64)
    np.add.at(votes, (labels[known], labels[mirror[known]]), 1)
    other = votes.argmax(1)
    other[votes.sum(1) == 0] = np.flatnonzero(votes.sum(1) == 0)
    return other if np.array_equal(other[other], np.arange(count)) else None


def _reflect(
    labels: np.ndarray, mirror: np.ndarray, other: np.ndarray, side: np.ndarray
) -> np.ndarray:
    """The labels of the side x > plane, copied to the other one."""
    right = (side < 0) & (mirror >= 0)
    labels = labels.copy()
    labels[right] = other[labels[mirror[right]]]
    return labels


def clean_face_labels(
    scores: Float[np.ndarray, "f l"],
    verts: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    smoothing: float | None = None,
    plane: float | None = 0.0,
) -> Int[np.ndarray, "f"]:
    """One label per face, each connected, with short borders, the same left and right.

    Args:
        scores: share of each label at each face, 0 to 1; larger is better.
        verts: vertices, metres.
        faces: vertex indices.
        smoothing: width over which a border may move to become shorter, metres; None is a
            hundredth of the diagonal of the mesh, 0 only removes islands.
        plane: x of the plane of symmetry, metres; None for a mesh without one. A mesh that is not
            symmetric there is left as it is.

    Returns:
        Labels; every label is connected within each component of the mesh.

    Raises:
        InputError: vertices or scores that are not finite, or indices out of range.

    >>> square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    >>> clean_face_labels(np.eye(2), square, np.array([[0, 1, 2], [0, 2, 3]]))
    array([0, 1])
    """
    graph = face_graph(verts, faces)
    if not np.isfinite(scores).all():
        raise InputError("weights: expected finite numbers, found others; correct the weights")
    if not len(faces):
        return np.zeros(0, np.int64)
    labels = scores.argmax(1)
    mirror = None if plane is None else mirror_faces(verts, faces, plane)
    other = None if mirror is None else _mirrored_labels(labels, mirror, scores.shape[1])
    if mirror is not None and other is not None:
        known = mirror >= 0
        both = scores.copy()
        both[known] = 0.5 * (scores[known] + scores[mirror[known]][:, other])
        scores, labels = both, both.argmax(1)
    if smoothing is None:
        smoothing = 0.01 * float(np.linalg.norm(np.ptp(verts[faces].reshape(-1, 3), axis=0)))
    if smoothing > 0:
        lost = scores.max(1, keepdims=True) - scores
        labels = smooth_labels(lost * graph.mass[:, None] / smoothing, graph, labels)
    labels = remove_islands(labels, graph)
    if mirror is not None and other is not None:
        side = verts[faces].mean(1)[:, 0] - (plane or 0.0)
        labels = remove_islands(_reflect(labels, mirror, other, side), graph)
    return labels


def vertex_labels(
    labels: Int[np.ndarray, "f"],
    verts: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    num_labels: int,
) -> Int[np.ndarray, "v"]:
    """Label of each vertex: the one that fills most of the angle around it, without islands.

    Args:
        labels: label of each face.
        verts: vertices, metres.
        faces: vertex indices.
        num_labels: number of labels.

    Returns:
        Labels; a vertex without faces takes that of the closest vertex with one.

    Raises:
        InputError: no faces, vertices that are not finite, or indices out of range.

    >>> vertex_labels(np.array([1]), np.eye(3), np.array([[0, 1, 2]]), 2)
    array([1, 1, 1])
    """
    from scipy.spatial import KDTree

    graph = vertex_graph(verts, faces)
    if not len(faces):
        raise InputError("faces: expected at least one triangle, found 0; pass a mesh with faces")
    corner = verts[faces]
    ahead, back = np.roll(corner, -1, 1) - corner, np.roll(corner, 1, 1) - corner
    cross = np.linalg.norm(np.cross(ahead, back), axis=2)
    angle = np.arctan2(cross, (ahead * back).sum(2))
    share = np.zeros((len(verts), num_labels))
    first = weld_by_place(verts)
    np.add.at(share, (first[faces], labels[:, None]), angle + 1e-9)
    share = share[first]
    # angles are rounded: those of twins left and right must not differ
    found = np.round(share, 9).argmax(1)
    used = share.any(1)
    found[~used] = found[used][KDTree(verts[used]).query(verts[~used])[1]] if (~used).any() else 0
    return remove_islands(found, graph)


def label_shares(
    weights: Float[np.ndarray, "v j"], label_of_joint: Sequence[int], num_labels: int
) -> Float[np.ndarray, "v l"]:
    """Skinning weight of each label at each vertex.

    Args:
        weights: skinning weights.
        label_of_joint: label of each joint.
        num_labels: number of labels.

    Returns:
        Sums of weights; rows sum to what the weights sum to.

    Raises:
        InputError: another number of joints.

    >>> label_shares(np.array([[0.5, 0.25, 0.25]]), (0, 1, 1), 2)
    array([[0.5, 0.5]])
    """
    if weights.shape[1] != len(label_of_joint):
        raise InputError(
            f"weights: expected {len(label_of_joint)} joints (the part map's), found "
            f"{weights.shape[1]}; make the part map for this body"
        )
    return weights @ np.eye(num_labels)[list(label_of_joint)]
