"""The body that ships with the package, posed and laid on a mesh without a rig; numpy, no torch.

A person is scanned with the arms out, half down or down. The body is tried in a few such poses; the
one that fits best is then bent on, until the surfaces are nearest.
"""

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

from monopart.geometry.alignment import Similarity, align_to_best, iterated, surface_points

from .meshio import Mesh, Skeleton

_ARMS = (0.0, 0.45, 0.9, 1.3)  # radians that the arms are lowered by in the first tries
_POINTS, _STEPS = 1000, 6  # of an alignment during the search
_ROUNDS = 3  # of the search over angles, each with half the step of the one before


def bent(
    mesh: Mesh, skeleton: Skeleton, turns: Mapping[str, Float[np.ndarray, "3 3"]]
) -> Float[np.ndarray, "V 3"]:
    """Vertices of a rigged mesh after turns of some joints, by linear blend skinning.

    Args:
        mesh: has weights.
        skeleton: its joints in the rest pose.
        turns: joint name → rotation about the joint; the others keep still.

    Returns:
        Posed vertices.

    >>> bones = Skeleton(("a",), (-1,), np.zeros((1, 3)))
    >>> one = Mesh(np.eye(3), np.array([[0, 1, 2]]), weights=np.ones((3, 1)))
    >>> bent(one, bones, {"a": -np.eye(3)})[0].tolist()
    [-1.0, 0.0, 0.0]
    """
    maps = np.zeros((len(skeleton.parents), 3, 4))
    for joint, parent in enumerate(skeleton.parents):
        turn = turns.get(skeleton.names[joint], np.eye(3))
        place = skeleton.joints[joint]
        local = np.concatenate([turn, (place - turn @ place)[:, None]], 1)
        if parent < 0:
            maps[joint] = local
        else:
            above = maps[parent]
            maps[joint] = above[:, :3] @ local
            maps[joint, :, 3] += above[:, 3]
    weights = np.zeros((mesh.num_verts, 0)) if mesh.weights is None else mesh.weights
    blended = np.einsum("vj,jab->vab", weights, maps)
    return np.einsum("vab,vb->va", blended[..., :3], mesh.verts) + blended[..., 3]


def _about_z(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def person(body: Mesh, arms: float = 0.0, legs: float = 0.0) -> Float[np.ndarray, "V 3"]:
    """Our body with lowered arms and spread legs, the same left and right.

    Args:
        body: the body of the package.
        arms: angle that the arms are lowered by, radians; 0 is straight out.
        legs: angle that each leg is spread by, radians.

    Returns:
        Vertices, metres.
    """
    bones = body.skeleton
    if bones is None:
        return body.verts
    turns = {
        "left_shoulder": _about_z(-arms),
        "right_shoulder": _about_z(arms),
        "left_hip": _about_z(legs),
        "right_hip": _about_z(-legs),
    }
    return bent(body, bones, turns)


def fitted_person(
    body: Mesh, verts: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "V 3"], Similarity]:
    """Our body in the pose in which it fits a mesh best, and the mesh's way onto it.

    Args:
        body: the body of the package.
        verts: vertices of the mesh, in any unit, axes and place.
        faces: vertex indices.

    Returns:
        Posed vertices of our body, and the similarity that lays the mesh on them.

    Raises:
        InputError: an empty or damaged mesh, or one without area.
    """
    poses = [(person(body, arms), body.faces) for arms in _ARMS]
    first, found = align_to_best((verts, faces), poses)
    arms = _ARMS[first]
    points = surface_points(verts, faces, _POINTS)
    angles, best = np.array([arms, 0.0]), math.inf

    def fit(candidate: np.ndarray, start: Similarity) -> Similarity:
        posed = person(body, float(candidate[0]), float(candidate[1]))
        return iterated(start, points, surface_points(posed, body.faces, _POINTS), _STEPS)

    found = fit(angles, found)
    best = found.residual
    for step in 0.2 * 0.5 ** np.arange(_ROUNDS):
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            moved = angles.copy()
            moved[axis] += sign * step
            other = fit(moved, found)
            if other.residual < best:
                angles, best, found = moved, other.residual, other
    posed = person(body, float(angles[0]), float(angles[1]))
    return posed, found
