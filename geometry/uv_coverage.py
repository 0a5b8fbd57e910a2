"""Cells of a grid that triangles cover, with a margin."""

import numpy as np
from jaxtyping import Bool, Float


def coverage(
    corner: Float[np.ndarray, "F 3 2"], gap: float
) -> tuple[Bool[np.ndarray, "h w"], Float[np.ndarray, "2"]]:
    """Cells of a unit grid that come nearer than a gap to some triangles; a few more at corners.

    Args:
        corner: corners of the triangles in cells, in any order of turn.
        gap: distance, cells.

    Returns:
        The mask (rows are v) and the coordinates of its lower left corner.
    """
    low = np.floor(corner.min((0, 1)) - gap)
    corner = corner - low
    first = np.floor(corner.min(1) - gap).astype(np.int64)
    last = np.floor(corner.max(1) + gap).astype(np.int64)
    wide = last - first + 1
    number = wide[:, 0] * wide[:, 1]
    face = np.repeat(np.arange(len(corner)), number)
    rank = np.arange(len(face)) - np.repeat(np.cumsum(number) - number, number)
    cell = np.stack(
        [first[face, 0] + rank % wide[face, 0], first[face, 1] + rank // wide[face, 0]], 1
    )
    middle = cell + 0.5
    side = np.roll(corner, -1, 1) - corner
    turned = np.sign(side[:, 0, 0] * side[:, 1, 1] - side[:, 0, 1] * side[:, 1, 0])
    inside = np.ones(len(face), bool)
    for k in range(3):
        normal = np.stack([-side[:, k, 1], side[:, k, 0]], 1) * turned[:, None]
        length = np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
        normal /= length[:, None]
        reach = 0.5 * np.abs(normal).sum(1) + gap
        offset = (normal * corner[:, k]).sum(1)
        inside &= (normal[face] * middle).sum(1) - offset[face] >= -reach[face]
    mask = np.zeros((int(last[:, 1].max()) + 1, int(last[:, 0].max()) + 1), bool)
    mask[cell[inside, 1], cell[inside, 0]] = True
    return mask, low
