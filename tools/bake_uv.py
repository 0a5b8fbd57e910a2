"""Texture coordinates of one mesh for the faces of another, on the right side of every seam."""

import numpy as np
from jaxtyping import Float, Int

from monopart.geometry.mesh_graph import components, weld_by_place
from monopart.geometry.weight_transfer import barycentrics, closest_faces

from .meshio import Mesh

_INWARDS = 1e-3  # corners are looked up this share nearer to the middle of their face
_STRETCH = 2.0  # a step in the texture longer than this times what it should be crosses a seam


def _uv(mesh: Mesh) -> np.ndarray:
    return np.zeros((mesh.num_faces, 3, 2)) if mesh.corner_uv is None else mesh.corner_uv


def uv_neighbours(mesh: Mesh) -> Int[np.ndarray, "E 2"]:
    """Pairs of faces that share an edge in space and in the texture.

    Args:
        mesh: has texture coordinates.

    Returns:
        Pairs of face indices; faces at a seam are no pair.

    >>> uv = np.array([[[0.0, 0], [1, 0], [0, 1]], [[1, 0], [1, 1], [0, 1]]])
    >>> verts = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    >>> uv_neighbours(Mesh(verts, np.array([[0, 1, 2], [1, 3, 2]]), corner_uv=uv))
    array([[0, 1]])
    """
    place = weld_by_place(mesh.verts)[mesh.faces]
    key = np.concatenate([place[..., None].astype(float), _uv(mesh)], 2).reshape(-1, 3)
    corner = np.unique(key, axis=0, return_inverse=True)[1].reshape(-1, 3)
    ends = np.sort(corner[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    name = np.unique(ends, axis=0, return_inverse=True)[1].reshape(-1)
    face = np.repeat(np.arange(mesh.num_faces), 3)
    order = np.argsort(name, kind="stable")
    same = name[order][1:] == name[order][:-1]
    return np.stack([face[order][:-1][same], face[order][1:][same]], 1)


def uv_charts(mesh: Mesh) -> Int[np.ndarray, "F"]:
    """Chart of each face: those that hang together in the texture.

    Args:
        mesh: has texture coordinates.

    Returns:
        Numbers from 0.

    >>> uv = np.zeros((2, 3, 2)) + np.arange(2)[:, None, None]
    >>> uv_charts(Mesh(np.eye(4)[:, :3], np.array([[0, 1, 2], [1, 3, 2]]), corner_uv=uv))
    array([0, 1])
    """
    chart = components(mesh.num_faces, uv_neighbours(mesh))
    return np.unique(chart, return_inverse=True)[1].reshape(-1)


def _stretch(mesh: Mesh) -> np.ndarray:
    """Largest ratio of length in the texture to length in space, of the edges of each face."""
    uv, corner = _uv(mesh), mesh.verts[mesh.faces]
    wide = np.linalg.norm(uv - np.roll(uv, 1, 1), axis=2)
    long = np.linalg.norm(corner - np.roll(corner, 1, 1), axis=2)
    return (wide / np.maximum(long, 1e-300)).max(1)


def carried_uv(
    source: Mesh, target: Mesh
) -> tuple[Float[np.ndarray, "F 3 2"], Float[np.ndarray, "F 3"], int]:
    """Texture coordinates of the source for the corners of the target's faces.

    Args:
        source: has texture coordinates and faces.
        target: has faces.

    Returns:
        Coordinates, distance of each corner to the point it took them from, and the number of faces
        at or across a seam, which were looked up by walking over the source from their middle.
    """
    corners = target.verts[target.faces]
    middle = corners.mean(1)
    home = closest_faces(middle, source.verts, source.faces)[0]
    inner = corners + _INWARDS * (middle[:, None] - corners)
    face = closest_faces(inner.reshape(-1, 3), source.verts, source.faces)[0]
    uv, gap = _at(source, face, corners.reshape(-1, 3))
    uv, gap, face = uv.reshape(-1, 3, 2), gap.reshape(-1, 3), face.reshape(-1, 3)
    odd = np.flatnonzero(_crossing(source, (home, face), (middle, corners), uv))
    links = _Links(uv_neighbours(source), source)
    low, high = _uv(source).min((0, 1)), _uv(source).max((0, 1))  # beyond them there is no picture
    for row in odd:
        patch = links.around(int(home[row]), middle[row], corners[row])
        near = closest_faces(inner[row], source.verts, source.faces[patch])[0]
        uv[row], gap[row] = _at(source, patch[near], corners[row])
        # around a thin limb the walk comes back to the other side of the seam
        expected, centre = _continued(source, int(home[row]), corners[row])
        reach = np.linalg.norm(expected - centre, axis=1).max()
        if np.linalg.norm(uv[row] - expected, axis=1).max() > _STRETCH * reach:
            uv[row] = np.clip(expected, low, high)
    return uv, gap, len(odd)


def _continued(source: Mesh, face: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates of points by the map of one face, also beyond it; and of their middle."""
    corner, uv = source.verts[source.faces[face]], _uv(source)[face]
    sides = np.stack([corner[1] - corner[0], corner[2] - corner[0]], 1)
    away = np.linalg.lstsq(sides, (points - corner[0]).T, rcond=None)[0].T
    found = uv[0] + away @ (uv[1:] - uv[0])
    return found, found.mean(0)


def _at(source: Mesh, face: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates on known faces nearest to points, and the distance."""
    corner = source.verts[source.faces[face]]
    bary = barycentrics(points, corner)
    gap = np.linalg.norm((bary[..., None] * corner).sum(1) - points, axis=1)
    return (bary[..., None] * _uv(source)[face]).sum(1), gap


def _crossing(
    source: Mesh,
    faces: tuple[np.ndarray, np.ndarray],
    points: tuple[np.ndarray, np.ndarray],
    uv: np.ndarray,
) -> np.ndarray:
    """Faces with a corner in another chart than their middle, or too far off in the texture."""
    home, face = faces
    middle, corners = points
    chart, stretch = uv_charts(source), _stretch(source)
    centre = _at(source, home, middle)[0]
    step = np.linalg.norm(uv - centre[:, None], axis=2)
    way = np.linalg.norm(corners - middle[:, None], axis=2)
    limit = _STRETCH * np.maximum(stretch[home][:, None], stretch[face]) * way
    other = chart[face] != chart[home][:, None]
    return (other | (step > limit)).any(1)


class _Links:
    """Faces around a face, without crossing a seam."""

    def __init__(self, pairs: np.ndarray, source: Mesh) -> None:
        both = np.concatenate([pairs, pairs[:, ::-1]])
        both = both[np.argsort(both[:, 0], kind="stable")]
        self.start = np.searchsorted(both[:, 0], np.arange(source.num_faces + 1))
        self.next = both[:, 1]
        self.corner = source.verts[source.faces]

    def around(self, home: int, middle: np.ndarray, corners: np.ndarray) -> np.ndarray:
        """Faces reached from `home` that come as near to the middle as the corners are."""
        edge = np.linalg.norm(self.corner[home] - np.roll(self.corner[home], 1, 0), axis=1).max()
        reach = float(np.linalg.norm(corners - middle, axis=1).max() + edge)
        found, todo = {home}, [home]
        while todo:
            face = todo.pop()
            for other in self.next[self.start[face] : self.start[face + 1]].tolist():
                if other not in found:
                    away = np.linalg.norm(self.corner[other] - middle, axis=1).min()
                    if away <= reach:
                        found.add(other)
                        todo.append(other)
        return np.array(sorted(found))
