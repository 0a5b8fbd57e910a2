"""What a mesh carries, moved to another mesh of the same surface by the closest point."""

import numpy as np
from jaxtyping import Float, Int

from monopart.geometry.weight_transfer import closest_faces

from .bake_uv import carried_uv
from .meshio import Mesh


def transferred(
    verts: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], source: Mesh
) -> Mesh:
    """A new mesh with the weights, colours and texture coordinates of an old one.

    Weights and colours are those of the closest point, texture coordinates those of one side of
    each seam.

    Args:
        verts: the new vertices, (V, 3).
        faces: the new faces, (F, 3).
        source: where the attributes come from; its vertices are finite.

    Returns:
        The new mesh with the source's skeleton, texture and name; a source without faces gives
        these alone.

    >>> flat = Mesh(np.eye(3), np.array([[0, 1, 2]]), weights=np.ones((3, 1)))
    >>> transferred(np.eye(3) / 2, flat.faces, flat).weights.tolist()
    [[1.0], [1.0], [1.0]]
    """
    new = Mesh(verts, faces, skeleton=source.skeleton, texture=source.texture, name=source.name)
    if not source.num_faces:
        return new
    face, bary, _ = closest_faces(verts, source.verts, source.faces)
    corners = source.faces[face]

    def at(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else (values[corners] * bary[..., None]).sum(axis=1)

    weights = at(source.weights)
    if weights is not None:
        sums = weights.sum(axis=1, keepdims=True)
        weights = np.divide(weights, sums, out=weights, where=sums > 0)
    return Mesh(
        verts,
        faces,
        corner_uv=None if source.corner_uv is None else carried_uv(source, new)[0],
        weights=weights,
        skeleton=source.skeleton,
        colors=at(source.colors),
        texture=source.texture,
        name=source.name,
    )
