"""Carry what one mesh has to another that lies on it: weights, texture coordinates, colours.

Both meshes are in one frame. A target point takes what the closest point of the source has.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from monopart.geometry.errors import InputError
from monopart.geometry.weight_transfer import closest_faces, transfer_rows

from .bake_uv import carried_uv
from .meshio import Mesh
from .pictures import covered

_GUTTER = 8


@dataclass(frozen=True)
class BakeReport:
    """How well the target lies on the source."""

    what: str
    """What was carried."""
    count: int
    """Points (vertices, corners of faces, texels) that took something."""
    taken: int
    """Of these, those that took it from the source; the others were filled in."""
    mean_distance: float
    """Mean distance to the source, in the unit of the meshes."""
    max_distance: float
    """Largest distance to the source."""
    notes: tuple[str, ...] = ()
    """What to doubt."""


def _report(
    what: str, distance: np.ndarray, taken: int | None = None, notes: tuple[str, ...] = ()
) -> BakeReport:
    count = len(distance)
    mean = float(distance.mean()) if count else 0.0
    largest = float(distance.max(initial=0.0))
    return BakeReport(what, count, count if taken is None else taken, mean, largest, notes)


def bake_weights(
    source: Mesh,
    target: Mesh,
    *,
    max_distance: float = math.inf,
    max_angle: float = math.pi / 3,
) -> tuple[Mesh, BakeReport]:
    """The target with the skinning weights and the skeleton of the source.

    Args:
        source: has weights.
        target: a mesh in the same frame and pose.
        max_distance: vertices farther from the source are filled in from their neighbours.
        max_angle: likewise those whose normals differ by more, radians.

    Returns:
        The mesh, rows of its weights ≥ 0 and of sum 1, and the report.

    Raises:
        InputError: no weights, weights that are negative or not finite, or a damaged mesh.

    >>> flat = Mesh(np.eye(3), np.array([[0, 1, 2]]), weights=np.ones((3, 1)))
    >>> bake_weights(flat, Mesh(np.eye(3) / 2, flat.faces))[0].weights.tolist()
    [[1.0], [1.0], [1.0]]
    """
    source.require(weights=True)
    target.require()
    rows = source.weights
    if rows is None or not np.isfinite(rows).all() or rows.min(initial=0.0) < 0:
        raise InputError(
            f"{source.name}: weights: expected finite numbers ≥ 0, found others; "
            "look at them with monopart-mesh check"
        )
    total = rows.sum(1, keepdims=True)
    if not (total > 0).all():
        raise InputError(
            f"{source.name}: weights: expected some at every vertex, found "
            f"{int((total <= 0).sum())} vertices without; weight them first"
        )
    meshes = (source.verts, source.faces), (target.verts, target.faces)
    found, good = transfer_rows(rows / total, *meshes, max_distance, max_angle)
    found /= found.sum(1, keepdims=True)
    distance = closest_faces(target.verts, *meshes[0])[2]
    baked = dataclasses.replace(target, weights=found, skeleton=source.skeleton)
    return baked, _report("weights", distance, int(good.sum()))


def bake_uv(source: Mesh, target: Mesh) -> tuple[Mesh, BakeReport]:
    """The target with the texture coordinates of the source; no face spans a seam.

    A face takes the side of the seam that its middle lies on; corners beyond the seam end on it.

    Args:
        source: has texture coordinates.
        target: a mesh in the same frame.

    Returns:
        The mesh, with the source's texture, and the report over all corners.

    Raises:
        InputError: no texture coordinates, or a damaged mesh.

    >>> uv = np.array([[[0.0, 0], [1, 0], [0, 1]]])
    >>> flat = Mesh(np.eye(3), np.array([[0, 1, 2]]), corner_uv=uv)
    >>> bake_uv(flat, flat)[0].corner_uv.round(6).tolist()
    [[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]]
    """
    source.require(uv=True)
    target.require()
    found, distance, walked = carried_uv(source, target)
    baked = dataclasses.replace(target, corner_uv=found, texture=source.texture)
    notes = (f"{walked} faces lie at or across a seam",) if walked else ()
    return baked, _report("texture coordinates", distance.reshape(-1), notes=notes)


def looked_up(image: Float[np.ndarray, "h w 3"], uv: Float[np.ndarray, "n 2"]) -> np.ndarray:
    """Colours of a texture at coordinates, bilinear between the middles of texels.

    Args:
        image: sRGB in [0, 1], row 0 at v = 1.
        uv: coordinates; outside the unit square the border goes on.

    Returns:
        [N, 3] sRGB.

    >>> looked_up(np.stack([np.zeros((1, 3)), np.ones((1, 3))]), np.array([[0.5, 0.5]]))
    array([[0.5, 0.5, 0.5]])
    """
    height, width = image.shape[:2]
    x = np.clip(uv[:, 0] * width - 0.5, 0, width - 1)
    y = np.clip((1 - uv[:, 1]) * height - 0.5, 0, height - 1)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right, low = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    across, down = (x - left)[:, None], (y - top)[:, None]
    upper = (1 - across) * image[top, left] + across * image[top, right]
    lower = (1 - across) * image[low, left] + across * image[low, right]
    return (1 - down) * upper + down * lower


def _colors_at(source: Mesh, face: np.ndarray, bary: np.ndarray) -> np.ndarray:
    """Colours of surface points: from the texture, else from the vertices."""
    if source.texture is not None and source.corner_uv is not None:
        uv = (bary[..., None] * source.corner_uv[face]).sum(1)
        return looked_up(source.texture, uv)
    if source.colors is None:
        raise InputError(
            f"{source.name}: colours: expected a texture with its coordinates or vertex colours, "
            "found neither; give a coloured mesh"
        )
    return (bary[..., None] * source.colors[source.faces[face]]).sum(1)


def bake_colors(source: Mesh, target: Mesh) -> tuple[Mesh, BakeReport]:
    """The target with a colour at each vertex, from the texture or the vertices of the source.

    Args:
        source: has a texture with its coordinates, or vertex colours.
        target: a mesh in the same frame.

    Returns:
        The mesh and the report.

    Raises:
        InputError: the source has no colours, or a mesh is damaged.

    >>> red = Mesh(np.eye(3), np.array([[0, 1, 2]]), colors=np.eye(3)[[0, 0, 0]])
    >>> bake_colors(red, red)[0].colors[0].round(6).tolist()
    [1.0, 0.0, 0.0]
    """
    source.require()
    target.require(faces=False)
    face, bary, distance = closest_faces(target.verts, source.verts, source.faces)
    colors = _colors_at(source, face, bary)
    return dataclasses.replace(target, colors=colors), _report("vertex colours", distance)


def bake_texture(
    source: Mesh, target: Mesh, size: int = 1024, gutter: int = _GUTTER
) -> tuple[Mesh, BakeReport]:
    """The target with a texture in its own coordinates, coloured by the source.

    Texels whose middle a face covers take the colour of the closest source point; texels around
    them, to the width of the gutter, that of the nearest such texel.

    Args:
        source: has a texture with its coordinates, or vertex colours.
        target: has texture coordinates in the unit square.
        size: rows and columns.
        gutter: texels around the charts that are filled, so that filters find no ground.

    Returns:
        The mesh and the report; its count is that of covered texels.

    Raises:
        InputError: no colours, no coordinates, a size below 1, or a damaged mesh.

    >>> uv = np.array([[[0.0, 0], [1, 0], [0, 1]]])
    >>> red = Mesh(np.eye(3), np.array([[0, 1, 2]]), corner_uv=uv, colors=np.eye(3)[[0, 0, 0]])
    >>> bake_texture(red, red, 4)[0].texture[3, 0].round(6).tolist()
    [1.0, 0.0, 0.0]
    """
    from scipy.ndimage import distance_transform_edt

    source.require()
    target.require(uv=True)
    uv = target.corner_uv
    if size < 1 or gutter < 0 or uv is None or not np.isfinite(uv).all():
        raise InputError(
            f"{target.name}: texture: expected a size ≥ 1, a gutter ≥ 0 and finite texture "
            f"coordinates, found size {size}, gutter {gutter}; correct them"
        )
    screen = np.stack([uv[..., 0], 1 - uv[..., 1]], 2) * size
    seen = covered(screen, np.zeros((target.num_faces, 3)), (size, size))
    rows, cols = np.nonzero(seen >= 0)
    face = seen[rows, cols]
    points = _on_faces(
        np.stack([cols, rows], 1) + 0.5, screen[face], target.verts[target.faces[face]]
    )
    hit, bary, distance = closest_faces(points, source.verts, source.faces)
    image = np.zeros((size, size, 3))
    image[rows, cols] = _colors_at(source, hit, bary)
    if len(rows) and gutter:
        nearest = np.asarray(
            distance_transform_edt(seen < 0, return_distances=False, return_indices=True)
        )
        away = np.hypot(*(nearest - np.indices(seen.shape)))
        fill = (away > 0) & (away <= gutter)
        image[fill] = image[nearest[0][fill], nearest[1][fill]]
    notes = () if len(rows) else ("no texel is covered: the size is too small or the uv is empty",)
    return dataclasses.replace(target, texture=image), _report("texels", distance, notes=notes)


def _on_faces(pixels: np.ndarray, screen: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Surface points of pixels [N, 2] inside texture triangles [N, 3, 2]; exact inside."""
    a, u, v = screen[:, 0], screen[:, 1] - screen[:, 0], screen[:, 2] - screen[:, 0]
    w = pixels - a
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    by_u = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / area
    by_v = (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0]) / area
    share = np.stack([1 - by_u - by_v, by_u, by_v], 1)
    return (share[..., None] * corners).sum(1)
