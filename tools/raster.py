"""A small rasteriser for pictures of meshes: depth buffer, barycentric coordinates, numpy alone."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

_CHUNK = 1 << 21  # candidate pixels that are looked at together


@dataclass(frozen=True, eq=False)
class Raster:
    """What each pixel shows."""

    face: Int[np.ndarray, "H W"]
    """Face, -1 where there is none."""
    bary: Float[np.ndarray, "H W 3"]
    """Place in the face."""

    def of_corners(self, values: Float[np.ndarray, "F 3 C"]) -> Float[np.ndarray, "H W C"]:
        """Values of the corners of the faces, interpolated at each pixel; 0 where no face is."""
        inside = self.face >= 0
        out = np.zeros((*self.face.shape, values.shape[-1]))
        out[inside] = (values[self.face[inside]] * self.bary[inside][..., None]).sum(axis=1)
        return out


def rasterise(
    corners: Float[np.ndarray, "F 3 2"],
    depth: Float[np.ndarray, "F 3"],
    height: int,
    width: int,
) -> Raster:
    """Which triangle is nearest at the middle of each pixel.

    Args:
        corners: pixel coordinates (x, y) of the corners, x to the right and y down, (F, 3, 2).
        depth: of the corners; the smallest is seen, (F, 3).
        height: of the picture.
        width: of the picture.

    Returns:
        Face and place of each pixel; triangles with NaN or without area are left out, the first of
        equals is seen.

    >>> corners = np.array([[[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]]])
    >>> rasterise(corners, np.zeros((1, 3)), 2, 3).face.tolist()
    [[0, 0, 0], [0, 0, 0]]
    """
    nearest = np.full(height * width, np.inf)
    face = np.full(height * width, -1, dtype=np.int64)
    bary = np.zeros((height * width, 3))
    area = _cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    drawn = np.flatnonzero(np.isfinite(area) & (area != 0) & np.isfinite(depth).all(axis=1))
    for rows, x, y in _candidates(corners, drawn, height, width):
        place = np.stack([x + 0.5, y + 0.5], axis=1)
        a, b, c = (corners[rows, k] - place for k in range(3))
        weights = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=1) / area[rows, None]
        inside = (weights >= 0).all(axis=1)
        seen, weights = rows[inside], weights[inside]
        pixel = (y * width + x)[inside]
        away = (weights * depth[seen]).sum(axis=1)
        before = nearest[pixel]
        np.minimum.at(nearest, pixel, away)
        closer = np.flatnonzero((away == nearest[pixel]) & (away < before))[::-1]  # first of equals
        face[pixel[closer]], bary[pixel[closer]] = seen[closer], weights[closer]
    return Raster(face.reshape(height, width), bary.reshape(height, width, 3))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore", over="ignore"):
        return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _candidates(
    corners: np.ndarray, drawn: np.ndarray, height: int, width: int
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Chunks of (face, x, y) of the pixels in the boxes of the triangles."""
    limit = np.array([width, height])
    low = np.clip(np.ceil(corners[drawn].min(axis=1) - 0.5), 0, limit).astype(np.int64)
    high = np.clip(np.floor(corners[drawn].max(axis=1) - 0.5) + 1, 0, limit).astype(np.int64)
    size = np.maximum(high - low, 0)
    count = size.prod(axis=1)
    some = np.flatnonzero(count)
    ends = np.cumsum(count[some])
    start = 0
    while start < len(some):
        before = ends[start - 1] if start else 0
        stop = max(int(np.searchsorted(ends, before + _CHUNK)), start + 1)
        chosen = some[start:stop]
        numbers = count[chosen]
        inner = np.arange(numbers.sum()) - np.repeat(np.cumsum(numbers) - numbers, numbers)
        which = np.repeat(chosen, numbers)
        wide = size[which, 0]
        yield drawn[which], low[which, 0] + inner % wide, low[which, 1] + inner // wide
        start = stop
