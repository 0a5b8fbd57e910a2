"""Skinning weights for a mesh and a skeleton that have none: heat that flows from the bones.

Each vertex is coupled to the nearest bone that it sees through the inside of the mesh, by the
inverse square of the distance; heat spreads over the surface until it stands still. Reference:
I. Baran, J. Popović, Automatic rigging and animation of 3D characters, 2007, section 4; own code.
Negative cotangents are raised to almost 0, so the equations have no negative weights as solution.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from .errors import InputError
from .mesh_graph import check_mesh, components, face_areas, weld_by_place

if TYPE_CHECKING:
    from scipy.sparse import csc_array

_SEEN = (0.2, 0.4, 0.6, 0.8, 0.95)  # where the way to a bone must be inside the mesh
_TRIED = 6  # nearest bones that are looked at
_LEAST = 1e-6  # of the mean cotangent, in place of smaller ones


def surface_laplacian(
    verts: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> "tuple[csc_array, Float[np.ndarray, ' v']]":
    """Cotangent Laplacian with no negative weights, and the area of each vertex.

    Args:
        verts: vertices, metres.
        faces: vertex indices.

    Returns:
        Sparse (V, V), rows sum to 0, off-diagonal entries at most 0; areas, square metres.

    >>> laplacian, _ = surface_laplacian(np.eye(3), np.array([[0, 1, 2]]))
    >>> abs(laplacian.sum(1)).max() < 1e-12
    np.True_
    """
    from scipy.sparse import coo_array

    count = len(verts)
    corner = verts[faces]
    ahead, back = np.roll(corner, -1, 1) - corner, np.roll(corner, 1, 1) - corner
    cross = np.linalg.norm(np.cross(ahead, back), axis=2)
    dots = (ahead * back).sum(2)
    cot = np.where(cross > 0, dots / np.where(cross > 0, cross, 1.0), 0.0)
    a, b = np.roll(faces, -1, 1).reshape(-1), np.roll(faces, 1, 1).reshape(-1)
    pairs, name = np.unique(np.sort(np.stack([a, b], 1), 1), axis=0, return_inverse=True)
    weight = 0.5 * np.bincount(name.reshape(-1), cot.reshape(-1), len(pairs))
    weight = np.maximum(weight, _LEAST * max(float(np.abs(weight).mean()) if len(pairs) else 0, 1))
    i, j = pairs.T
    rows, cols = np.r_[i, j, i, j], np.r_[j, i, i, j]
    values = np.r_[-weight, -weight, weight, weight]
    mass = np.zeros(count)
    np.add.at(mass, faces, face_areas(verts, faces)[:, None] / 3)
    return coo_array((values, (rows, cols)), (count, count)).tocsc(), mass


def bones_of_joints(
    joints: Float[np.ndarray, "j 3"], parents: Sequence[int]
) -> tuple[Float[np.ndarray, "b 2 3"], Int[np.ndarray, "b"]]:
    """Segments that each joint moves: from it to its children; a last joint goes on straight.

    Args:
        joints: rest positions, metres.
        parents: parent of each joint, -1 for a root.

    Returns:
        Ends of the segments, and the joint that moves each.

    Raises:
        InputError: as many parents as joints are needed, and at least one.

    >>> bones_of_joints(np.array([[0.0, 0, 0], [1, 0, 0]]), (-1, 0))[0][:, 1].tolist()
    [[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]
    """
    if len(joints) != len(parents) or not len(joints):
        raise InputError(
            f"joints: expected one for each of {len(parents)} parents, found {len(joints)}; "
            "pass the joints and parents of one skeleton"
        )
    ends, owner = [], []
    for joint in range(len(parents)):
        children = [c for c, parent in enumerate(parents) if parent == joint]
        for child in children:
            ends.append([joints[joint], joints[child]])
            owner.append(joint)
        if not children:
            before = joints[parents[joint]] if parents[joint] >= 0 else joints[joint]
            ends.append([joints[joint], 2 * joints[joint] - before])
            owner.append(joint)
    return np.array(ends), np.array(owner)


def _ways_to_bones(points: np.ndarray, bones: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances [N, B] to segments and the nearest points on them [N, B, 3]."""
    start, along = bones[:, 0], bones[:, 1] - bones[:, 0]
    square = np.maximum((along**2).sum(1), 1e-300)
    share = np.clip(((points[:, None] - start) * along).sum(2) / square, 0, 1)
    near = start + share[..., None] * along
    return np.linalg.norm(points[:, None] - near, axis=2), near


def _sees(verts: np.ndarray, faces: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Whether the ways from surface points to bones run inside the mesh, by winding numbers."""
    import igl

    if not len(start):
        return np.zeros(0, bool)
    share = np.array(_SEEN)[:, None, None]
    on_the_way = ((1 - share) * start + share * end).reshape(-1, 3)
    winding = np.asarray(igl.fast_winding_number(verts, faces, np.ascontiguousarray(on_the_way)))
    return np.asarray((winding.reshape(len(_SEEN), -1) > 0.5).all(axis=0))


def nearest_bones(
    verts: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    bones: Float[np.ndarray, "b 2 3"],
) -> tuple[Int[np.ndarray, "v"], Float[np.ndarray, "v"]]:
    """The nearest bone that each vertex sees through the inside of the mesh.

    Args:
        verts: vertices, metres.
        faces: vertex indices; holes are no harm, inside is where the winding number is above ½.
        bones: ends of the segments, metres.

    Returns:
        Bone of each vertex, -1 where none of the six nearest is seen, and its distance in metres
        (of the nearest bone, where none is seen).

    >>> verts = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> nearest_bones(verts, np.array([[0, 1, 2]]), np.ones((1, 2, 3)))[0]
    array([-1, -1, -1])
    """
    distance, near = _ways_to_bones(verts, bones)
    order = np.argsort(distance, 1, kind="stable")
    rows = np.arange(len(verts))
    bone = np.full(len(verts), -1)
    reach = distance[rows, order[:, 0]].copy()
    for k in range(min(_TRIED, len(bones))):
        left = rows[bone < 0]
        tried = order[left, k]
        seen = _sees(verts, faces, verts[left], near[left, tried])
        bone[left[seen]] = tried[seen]
        reach[left[seen]] = distance[left[seen], tried[seen]]
    return bone, reach


def heat_weights(
    verts: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    joints: Float[np.ndarray, "j 3"],
    parents: Sequence[int],
    strength: float = 3.0,
) -> Float[np.ndarray, "v j"]:
    """Skinning weights of a mesh around a skeleton, smooth over the surface.

    Args:
        verts: rest vertices, metres; those at one place count as one.
        faces: vertex indices, wound outwards.
        joints: rest positions of the joints, inside the mesh, metres.
        parents: parent of each joint, -1 for a root.
        strength: how firmly a vertex keeps to its bone; larger makes narrower transitions. The
            reference takes 1; 3 is nearer to the weights of the free body (of its vertices 97.7 %
            fall into the same of five parts, 96.8 % with 1).

    Returns:
        Weights ≥ 0 whose rows sum to 1.

    Raises:
        InputError: an empty or damaged mesh, or a skeleton that does not agree.

    >>> verts = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> heat_weights(verts, np.array([[0, 1, 2]]), np.zeros((1, 3)), (-1,)).tolist()
    [[1.0], [1.0], [1.0]]
    """
    check_mesh(verts, faces)
    bones, owner = bones_of_joints(joints, parents)
    if not np.isfinite(joints).all():
        raise InputError("joints: expected finite numbers, found others; correct the skeleton")
    if not len(faces):
        raise InputError("faces: expected at least one triangle, found 0; pass a mesh with faces")
    first = weld_by_place(verts)
    used, row = np.unique(first, return_inverse=True)
    points, corners = verts[used], row[faces]
    bone, reach = nearest_bones(points, corners, bones)
    pull = _pulls(points, corners, bone, reach, strength)
    wanted = np.where(bone >= 0, bone, _ways_to_bones(points, bones)[0].argmin(1))
    target = np.zeros((len(used), len(parents)))
    target[np.arange(len(used)), owner[wanted]] = 1.0
    return solved_rows(points, corners, pull, target)[row]


def _pulls(
    points: np.ndarray, corners: np.ndarray, bone: np.ndarray, reach: np.ndarray, strength: float
) -> np.ndarray:
    """How firmly each vertex keeps to its bone, 1/m²; none where none is seen."""
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    pull = strength / np.maximum(reach, 1e-3 * max(size, 1e-300)) ** 2
    pieces = components(len(points), np.sort(corners[:, [0, 1, 1, 2]].reshape(-1, 2), 1))
    seen = np.bincount(pieces, bone >= 0, len(points))[pieces] > 0
    return np.where(
        (bone >= 0) | ~seen, pull, 0.0
    )  # a piece that sees no bone keeps to the nearest


def solved_rows(
    points: Float[np.ndarray, "v 3"],
    corners: Int[np.ndarray, "f 3"],
    pull: Float[np.ndarray, "v"],
    target: Float[np.ndarray, "v j"],
) -> Float[np.ndarray, "v j"]:
    """Rows that spread over a surface and are pulled to targets: (L + M P) w = M P t.

    Args:
        points: vertices, metres.
        corners: vertex indices; every connected piece has a vertex with a pull.
        pull: P, 1/m²; infinite fixes a row at its target.
        target: rows ≥ 0 that sum to 1.

    Returns:
        Rows ≥ 0 that sum to 1; isolated vertices keep their targets.

    >>> flat = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> pull = np.array([np.inf, 0.0, 0.0])
    >>> solved_rows(flat, np.array([[0, 1, 2]]), pull, np.eye(2)[[1, 0, 0]])[2].round(6)
    array([0., 1.])
    """
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    fixed = np.isinf(pull)
    alone = np.ones(len(points), bool)
    alone[corners] = False
    rows = target.copy()
    free = np.flatnonzero(~fixed & ~alone)
    if not len(free):
        return rows
    laplacian, mass = surface_laplacian(points, corners)
    floor = 1e-12 * max(float(mass.mean()), 1e-300)
    force = np.maximum(mass[free], floor) * pull[free]
    matrix = laplacian[free][:, free] + diags_array(force)
    known = np.flatnonzero(fixed)
    right = force[:, None] * target[free] - laplacian[free][:, known] @ target[known]
    found = np.maximum(splu(matrix.tocsc()).solve(right), 0.0)
    rows[free] = found / np.maximum(found.sum(1, keepdims=True), 1e-300)
    return rows
