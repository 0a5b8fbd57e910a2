"""Exact tests of flat triangles: orientation, flips and pairs whose interiors overlap."""

from fractions import Fraction

import numpy as np
from jaxtyping import Bool, Float, Int

_ERROR = 4.0 * np.finfo(np.float64).eps
"""Bound of the relative rounding error of the determinant (Shewchuk 1997 has 3.3e-16 · …)."""
_CHUNK = 4_000_000


def orientation(
    a: Float[np.ndarray, "n 2"], b: Float[np.ndarray, "n 2"], c: Float[np.ndarray, "n 2"]
) -> Int[np.ndarray, "n"]:
    """Sign of the area of triangles, exact: 1 counter-clockwise, −1 clockwise, 0 on a line.

    Args:
        a: first corners, finite, any float dtype.
        b: second corners.
        c: third corners.

    Returns:
        Signs, int8. What rounding could decide is decided in rational numbers.

    >>> p = np.array([[0.1, 0.1]])
    >>> int(orientation(p, 3 * p, np.array([[0.5, 0.5]]))[0])
    0
    >>> int(orientation(p, 3 * p, np.array([[0.5, 0.5 + 1e-16]]))[0])
    1
    """
    a, b, c = (np.asarray(x, np.float64) for x in (a, b, c))
    left = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1])
    right = (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    det = left - right
    sign = np.sign(det).astype(np.int8)
    unsure = np.abs(det) <= _ERROR * (np.abs(left) + np.abs(right)) + 1e-300
    # a corner that is shared makes an exact zero: no need for rational numbers
    same = (a == b).all(1) | (b == c).all(1) | (a == c).all(1)
    sign[same] = 0
    for i in np.flatnonzero(unsure & ~same):
        sign[i] = _exact_sign(a[i], b[i], c[i])
    return sign


def _exact_sign(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> int:
    (ax, ay), (bx, by), (cx, cy) = ([Fraction(float(v)) for v in p] for p in (a, b, c))
    det = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    return (det > 0) - (det < 0)


def face_signs(corner_uv: Float[np.ndarray, "F 3 2"]) -> Int[np.ndarray, "F"]:
    """Orientation of each face, exact; what is not 1 is flipped or has no area.

    Args:
        corner_uv: coordinates per face corner.

    Returns:
        Signs, int8.
    """
    return orientation(corner_uv[:, 0], corner_uv[:, 1], corner_uv[:, 2])


def overlapping_pairs(corner_uv: Float[np.ndarray, "F 3 2"]) -> Int[np.ndarray, "n 2"]:
    """Pairs of faces whose interiors share area, exact; touching is no overlap.

    Flipped faces are turned over first; faces without area have no interior.

    Args:
        corner_uv: coordinates per face corner, finite.

    Returns:
        Face indices, the lower one first, in order.

    >>> face = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    >>> overlapping_pairs(np.stack([face, face + 0.4, face + 0.5])).tolist()
    [[0, 1], [1, 2]]
    """
    corner_uv = np.array(corner_uv, np.float64)
    sign = face_signs(corner_uv)
    corner_uv[sign < 0] = corner_uv[sign < 0][:, ::-1]
    solid = np.flatnonzero(sign != 0)
    boxes = np.concatenate([corner_uv.min(1), corner_uv.max(1)], 1)[solid]
    found = []
    for first, second in _close_boxes(boxes):
        a, b = solid[first], solid[second]
        hit = ~(_separated(corner_uv[a], corner_uv[b]) | _separated(corner_uv[b], corner_uv[a]))
        found.append(np.stack([a[hit], b[hit]], 1))
    pairs = np.concatenate(found) if found else np.zeros((0, 2), np.int64)
    pairs = np.sort(pairs, 1)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def _separated(a: np.ndarray, b: np.ndarray) -> Bool[np.ndarray, "n"]:
    """Whether a side of the counter-clockwise triangle a has all of b beyond it or on it."""
    out = np.zeros(len(a), bool)
    for side in range(3):
        todo = np.flatnonzero(~out)
        p, q = a[todo, side], a[todo, (side + 1) % 3]
        beyond = np.ones(len(todo), bool)
        for corner in range(3):
            some = np.flatnonzero(beyond)
            beyond[some] = orientation(p[some], q[some], b[todo[some], corner]) <= 0
        out[todo[beyond]] = True
    return out


def _close_boxes(boxes: Float[np.ndarray, "n 4"]) -> "list[tuple[np.ndarray, np.ndarray]]":
    """Pairs of boxes (low u, low v, high u, high v) whose interiors meet, each once, in chunks."""
    if len(boxes) < 2:
        return []
    extent = boxes[:, 2:] - boxes[:, :2]
    low = boxes[:, :2].min(0)
    span = np.maximum((boxes[:, 2:] - low).max(0), 1e-300)
    edge = max(float(np.median(extent.max(1))), float(span.max()) / 4096)
    first = ((boxes[:, :2] - low) / edge).astype(np.int64)
    last = ((boxes[:, 2:] - low) / edge).astype(np.int64)
    wide = last - first + 1
    number = wide[:, 0] * wide[:, 1]
    owner = np.repeat(np.arange(len(boxes)), number)
    rank = np.arange(len(owner)) - np.repeat(np.cumsum(number) - number, number)
    column = first[owner, 0] + rank % wide[owner, 0]
    row = first[owner, 1] + rank // wide[owner, 0]
    cell = row * (int(last[:, 0].max()) + 2) + column
    order = np.argsort(cell, kind="stable")
    owner, cell, column, row = owner[order], cell[order], column[order], row[order]
    end = np.searchsorted(cell, cell, side="right")
    later = end - 1 - np.arange(len(cell))  # entries behind this one in its cell
    chunks = []
    total = np.concatenate([[0], np.cumsum(later)])
    start = 0
    while start < len(cell):
        stop = int(np.searchsorted(total, total[start] + _CHUNK, side="right")) - 1
        stop = min(max(stop, start + 1), len(cell))
        count = later[start:stop]
        i = np.repeat(np.arange(start, stop), count)
        j = i + 1 + np.arange(len(i)) - np.repeat(np.cumsum(count) - count, count)
        a, b = owner[i], owner[j]
        meet = (
            np.maximum(boxes[a, :2], boxes[b, :2]) < np.minimum(boxes[a, 2:], boxes[b, 2:])
        ).all(1)
        # a pair is looked at in the first cell that both boxes have
        once = (column[i] == np.maximum(first[a, 0], first[b, 0])) & (
            row[i] == np.maximum(first[a, 1], first[b, 1])
        )
        keep = meet & once
        chunks.append((a[keep], b[keep]))
        start = stop
    return chunks
