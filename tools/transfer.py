"""What a mesh carries, moved to another mesh of the same surface by the closest point."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from .meshio import Mesh

_INWARDS = 1e-3  # of the way from a corner of a face to its middle
_BEYOND = 8.0  # barycentric coordinates beyond which the map of a face is not continued


@dataclass(frozen=True, eq=False)
class Closest:
    """Closest surface points."""

    face: Int[np.ndarray, "N"]
    """Face of the source."""
    bary: Float[np.ndarray, "N 3"]
    """Place in the face."""
    distance: Float[np.ndarray, "N"]
    """Distance in the mesh's unit."""


def closest_on(
    points: Float[np.ndarray, "N 3"],
    verts: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
) -> Closest:
    """Closest points of a surface, in double precision, by libigl.

    Args:
        points: where from, (N, 3), finite.
        verts: vertices of the surface, (V, 3), finite.
        faces: its triangles, (F, 3), at least one.

    Returns:
        Face, barycentric coordinates and distance of each.

    >>> flat = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> hit = closest_on(np.array([[0.25, 0.25, 2.0]]), flat, np.array([[0, 1, 2]]))
    >>> hit.bary.tolist(), hit.distance.tolist()
    ([[0.5, 0.25, 0.25]], [2.0])
    """
    import igl

    if len(points) == 0:
        return Closest(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros(0))
    found = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points), np.ascontiguousarray(verts), np.ascontiguousarray(faces)
    )
    squared, face, place = found
    face = np.asarray(face, dtype=np.int64).reshape(-1)
    return Closest(face, _bary(place, verts[faces[face]]), np.sqrt(squared))


def _bary(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Barycentric coordinates of points in their triangles; needles give those of their ends."""
    bary = np.clip(_plane_bary(points, corners), 0, 1)
    return bary / bary.sum(axis=1, keepdims=True)


def _plane_bary(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Barycentric coordinates in the planes of triangles, negative outside of them."""
    ab, ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(ab, ac)
    square = (normal * normal).sum(axis=1)
    offset = points - corners[:, 0]
    safe = np.where(square > 0, square, 1.0)
    v = (np.cross(offset, ac) * normal).sum(axis=1) / safe
    w = (np.cross(ab, offset) * normal).sum(axis=1) / safe
    bary = np.stack([1 - v - w, v, w], axis=1)
    away = np.linalg.norm(corners - points[:, None], axis=2)
    nearest = np.eye(3)[away.argmin(axis=1)]
    return np.where((square > 0)[:, None], bary, nearest)


def transferred(
    verts: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], source: Mesh
) -> Mesh:
    """A new mesh with the weights, colours and texture coordinates of an old one.

    Weights and colours are those of the closest point. A face takes its texture coordinates from
    the one chart that lies closest to its middle, so that no face runs across a seam.

    Args:
        verts: the new vertices, (V, 3).
        faces: the new faces, (F, 3).
        source: where the attributes come from; its vertices are finite.

    Returns:
        The new mesh with the source's skeleton, texture and name.
    """
    hit = closest_on(verts, source.verts, source.faces) if source.num_faces else None

    def at(values: np.ndarray | None) -> np.ndarray | None:
        if values is None or hit is None:
            return None
        return (values[source.faces[hit.face]] * hit.bary[..., None]).sum(axis=1)

    weights = at(source.weights)
    if weights is not None:
        sums = weights.sum(axis=1, keepdims=True)
        weights = np.divide(weights, sums, out=weights, where=sums > 0)
    return Mesh(
        verts,
        faces,
        corner_uv=_corner_uv(verts, faces, source),
        weights=weights,
        skeleton=source.skeleton,
        colors=at(source.colors),
        texture=source.texture,
        name=source.name,
    )


def _corner_uv(verts: np.ndarray, faces: np.ndarray, source: Mesh) -> np.ndarray | None:
    if source.corner_uv is None or not source.num_faces:
        return None
    chart = uv_charts(source.faces, source.corner_uv)
    corners = verts[faces]
    middles = corners.mean(axis=1)
    middle_face = closest_on(middles, source.verts, source.faces).face
    # looked for a little inside of the face, so that a corner on a seam finds the right side of it
    inner = corners + _INWARDS * (middles[:, None] - corners)
    found = np.zeros(faces.shape, dtype=np.int64)
    chosen = chart[middle_face]
    for label in np.unique(chosen).tolist():
        rows = np.flatnonzero(chosen == label)
        among = np.flatnonzero(chart == label)
        hit = closest_on(inner[rows].reshape(-1, 3), source.verts, source.faces[among])
        found[rows] = among[hit.face].reshape(-1, 3)
    uv = _uv_at(corners, found, source)
    # a face that runs over a seam between two sides of one chart goes on as its middle does
    expected = _uv_at(corners, np.repeat(middle_face[:, None], 3, axis=1), source)
    middle = _uv_at(middles[:, None], middle_face[:, None], source)
    reach = np.linalg.norm(expected - middle, axis=2).max(axis=1)
    over = np.linalg.norm(uv - expected, axis=2).max(axis=1) > 2 * reach
    return np.where(over[:, None, None], expected, uv)


def _uv_at(points: np.ndarray, face: np.ndarray, source: Mesh) -> np.ndarray:
    """UVs (n, k, 2) of points (n, k, 3) by the maps of source faces (n, k), also beside them."""
    flat = face.reshape(-1)
    where, corners = points.reshape(-1, 3), source.verts[source.faces[flat]]
    bary = _plane_bary(where, corners)
    far = np.abs(bary).max(axis=1) > _BEYOND
    bary[far] = _bary(where[far], corners[far])
    values = source.corner_uv[flat] if source.corner_uv is not None else np.zeros((len(flat), 3, 2))
    return (values * bary[..., None]).sum(axis=1).reshape(*face.shape, 2)


def uv_charts(
    faces: Int[np.ndarray, "F 3"], corner_uv: Float[np.ndarray, "F 3 2"]
) -> Int[np.ndarray, "F"]:
    """Chart of each face: faces hang together where they share an edge in the picture as well.

    Args:
        faces: vertex indices, (F, 3).
        corner_uv: texture coordinates, (F, 3, 2).

    Returns:
        Chart numbers from 0, (F).

    >>> uv = np.array([[[0.0, 0], [1, 0], [0, 1]], [[1, 0], [1, 1], [0, 1]]])
    >>> uv_charts(np.array([[0, 1, 2], [1, 3, 2]]), uv).tolist()
    [0, 0]
    >>> uv_charts(np.array([[0, 1, 2], [1, 3, 2]]), uv + np.array([0.0, 5])[:, None, None]).tolist()
    [0, 1]
    """
    import igl

    keys = np.concatenate([faces.reshape(-1, 1), corner_uv.reshape(-1, 2)], axis=1)
    _, inverse = np.unique(keys, axis=0, return_inverse=True)
    found = igl.facet_components(np.ascontiguousarray(inverse.reshape(-1, 3)))
    labels = found[1] if isinstance(found, tuple) else found
    return np.asarray(labels, dtype=np.int64).reshape(-1)
