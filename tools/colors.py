"""Colours of pictures: parts, heat, checker board, texture; the distortion that heat shows."""

import numpy as np
from jaxtyping import Float, Int

from .meshio import Mesh
from .pictures import part_colors

PLAIN = np.array([0.72, 0.74, 0.78])
"""What has no colour of its own."""
_HEAT = np.array(
    [
        [0.19, 0.25, 0.55],
        [0.25, 0.55, 0.75],
        [0.75, 0.85, 0.65],
        [0.95, 0.65, 0.25],
        [0.7, 0.1, 0.1],
    ]
)


def part_color(part: Int[np.ndarray, "*b"]) -> Float[np.ndarray, "*b 3"]:
    """Colours of parts, sRGB; they repeat after 24, negative numbers are grey.

    Args:
        part: part numbers.

    Returns:
        Colours in [0, 1].

    >>> part_color(np.array([0, -1])).tolist()
    [[0.0, 0.45, 0.7], [0.72, 0.74, 0.78]]
    """
    part = np.asarray(part)
    table = part_colors(24)
    return np.where((part < 0)[..., None], PLAIN, table[part % len(table)])


def heat_color(
    values: Float[np.ndarray, "*b"], low: float, high: float
) -> Float[np.ndarray, "*b 3"]:
    """Colours from blue (`low`) over green to red (`high` and above); NaN is grey.

    Args:
        values: numbers.
        low: the bluest.
        high: the reddest.

    Returns:
        Colours in [0, 1].
    """
    known = ~np.isnan(values)
    place = np.clip((np.where(known, values, low) - low) / max(high - low, 1e-12), 0, 1)
    place = place * (len(_HEAT) - 1)
    start = np.minimum(place.astype(np.int64), len(_HEAT) - 2)
    part = (place - start)[..., None]
    colors = _HEAT[start] * (1 - part) + _HEAT[start + 1] * part
    return np.where(known[..., None], colors, PLAIN)


def checker_color(uv: Float[np.ndarray, "*b 2"], squares: int = 48) -> Float[np.ndarray, "*b 3"]:
    """A checker board in the unit square, tinted so that places can be told apart.

    Args:
        uv: texture coordinates.
        squares: along each side.

    Returns:
        Colours in [0, 1].
    """
    uv = np.nan_to_num(uv)
    cell = np.floor(uv * squares)
    odd = (cell.sum(axis=-1) % 2)[..., None]
    tint = np.stack([uv[..., 0] % 1, uv[..., 1] % 1, 1 - uv[..., 0] % 1], axis=-1)
    return 0.35 + 0.4 * odd + 0.25 * tint


def texture_color(
    texture: Float[np.ndarray, "H W 3"], uv: Float[np.ndarray, "*b 2"]
) -> Float[np.ndarray, "*b 3"]:
    """Nearest texel, repeated beyond the unit square.

    Args:
        texture: row 0 at v = 1.
        uv: texture coordinates.

    Returns:
        Colours.
    """
    height, width = texture.shape[:2]
    uv = np.nan_to_num(uv) % 1
    column = np.minimum((uv[..., 0] * width).astype(np.int64), width - 1)
    row = np.minimum(((1 - uv[..., 1]) * height).astype(np.int64), height - 1)
    return texture[np.clip(row, 0, height - 1), column]


def unit_box(verts: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
    """Points moved to the middle and scaled to a box of side 1.

    Args:
        verts: (V, 3).

    Returns:
        The same, what is not finite as it was; all NaN where nothing is finite.
    """
    finite = verts[np.isfinite(verts).all(axis=1)]
    if not len(finite):
        return np.full_like(verts, np.nan)
    with np.errstate(over="ignore", invalid="ignore"):
        low, high = finite.min(axis=0), finite.max(axis=0)
        size = max(float((high / 2 - low / 2).max()), 1e-300)
        return (verts / size - (high / 2 + low / 2) / size) / 2


def face_distortion(mesh: Mesh) -> Float[np.ndarray, "F"]:
    """Symmetric Dirichlet energy of each face, 4 where nothing is stretched; areas add up to 1.

    Args:
        mesh: with texture coordinates.

    Returns:
        s₁² + s₂² + 1/s₁² + 1/s₂² of the singular values of the map from the surface, scaled as a
        whole so that both areas agree; infinite where a face has no area or is flipped, NaN where
        the mesh has none.

    Reference:
        Smith and Schaefer 2015, equation 3.
    """
    if mesh.corner_uv is None or not mesh.num_faces:
        return np.zeros(0)
    with np.errstate(all="ignore"):
        corners = unit_box(mesh.verts)[mesh.faces]
        e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        x1 = np.linalg.norm(e1, axis=1)
        x2 = (e1 * e2).sum(axis=1) / x1
        y2 = np.linalg.norm(np.cross(e1, e2), axis=1) / x1
        u1, u2 = (mesh.corner_uv[:, k] - mesh.corner_uv[:, 0] for k in (1, 2))
        du = u1 / x1[:, None]
        dv = (u2 - du * x2[:, None]) / y2[:, None]
        area = x1 * y2
        det = du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]
        good = np.isfinite(det) & (area > 0)
        scale = (np.abs(det) * area)[good].sum() / area[good].sum()
        square = (du**2).sum(axis=1) + (dv**2).sum(axis=1)
        energy = square / scale + square * scale / det**2
        return np.where(good, np.where(det > 0, energy, np.inf), np.nan)
