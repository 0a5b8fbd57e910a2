"""Similarity that lays one mesh on another of the same kind, whatever its axes, size and place.

Iterated closest points from many first rotations; the one that fits best both ways wins.
References: P. Besl, N. McKay, A method for registration of 3-D shapes, 1992; S. Umeyama,
Least-squares estimation of transformation parameters between two point patterns, 1991; own code.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from .errors import InputError
from .mesh_graph import check_mesh, face_areas

_COARSE, _FINE = (300, 10), (1500, 40)  # points and iterations
_KEPT = 4  # first rotations that are refined


@dataclass(frozen=True, eq=False)
class Similarity:
    """p → scale · rotation · p + shift.

    Attributes:
        scale: greater than 0.
        rotation: [3, 3], determinant 1.
        shift: [3], metres.
        residual: root mean square of the distances between the aligned surfaces, as a share of the
            diagonal of the target's box.
    """

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]
    residual: float = 0.0

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Moved points."""
        return self.scale * points @ self.rotation.T + self.shift

    def inverse(self) -> "Similarity":
        """The way back."""
        shift = -self.rotation.T @ self.shift / self.scale
        return Similarity(1 / self.scale, self.rotation.T, shift, self.residual)


def surface_points(
    verts: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], count: int, seed: int = 0
) -> Float[np.ndarray, "n 3"]:
    """Points spread evenly over a surface by area; the same for the same seed.

    Args:
        verts: vertices, metres.
        faces: vertex indices.
        count: number of points.
        seed: of the generator.

    Returns:
        Points, metres.

    Raises:
        InputError: the surface has no area.

    >>> surface_points(np.eye(3), np.array([[0, 1, 2]]), 5).sum(1).round(6)
    array([1., 1., 1., 1., 1.])
    """
    area = face_areas(verts, faces)
    if not area.sum() > 0:
        raise InputError("faces: expected a surface with area, found none; pass a mesh with faces")
    rng = np.random.default_rng(seed)
    where = (np.arange(count) + rng.random(count)) / count
    face = np.minimum(np.searchsorted(np.cumsum(area) / area.sum(), where), len(area) - 1)
    u, v = rng.random((2, count))
    fold = u + v > 1
    u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
    a, b, c = np.moveaxis(verts[faces[face]], 1, 0)
    return a + u[:, None] * (b - a) + v[:, None] * (c - a)


def fitted_similarity(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]
) -> Similarity:
    """The similarity that brings points nearest to their partners, in least squares.

    Args:
        source: points.
        target: their partners.

    Returns:
        Its residual is that of the points, as a share of the diagonal of the partners' box.

    >>> moved = fitted_similarity(np.eye(3), 2 * np.eye(3) + 1)
    >>> round(moved.scale, 6), moved.shift.round(6).tolist()
    (2.0, [1.0, 1.0, 1.0])
    """
    from_, to = source.mean(0), target.mean(0)
    a, b = source - from_, target - to
    u, size, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float((size * sign).sum() / max(float((a**2).sum()), 1e-300))
    found = Similarity(scale, rotation, to - scale * rotation @ from_)
    gap = np.sqrt(((found(source) - target) ** 2).sum(1).mean())
    return Similarity(scale, rotation, found.shift, float(gap / _diagonal(target)))


def _diagonal(points: np.ndarray) -> float:
    return max(float(np.linalg.norm(np.ptp(points, axis=0))), 1e-300)


def _quarter_turns() -> list[np.ndarray]:
    """The 24 rotations that take axes to axes, no turn first."""
    turns = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.eye(3)[list(order)] * np.array(signs)
            if np.linalg.det(turn) > 0:
                turns.append(turn)
    return turns


def iterated(
    start: Similarity,
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "m 3"],
    steps: int,
) -> Similarity:
    """Closest points both ways, then the best similarity, again and again.

    Args:
        start: where to begin.
        source: points that are moved.
        target: points that stay.
        steps: most iterations; fewer when nothing changes.

    Returns:
        The similarity after the last step.

    >>> start = Similarity(1.0, np.eye(3), np.array([0.1, 0, 0]))
    >>> bool(abs(iterated(start, np.eye(3), np.eye(3), 5).shift).max() < 1e-6)
    True
    """
    from scipy.spatial import KDTree

    tree, found = KDTree(target), start
    for _ in range(steps):
        moved = found(source)
        there = tree.query(moved)[1]
        back = KDTree(moved).query(target)[1]
        pairs = np.concatenate([source, source[back]]), np.concatenate([target[there], target])
        better = fitted_similarity(*pairs)
        done = abs(better.residual - found.residual) < 1e-7 and found is not start
        found = better
        if done:
            break
    return found


def align(
    source: tuple[Float[np.ndarray, "s 3"], Int[np.ndarray, "g 3"]],
    target: tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]],
) -> Similarity:
    """The similarity that lays one surface on another; neither needs a known up or size.

    Meant for bodies in a similar pose. The result is the same every time.

    Args:
        source: vertices and faces that are moved.
        target: vertices (metres) and faces that stay.

    Returns:
        The similarity; a residual above about 0.03 says that the meshes do not match.

    Raises:
        InputError: an empty or damaged mesh, or one without area.

    >>> verts = np.array([[0.0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 1]])
    >>> mesh = (verts, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    >>> round(align(mesh, (2 * verts, mesh[1])).scale, 2)
    2.0
    """
    return align_to_best(source, [target])[1]


def align_to_best(
    source: tuple[Float[np.ndarray, "s 3"], Int[np.ndarray, "g 3"]],
    targets: Sequence[tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]],
) -> tuple[int, Similarity]:
    """The target that a surface fits best, in any place, size and turn, and the way onto it.

    Args:
        source: vertices and faces that are moved.
        targets: vertices and faces of each candidate, such as poses of one body.

    Returns:
        Index of the target, and the similarity.

    Raises:
        InputError: no target, an empty or damaged mesh, or one without area.

    >>> verts = np.array([[0.0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 1]])
    >>> faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    >>> align_to_best((verts, faces), [(verts * [1, 3, 1], faces), (verts + 1, faces)])[0]
    1
    """
    for verts, faces in (source, *targets):
        check_mesh(verts, faces)
    if not targets:
        raise InputError("targets: expected at least one mesh, found none; pass one")
    points = surface_points(source[0], source[1], _COARSE[0])
    tries = []
    for index, (verts, faces) in enumerate(targets):
        there = surface_points(verts, faces, _COARSE[0])
        tries += [(index, found) for found in _first_fits(points, there)]
    best = sorted(tries, key=lambda pair: pair[1].residual)[:_KEPT]
    points = surface_points(source[0], source[1], _FINE[0])
    refined = []
    for index, start in best:
        there = surface_points(targets[index][0], targets[index][1], _FINE[0])
        refined.append((index, iterated(start, points, there, _FINE[1])))
    return min(refined, key=lambda pair: pair[1].residual)


def _first_fits(source: np.ndarray, target: np.ndarray) -> list[Similarity]:
    """A few iterations from each of the 24 rotations, sizes and middles equal at first."""
    middle = [points.mean(0) for points in (source, target)]
    pairs = zip((source, target), middle, strict=True)
    spread = [float(np.sqrt(((p - m) ** 2).sum(1).mean())) for p, m in pairs]
    scale = spread[1] / max(spread[0], 1e-300)
    fits = []
    for turn in _quarter_turns():
        start = Similarity(scale, turn, middle[1] - scale * turn @ middle[0])
        fits.append(iterated(start, source, target, _COARSE[1]))
    return fits
