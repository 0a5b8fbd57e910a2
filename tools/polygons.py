"""Polygons of mesh files, cut into triangles."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int


def fan_corners(sizes: Int[np.ndarray, "P"]) -> tuple[Int[np.ndarray, "F 3"], int]:
    """Cut polygons into fans from their first corner.

    Args:
        sizes: number of corners of each polygon; corners of all polygons are numbered in a row.

    Returns:
        Corner numbers of each triangle, (F, 3), polygon by polygon, and the number of polygons that
        were left out because they have fewer than three corners.

    >>> fan_corners(np.array([4, 2, 3]))[0].tolist()
    [[0, 1, 2], [0, 2, 3], [6, 7, 8]]
    """
    sizes = np.asarray(sizes, dtype=np.int64)
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]]) if len(sizes) else sizes
    triangles = np.maximum(sizes - 2, 0)
    first = np.repeat(starts, triangles)
    offset = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    corners = np.stack([first, first + offset + 1, first + offset + 2], axis=1)
    return corners.reshape(-1, 3), int((sizes < 3).sum())


def fan_notes(sizes: Int[np.ndarray, "P"], dropped: int) -> tuple[str, ...]:
    """What cutting polygons has done, in words.

    Args:
        sizes: number of corners of each polygon.
        dropped: number of polygons that were left out.

    Returns:
        One line for each kind of change.

    >>> fan_notes(np.array([4, 3]), 0)
    ('polygons: 1 of 2 cut into triangles',)
    """
    cut = int((np.asarray(sizes) > 3).sum())
    notes: Sequence[str] = [f"polygons: {cut} of {len(sizes)} cut into triangles"] if cut else []
    if dropped:
        notes = [*notes, f"polygons: {dropped} with fewer than three corners left out"]
    return tuple(notes)
