"""Which boxes of a set overlap, by a balanced tree that is descended in numpy, level by level."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

_BATCH = 1 << 19  # pairs of nodes that are opened at once


def _spread(values: np.ndarray) -> np.ndarray:
    """Bits of whole numbers below 2²¹, two zeros between neighbours."""
    x = values.astype(np.uint64)
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | (x << np.uint64(shift))) & np.uint64(mask)
    return x


def _along_a_curve(centre: np.ndarray) -> np.ndarray:
    """An order in which neighbours in space are near each other (Morton)."""
    low = centre.min(0)
    span = np.maximum((centre - low).max(), 1e-300)
    cell = np.minimum((centre - low) / span * (1 << 20), (1 << 20) - 1)
    code = np.zeros(len(centre), np.uint64)
    for axis in range(centre.shape[1]):
        code |= _spread(cell[:, axis]) << np.uint64(axis)
    return np.argsort(code, kind="stable")


def overlapping_boxes(
    low: Float[np.ndarray, "n d"], high: Float[np.ndarray, "n d"]
) -> Iterator[Int[np.ndarray, "m 2"]]:
    """All pairs of boxes that share a point, each pair once, in batches.

    Args:
        low: smallest corners, finite; 2 or 3 columns.
        high: largest corners.

    Yields:
        Pairs of box indices; the order is the same every time.

    >>> low = np.array([[0.0, 0], [2, 2], [1, 1]])
    >>> [pairs.tolist() for pairs in overlapping_boxes(low, low + 1)]
    [[[0, 2], [1, 2]]]
    """
    count = len(low)
    if count < 2:
        return
    order = _along_a_curve(0.5 * low + 0.5 * high)
    depth = max(1, int(np.ceil(np.log2(count))))
    lows = [np.full((1 << depth, low.shape[1]), np.inf)]
    highs = [np.full((1 << depth, low.shape[1]), -np.inf)]
    lows[0][:count], highs[0][:count] = low[order], high[order]
    for _ in range(depth):
        lows.append(np.minimum(lows[-1][0::2], lows[-1][1::2]))
        highs.append(np.maximum(highs[-1][0::2], highs[-1][1::2]))
    todo = [(depth, np.zeros((1, 2), np.int64))]
    while todo:
        level, pairs = todo.pop()
        if level == 0:
            yield np.sort(order[pairs], 1)
            continue
        pairs = _opened(pairs)
        a, b = pairs.T
        level -= 1
        touch = a != b if level == 0 else np.ones(len(pairs), bool)
        for small, large in zip(lows[level].T, highs[level].T, strict=True):
            touch &= (small[a] <= large[b]) & (small[b] <= large[a])
        pairs = pairs[touch]
        parts = max(1, -(-len(pairs) // _BATCH))
        todo += [(level, part) for part in np.array_split(pairs, parts) if len(part)]


def _opened(pairs: np.ndarray) -> np.ndarray:
    """Pairs of children of pairs of nodes; those of a node with itself once."""
    a, b = 2 * pairs.T
    self_ = a == b
    four = [np.stack([a + i, b + j], 1) for i, j in ((0, 0), (0, 1), (1, 1))]
    return np.concatenate([*four, np.stack([a + 1, b], 1)[~self_]])
