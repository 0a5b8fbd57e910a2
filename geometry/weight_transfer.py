"""Skinning weights and other vertex rows from one surface to another, gaps filled smoothly.

A vertex takes the row of the closest point of the source where that is near and faces the same way;
elsewhere rows spread in from those that do. Reference: R. Abdrashitov et al., Robust skin weights
transfer via weight inpainting, 2023 (the idea; here harmonic instead of biharmonic, so that rows
stay within 0 and 1); own code.
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Int

from .bone_heat import solved_rows
from .errors import InputError
from .mesh_graph import check_mesh, components, weld_by_place


def closest_faces(
    points: Float[np.ndarray, "n 3"],
    verts: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Closest surface points in float64, without torch.

    Args:
        points: queries, metres.
        verts: vertices of the surface.
        faces: vertex indices, at least one face.

    Returns:
        Face, barycentrics on it, and distance in metres.

    Raises:
        InputError: no faces, or numbers that are not finite.

    >>> face, bary, distance = closest_faces(np.zeros((1, 3)), np.eye(3), np.array([[0, 1, 2]]))
    >>> bary.round(3), distance.round(3)
    (array([[0.333, 0.333, 0.333]]), array([0.577]))
    """
    import igl

    check_mesh(verts, faces)
    if not len(faces):
        raise InputError("faces: expected at least one triangle, found 0; pass a mesh with faces")
    if not np.isfinite(points).all():
        raise InputError("points: expected finite numbers, found others; clean the mesh")
    if not len(points):
        return np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0)
    found = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points), np.ascontiguousarray(verts), np.ascontiguousarray(faces)
    )
    square, face, near = (np.asarray(x) for x in found[:3])
    face = face.astype(np.int64)
    return face, barycentrics(near, verts[faces[face]]), np.sqrt(np.maximum(square, 0))


def barycentrics(
    points: Float[np.ndarray, "n 3"], triangles: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, "n 3"]:
    """Barycentric coordinates of points of triangles, flat ones included.

    Args:
        points: points on the triangles, up to rounding.
        triangles: corners.

    Returns:
        Coordinates ≥ 0 that sum to 1.

    >>> barycentrics(np.array([[0.5, 0.25, 0]]), np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]]))
    array([[0.25, 0.5 , 0.25]])
    """
    a, u, v = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    w = points - a
    uu = (u * u).sum(1)
    long = np.where(uu > 0, uu, 1.0)
    lean, along = (u * v).sum(1) / long, (u * w).sum(1) / long
    height = v - lean[:, None] * u  # the part of v across u: determinants would cancel to nothing
    square = (height * height).sum(1)
    by_v = (height * (w - along[:, None] * u)).sum(1) / np.where(square > 0, square, 1.0)
    by_u = along - by_v * lean
    inside = np.clip(np.stack([1 - by_u - by_v, by_u, by_v], 1), 0.0, None)
    tries = [inside / inside.sum(1, keepdims=True)]
    for k in range(3):  # of a needle the coordinates are rounding: then an edge is nearer
        start, edge = triangles[:, k], triangles[:, (k + 1) % 3] - triangles[:, k]
        length = (edge * edge).sum(1)
        share = ((points - start) * edge).sum(1) / np.where(length > 0, length, 1.0)
        on_edge = np.zeros((len(points), 3))
        on_edge[:, (k + 1) % 3] = np.clip(share, 0.0, 1.0)
        on_edge[:, k] = 1 - on_edge[:, (k + 1) % 3]
        tries.append(on_edge)
    every = np.stack(tries, 1)
    gap = np.linalg.norm(every @ triangles - points[:, None], axis=2)
    gap[:, 0] = np.nan_to_num(gap[:, 0], nan=np.inf)
    return every[np.arange(len(points)), gap.argmin(1)]


def corner_normals(
    verts: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "v 3"]:
    """Unit vertex normals, weighted by area; zero where there is none.

    Args:
        verts: vertices.
        faces: vertex indices, wound outwards.

    Returns:
        Normals; vertices at one place share theirs.

    >>> corner_normals(np.eye(3), np.array([[0, 1, 2]]))[0].round(3)
    array([0.577, 0.577, 0.577])
    """
    a, b, c = np.moveaxis(verts[faces], 1, 0)
    first = weld_by_place(verts)
    total = np.zeros((len(verts), 3))
    np.add.at(total, first[faces], np.cross(b - a, c - a)[:, None])
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return (total / np.where(length > 0, length, 1.0))[first]


def transfer_rows(
    rows: Float[np.ndarray, "r k"],
    source: tuple[Float[np.ndarray, "s 3"], Int[np.ndarray, "g 3"]],
    target: tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]],
    max_distance: float = math.inf,
    max_angle: float = math.pi / 3,
) -> tuple[Float[np.ndarray, "v k"], Bool[np.ndarray, "v"]]:
    """Rows of the vertices of one mesh, carried to those of another that lies on it.

    Args:
        rows: weights or the like; rows ≥ 0 that sum to 1 stay so.
        source: vertices (metres) and faces of the mesh that has rows.
        target: vertices and faces of the mesh that gets them, in the same frame.
        max_distance: a source farther away gives nothing, metres.
        max_angle: nor one whose normal differs by more, radians.

    Returns:
        Rows of the target's vertices, and which were taken from the source; the others were filled
        in from their neighbours, or taken from the closest point where a piece has no neighbour.

    Raises:
        InputError: empty or damaged meshes, or rows that do not fit the source.

    >>> mesh = (np.eye(3), np.array([[0, 1, 2]]))
    >>> transfer_rows(np.eye(3), mesh, mesh)[0].round(6).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    check_mesh(*target)
    if len(rows) != len(source[0]) or not np.isfinite(rows).all():
        raise InputError(
            f"rows: expected finite ones for {len(source[0])} vertices (the source's), found "
            f"{len(rows)}; pass the weights of this mesh"
        )
    verts, faces = target
    face, bary, distance = closest_faces(verts, *source)
    corners = source[1][face]
    taken = (bary[..., None] * rows[corners]).sum(1)
    their = (bary[..., None] * corner_normals(*source)[corners]).sum(1)
    ours = corner_normals(verts, faces)
    size = np.linalg.norm(their, axis=1) * np.linalg.norm(ours, axis=1)
    same_way = (their * ours).sum(1) >= math.cos(max_angle) * size
    good = (distance <= max_distance) & same_way
    return _filled(taken, good, verts, faces), good


def _filled(
    taken: np.ndarray, good: np.ndarray, verts: np.ndarray, faces: np.ndarray
) -> np.ndarray:
    """Rows where good; elsewhere harmonic over the surface, between the good ones."""
    if good.all() or not len(faces):
        return taken
    first = weld_by_place(verts)
    used, row = np.unique(first, return_inverse=True)
    corners = row[faces]
    pieces = components(len(used), np.sort(corners[:, [0, 1, 1, 2]].reshape(-1, 2), 1))
    sure = good[used]
    known = np.bincount(pieces, sure, len(used))[pieces] > 0
    pull = np.where(sure | ~known, np.inf, 0.0)
    total = taken[used].sum(1, keepdims=True)
    filled = solved_rows(verts[used], corners, pull, taken[used] / np.where(total > 0, total, 1.0))
    filled = np.where((pull > 0)[:, None], taken[used], filled)
    return filled[row]
