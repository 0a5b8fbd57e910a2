"""Faces of a mesh that cut each other, and texture triangles that overlap or are turned over.

Two faces cut each other where they share a point that is no common vertex and on no common edge.
Signs come from `predicates`, candidates from `box_pairs`. Reference: P. Guigue, O. Devillers, Fast
and robust triangle-triangle overlap test using orientation predicates, 2003 (the use of
orientations alone); own code.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from monopart.geometry.mesh_graph import face_areas

from .box_pairs import overlapping_boxes
from .predicates import orient2d, orient3d


def _scaled(values: np.ndarray) -> np.ndarray:
    """The same numbers near 1, times a power of two, so that no product overflows."""
    size = float(np.abs(values).max(initial=0.0))
    return values if size == 0 else np.ldexp(values, -int(np.floor(np.log2(size))))


def _flat(points: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """[N, 2] coordinates without the given axis of each point."""
    keep = np.array([[1, 2], [2, 0], [0, 1]])[axis]
    return np.take_along_axis(points, keep, 1)


def _segment_in_plane(ends: list[np.ndarray], tri: list[np.ndarray]) -> np.ndarray:
    """Whether segments touch triangles of the same plane; all [N, 3]."""
    normal = np.abs(np.cross(tri[1] - tri[0], tri[2] - tri[0]))
    axis = normal.argmax(1)
    p, q = (_flat(x, axis) for x in ends)
    corner = [_flat(x, axis) for x in tri]
    hit = np.zeros(len(p), bool)
    inside_p, inside_q = [], []
    for k in range(3):
        a, b = corner[k], corner[(k + 1) % 3]
        side_p, side_q = orient2d(a, b, p), orient2d(a, b, q)
        side_a, side_b = orient2d(p, q, a), orient2d(p, q, b)
        crossing = (side_p * side_q <= 0) & (side_a * side_b <= 0)
        # on one line all four vanish: the boxes must overlap too
        line = (side_p == 0) & (side_q == 0) & (side_a == 0) & (side_b == 0)
        boxes = (np.minimum(a, b) <= np.maximum(p, q)).all(1)
        boxes &= (np.minimum(p, q) <= np.maximum(a, b)).all(1)
        hit |= crossing & (~line | boxes)
        inside_p.append(side_p)
        inside_q.append(side_q)
    for sides in (np.stack(inside_p, 1), np.stack(inside_q, 1)):
        hit |= (sides >= 0).all(1) | (sides <= 0).all(1)
    return hit


def _side(tri: list[np.ndarray], points: np.ndarray) -> np.ndarray:
    """On which side of triangles points lie."""
    return orient3d(tri[0], tri[1], tri[2], points).astype(int)


def _edge_cuts(p: np.ndarray, q: np.ndarray, tri: list[np.ndarray]) -> np.ndarray:
    """Whether closed segments touch closed triangles with area; all [N, 3]."""
    side_p, side_q = _side(tri, p), _side(tri, q)
    hit = np.zeros(len(p), bool)
    near = np.flatnonzero((side_p * side_q <= 0) & ((side_p != 0) | (side_q != 0)))
    if len(near):
        a, b, c = (x[near] for x in tri)
        start, end = p[near], q[near]
        turns = [orient3d(start, end, x, y) for x, y in ((a, b), (b, c), (c, a))]
        turn = np.stack(turns, 1)
        hit[near] = (turn >= 0).all(1) | (turn <= 0).all(1)
    flat = np.flatnonzero((side_p == 0) & (side_q == 0))
    if len(flat):
        hit[flat] = _segment_in_plane([p[flat], q[flat]], [x[flat] for x in tri])
    return hit


def _rolled(faces: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Corners of faces from a given place on, order kept."""
    return np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, 1)


def _cut_apart(verts: np.ndarray, one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Faces without a common vertex: does an edge of one touch the other?"""
    a, b = list(np.moveaxis(verts[one], 1, 0)), list(np.moveaxis(verts[two], 1, 0))
    hit = np.zeros(len(one), bool)
    possible = np.arange(len(one))
    for x, y in ((a, b), (b, a)):  # all of one strictly on one side of the other
        sides = np.stack([_side([t[possible] for t in y], x[k][possible]) for k in range(3)], 1)
        possible = possible[~((sides > 0).all(1) | (sides < 0).all(1))]
    for x, y in ((a, b), (b, a)):
        for k in range(3):
            rest = possible[~hit[possible]]
            ends = x[k][rest], x[(k + 1) % 3][rest]
            hit[rest] = _edge_cuts(*ends, [t[rest] for t in y])
    return hit


def _cut_at_vertex(verts: np.ndarray, one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Faces with one common vertex, which comes first: does the far edge touch the other?"""
    hit = np.zeros(len(one), bool)
    possible = np.arange(len(one))
    for x, y in ((one, two), (two, one)):  # the far edge strictly on one side: only the vertex
        tri = list(np.moveaxis(verts[y[possible]], 1, 0))
        sides = [_side(tri, verts[x[possible, k]]) for k in (1, 2)]
        possible = possible[sides[0] * sides[1] <= 0]
    for x, y in ((one, two), (two, one)):
        rest = possible[~hit[possible]]
        tri = list(np.moveaxis(verts[y[rest]], 1, 0))
        hit[rest] = _edge_cuts(verts[x[rest, 1]], verts[x[rest, 2]], tri)
    return hit


def _folded(verts: np.ndarray, one: np.ndarray, two: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Faces with a common edge, whose far vertex comes first: are they folded onto each other?"""
    tri = list(np.moveaxis(verts[one], 1, 0))
    point = verts[np.take_along_axis(two, other[:, None], 1)[:, 0]]
    hit = _side(tri, point) == 0
    if hit.any():
        a, b, c = (x[hit] for x in tri)
        axis = np.abs(np.cross(b - a, c - a)).argmax(1)
        a, b, c, d = (_flat(x, axis) for x in (a, b, c, point[hit]))
        hit[hit] = orient2d(b, c, a) == orient2d(b, c, d)
    return hit


def _cut_pairs(verts: np.ndarray, faces: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    one, two = faces[pairs[:, 0]], faces[pairs[:, 1]]
    same = one[:, :, None] == two[:, None, :]
    shared = same.any(2).sum(1)
    hit = np.zeros(len(pairs), bool)
    which = shared == 0
    hit[which] = _cut_apart(verts, one[which], two[which])
    which = shared == 1
    at_one, at_two = same[which].any(2).argmax(1), same[which].any(1).argmax(1)
    hit[which] = _cut_at_vertex(verts, _rolled(one[which], at_one), _rolled(two[which], at_two))
    which = shared == 2
    far_one, far_two = (~same[which].any(2)).argmax(1), (~same[which].any(1)).argmax(1)
    hit[which] = _folded(verts, _rolled(one[which], far_one), two[which], far_two)
    return hit


def self_intersections(
    verts: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Int[np.ndarray, "n 2"]:
    """Pairs of faces that cut, touch or cover each other beyond what they share.

    Faces without area are left out, and so are pairs of the same three vertices; both are findings
    of their own.

    Args:
        verts: finite vertices; vertices at one place should have one index.
        faces: vertex indices.

    Returns:
        Pairs of face indices, smaller first, sorted.

    >>> verts = np.array([[0.0, 0, 0], [9, 0, 0], [0, 9, 0], [1, 1, -1], [1, 1, 1], [9, 9, 0]])
    >>> self_intersections(verts, np.array([[0, 1, 2], [3, 4, 5]]))
    array([[0, 1]])
    """
    verts = _scaled(verts)
    whole = np.flatnonzero(_has_area(verts, faces))
    corner = verts[faces[whole]]
    if not len(whole):
        return np.zeros((0, 2), np.int64)
    found = [np.zeros((0, 2), np.int64)]
    for near in overlapping_boxes(corner.min(1), corner.max(1)):
        pairs = whole[near]
        found.append(pairs[_cut_pairs(verts, faces, pairs)])
    cut = np.concatenate(found)
    return cut[np.lexsort((cut[:, 1], cut[:, 0]))]


def _has_area(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces with area: their corners turn in one of the three planes of the axes."""
    a, b, c = np.moveaxis(verts[faces], 1, 0)
    turns = [orient2d(*(np.delete(x, k, 1) for x in (a, b, c))) != 0 for k in range(3)]
    return turns[0] | turns[1] | turns[2]


@dataclass(frozen=True, eq=False)
class UVFaults:
    """Texture triangles that cannot hold a texture of their own.

    Attributes:
        flipped: [A] faces that run clockwise.
        flat: [B] faces without area in the texture, though they have one in space.
        overlaps: [C, 2] pairs of faces whose insides share a point.
        depth: [C] least shift that takes such a pair apart, in units of the texture.
    """

    flipped: Int[np.ndarray, "a"]
    flat: Int[np.ndarray, "b"]
    overlaps: Int[np.ndarray, "c 2"]
    depth: Float[np.ndarray, "c"]


def _inside_depth(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Least shift that takes counter-clockwise triangles [N, 3, 2] apart, along their edges."""
    best = np.full(len(one), np.inf)
    for x, y in ((one, two), (two, one)):
        for k in range(3):
            a, b = x[:, k], x[:, (k + 1) % 3]
            edge = (b - a) / np.maximum(np.linalg.norm(b - a, axis=1), 1e-300)[:, None]
            gap = (
                edge[:, None, 0] * (y - a[:, None])[..., 1]
                - edge[:, None, 1] * (y - a[:, None])[..., 0]
            )
            best = np.minimum(best, gap.max(1))
    return best


def _insides_meet(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Whether the insides of counter-clockwise triangles [N, 3, 2] share a point."""
    apart = np.zeros(len(one), bool)
    for x, y in ((one, two), (two, one)):
        for k in range(3):
            sides = [orient2d(x[:, k], x[:, (k + 1) % 3], y[:, j]) for j in range(3)]
            apart |= (np.stack(sides, 1) <= 0).all(1)
    return ~apart


def uv_faults(
    corner_uv: Float[np.ndarray, "f 3 2"],
    verts: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
) -> UVFaults:
    """Flipped, flat and overlapping texture triangles, decided by exact signs.

    Args:
        corner_uv: finite texture coordinates per face corner.
        verts: vertices; a face without area in space may be flat in the texture.
        faces: vertex indices.

    Returns:
        The faults; triangles that touch along an edge or at a corner do not overlap.

    >>> uv = np.array([[[0.0, 0], [1, 0], [0, 1]], [[0.25, 0.25], [0.25, 1], [1, 0.25]]])
    >>> faults = uv_faults(uv, np.eye(3), np.array([[0, 1, 2], [0, 2, 1]]))
    >>> faults.flipped.tolist(), faults.overlaps.tolist()
    ([1], [[0, 1]])
    """
    turn = orient2d(corner_uv[:, 0], corner_uv[:, 1], corner_uv[:, 2])
    ccw = np.where((turn < 0)[:, None, None], corner_uv[:, ::-1], corner_uv)
    whole = np.flatnonzero(turn != 0)
    found = [np.zeros((0, 2), np.int64)]
    if len(whole):
        for near in overlapping_boxes(ccw[whole].min(1), ccw[whole].max(1)):
            pairs = whole[near]
            found.append(pairs[_insides_meet(ccw[pairs[:, 0]], ccw[pairs[:, 1]])])
    overlaps = np.concatenate(found)
    overlaps = overlaps[np.lexsort((overlaps[:, 1], overlaps[:, 0]))]
    depth = _inside_depth(ccw[overlaps[:, 0]], ccw[overlaps[:, 1]])
    flat = np.flatnonzero((turn == 0) & (face_areas(verts, faces) > 0))
    return UVFaults(np.flatnonzero(turn < 0), flat, overlaps, depth)
