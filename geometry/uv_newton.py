"""Locally injective minimisation of the symmetric Dirichlet energy, all charts in one system."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Int

from .errors import InputError
from .uv_energy import RestShape, corner_columns, corner_terms, face_energy

Item = TypeVar("Item")
Result = TypeVar("Result")
_THREADS = 2
_LARGEST_STEP = 0.9
"""Share of the way to the first triangle without area."""
_TRIES = 12
_HELD = (1e-12, 1e-9, 1e-6, 1e-3, 1.0)
"""Shares of the diagonal that are added, one after the other, where a matrix is singular."""
_SYMMETRIC = {
    "permc_spec": "MMD_AT_PLUS_A",
    "diag_pivot_thresh": 0.0,
    "options": {"SymmetricMode": True, "Equil": False},
    # small fronts waste least on the matrices of surfaces
    "relax": 1,
    "panel_size": 1,
}
_ORDERED = _SYMMETRIC | {"permc_spec": "NATURAL"}
"""For a matrix whose unknowns come in a good order already."""
_GROUP = 2500
"""Faces that are solved together; groups go to threads, and each stops when it is done."""


@dataclass(eq=False)
class NewtonSolver:
    """Charts that share no vertex, minimised side by side; each has a step length of its own."""

    faces: Int[np.ndarray, "F 3"]
    rest: RestShape
    chart: Int[np.ndarray, "F"]
    """Chart of each face."""
    num_verts: int

    def __post_init__(self) -> None:
        """Lay out the sparse system, its unknowns in an order that keeps the factors sparse."""
        self.num_charts = int(self.chart.max(initial=-1)) + 1
        self.vert_chart = np.zeros(self.num_verts, np.int64)
        self.vert_chart[self.faces.reshape(-1)] = np.repeat(self.chart, 3)
        self._place = _sparse_order(self.faces, self.num_verts)
        place = self._place[self.faces]
        self._lay_out(place)
        self._unknown = np.stack([2 * place, 2 * place + 1], -1).reshape(-1)
        self._corners = corner_columns(self.rest.inverse)
        self._area = np.bincount(self.chart, self.rest.area, minlength=self.num_charts)

    def _lay_out(self, place: Int[np.ndarray, "F 3"]) -> None:
        """Where the entries of each face come in the matrix, found by blocks of two by two."""
        count = self.num_verts
        rows, cols = np.repeat(place, 3, axis=1), np.tile(place, (1, 3))
        block, of_face = np.unique((cols * count + rows).reshape(-1), return_inverse=True)
        col, row = np.divmod(block, count)
        first = np.searchsorted(col, np.arange(count + 1))
        size = np.diff(first)
        start = 4 * first[col] + 2 * (np.arange(len(block)) - first[col])
        two = np.arange(2)
        # the entries of the first column of all blocks of a column come before those of the second
        at = start[:, None, None] + two[:, None] + (2 * size[col])[:, None, None] * two
        self._slot = at[of_face.reshape(-1, 3, 3)].transpose(0, 1, 3, 2, 4).reshape(-1)
        self._indices = np.zeros(4 * len(block), np.int32)
        self._indices[at] = (2 * row[:, None] + two)[:, :, None]
        ends = np.stack([4 * first[:-1], 4 * first[:-1] + 2 * size], 1).reshape(-1)
        self._indptr = np.append(ends, 4 * len(block)).astype(np.int32)
        self._diagonal = np.sort(at[row == col][:, two, two].reshape(-1))

    def energies(self, uv: Float[np.ndarray, "W 2"]) -> Float[np.ndarray, "C"]:
        """Mean energy per area of each chart; infinite where a face is flipped."""
        each = face_energy(self.rest.jacobians(uv[self.faces])) * self.rest.area
        return np.bincount(self.chart, each, minlength=self.num_charts) / self._area

    def run(
        self,
        uv: Float[np.ndarray, "W 2"],
        steps: int,
        gain: float = 1e-4,
        enough: float = 0.0,
    ) -> Float[np.ndarray, "W 2"]:
        """Take Newton steps until the charts gain no more.

        Args:
            uv: coordinates without a flipped face.
            steps: at most so many.
            gain: stop when the mean energy falls by less than this part of its excess over 4.
            enough: an excess; that of the charts counts as no less for the rule above.

        Returns:
            Coordinates of lower energy, without a flipped face.
        """
        before = self.energies(uv)
        for _ in range(steps):
            step = self._direction(uv)
            uv, after = self._search(uv, step, before)
            fell = float(((before - after) * self._area).sum() / self._area.sum())
            rest = float(((after - 4) * self._area).sum() / self._area.sum())
            before = after
            if fell <= gain * max(rest, enough):
                break
        return uv

    def _direction(self, uv: np.ndarray) -> np.ndarray:
        jacobian = self.rest.jacobians(uv[self.faces])
        force, local = corner_terms(jacobian, self._corners)
        area = self.rest.area[:, None]
        values = np.bincount(self._slot, (area[..., None] * local).reshape(-1))
        values[self._diagonal] += 1e-9 * values[self._diagonal].mean()
        pull = (area * force).reshape(-1)
        right = -np.bincount(self._unknown, pull, minlength=2 * self.num_verts)
        return self._solve(values, right).reshape(-1, 2)[self._place]

    def _solve(self, values: np.ndarray, right: np.ndarray) -> np.ndarray:
        from scipy.sparse import csc_matrix

        matrix = csc_matrix((values, self._indices, self._indptr), (len(right), len(right)))
        return factorised(matrix, _ORDERED).solve(right)

    def _search(
        self, uv: np.ndarray, step: np.ndarray, before: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Step lengths of the charts: below the first flip, halved until the energy falls."""
        limit = _first_flip(uv[self.faces], step[self.faces])
        length = np.full(self.num_charts, np.inf)
        np.minimum.at(length, self.chart, limit)
        length = np.minimum(1.0, _LARGEST_STEP * length)
        worse = np.zeros(self.num_charts, bool)
        for _ in range(_TRIES):
            trial = uv + length[self.vert_chart, None] * step
            after = self.energies(trial)
            worse = ~(after <= before)
            if not worse.any():
                return trial, after
            length[worse] /= 2
        length[worse] = 0.0
        trial = uv + length[self.vert_chart, None] * step
        return trial, self.energies(trial)


def relaxed_charts(
    faces: Int[np.ndarray, "F 3"],
    rest: RestShape,
    chart: Int[np.ndarray, "F"],
    uv: Float[np.ndarray, "W 2"],
    steps: int,
    gain: float,
) -> Float[np.ndarray, "W 2"]:
    """Newton steps on charts in groups, in threads; the groups depend on the charts alone.

    Args:
        faces: vertex indices; charts share no vertex.
        rest: rest shape of the faces.
        chart: of each face.
        uv: coordinates without a flipped face.
        steps: at most so many for each group.
        gain: see `NewtonSolver.run`.

    Returns:
        Coordinates of lower energy; vertices of no face stay.
    """
    out = uv.copy()
    excess = (face_energy(rest.jacobians(uv[faces])) - 4) * rest.area
    enough = 0.5 * float(excess.sum() / max(rest.area.sum(), 1e-300))

    def work(some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        used, local = np.unique(faces[some], return_inverse=True)
        _, number = np.unique(chart[some], return_inverse=True)
        solver = NewtonSolver(local.reshape(-1, 3), rest.of_faces(some), number, len(used))
        return used, solver.run(uv[used], steps, gain, enough)

    for used, found in in_threads(work, _groups(chart)):
        out[used] = found
    return out


def _groups(chart: np.ndarray) -> list[np.ndarray]:
    """Faces of charts that are solved together, the groups with most of them first."""
    _, number, size = np.unique(chart, return_inverse=True, return_counts=True)
    if len(size) == 0:
        return []
    order = np.argsort(-size, kind="stable")
    before = np.concatenate([[0], np.cumsum(size[order])[:-1]])
    group = np.zeros(len(size), np.int64)
    group[order] = before // _GROUP
    of_face = np.unique(group, return_inverse=True)[1][number]
    faces = np.argsort(of_face, kind="stable")
    return np.split(faces, np.searchsorted(of_face[faces], np.arange(1, of_face.max() + 1)))


def in_threads(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """The results of independent pieces of work in their order, computed in two threads.

    Args:
        work: a function of one piece.
        items: the pieces.

    Returns:
        Its results.
    """
    if len(items) < 2:
        return [work(item) for item in items]
    with ThreadPoolExecutor(min(len(items), _THREADS)) as pool:
        return list(pool.map(work, items))


def _sparse_order(faces: np.ndarray, count: int) -> np.ndarray:
    """Place of each vertex in an elimination order of minimum degree."""
    from scipy.sparse import coo_matrix, diags

    ends = np.concatenate([faces.reshape(-1), np.roll(faces, -1, 1).reshape(-1)])
    others = np.concatenate([np.roll(faces, -1, 1).reshape(-1), faces.reshape(-1)])
    joined = coo_matrix((np.ones(len(ends)), (ends, others)), (count, count)).tocsc()
    degree = np.asarray(joined.sum(1)).ravel()
    return factorised((diags(degree + 1) - joined).tocsc()).perm_c.astype(np.int64)


def factorised(matrix: Any, symmetric: dict[str, Any] = _SYMMETRIC) -> Any:
    """LU factors of a symmetric positive definite sparse matrix.

    A matrix that rounding made singular (needles, faces without area) is tried again with pivots,
    and then with more and more added to its diagonal.

    Args:
        matrix: a `scipy.sparse.csc_matrix`.
        symmetric: options of the first try, which looks for no pivots.

    Returns:
        An object with ``solve``.

    Raises:
        InputError: a matrix that is not finite.
    """
    from scipy.sparse import diags
    from scipy.sparse.linalg import splu

    if not np.isfinite(matrix.data).all():
        raise InputError(
            "verts, faces: expected triangles whose shape float64 can hold, found some of no or "
            "endless size; clean the mesh"
        )
    size = np.abs(matrix.diagonal())
    size = size + max(float(size.mean()), 1e-300)
    for share in (0.0, *_HELD):
        held = (matrix + diags(share * size)).tocsc() if share else matrix
        for options in (symmetric, {}):
            try:
                return splu(held, **options)
            except RuntimeError:  # a pivot of zero
                continue
    raise InputError("verts, faces: expected a mesh that can be flattened, found one that cannot")


def _first_flip(corner: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Smallest positive t at which corner + t · step has no area, per face; infinity for never."""
    p, q = corner[:, 1:] - corner[:, :1], step[:, 1:] - step[:, :1]

    def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]

    c = cross(p[:, 0], p[:, 1])
    b = cross(p[:, 0], q[:, 1]) + cross(q[:, 0], p[:, 1])
    a = cross(q[:, 0], q[:, 1])
    root = np.sqrt(np.maximum(b * b - 4 * a * c, 0.0))
    # the stable pair of roots; c > 0, so the smaller positive root is the first flip
    half = -(b + np.where(b >= 0, root, -root)) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        roots = np.stack([half / a, c / half])
    real = b * b - 4 * a * c >= 0
    good = real & (roots > 0)
    return np.where(good, roots, np.inf).min(0)
