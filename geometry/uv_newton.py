"""Locally injective minimisation of the symmetric Dirichlet energy, all charts in one system."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from .errors import InputError
from .uv_energy import RestShape, face_energy, newton_terms

_LARGEST_STEP = 0.9
"""Share of the way to the first triangle without area."""
_TRIES = 12
_HELD = (1e-12, 1e-9, 1e-6, 1e-3, 1.0)
"""Shares of the diagonal that are added, one after the other, where a matrix is singular."""
_SYMMETRIC = {
    "permc_spec": "MMD_AT_PLUS_A",
    "diag_pivot_thresh": 0.0,
    "options": {"SymmetricMode": True, "Equil": False},
}


@dataclass(eq=False)
class NewtonSolver:
    """Charts that share no vertex, minimised side by side; each has a step length of its own."""

    faces: Int[np.ndarray, "F 3"]
    rest: RestShape
    chart: Int[np.ndarray, "F"]
    """Chart of each face."""
    num_verts: int

    def __post_init__(self) -> None:
        """Lay out the sparse system."""
        self.num_charts = int(self.chart.max(initial=-1)) + 1
        self.vert_chart = np.zeros(self.num_verts, np.int64)
        self.vert_chart[self.faces.reshape(-1)] = np.repeat(self.chart, 3)
        slots = np.stack([2 * self.faces, 2 * self.faces + 1], -1).reshape(len(self.faces), 6)
        rows = np.repeat(slots, 6, axis=1).reshape(-1)
        cols = np.tile(slots, (1, 6)).reshape(-1)
        size = 2 * self.num_verts
        key, self._slot = np.unique(cols * size + rows, return_inverse=True)
        self._indices = (key % size).astype(np.int32)
        self._indptr = np.searchsorted(key // size, np.arange(size + 1)).astype(np.int32)
        self._diagonal = np.flatnonzero(key % size == key // size)
        self._spread = _spread(self.rest)
        self._area = np.bincount(self.chart, self.rest.area, minlength=self.num_charts)

    def energies(self, uv: Float[np.ndarray, "W 2"]) -> Float[np.ndarray, "C"]:
        """Mean energy per area of each chart; infinite where a face is flipped."""
        each = face_energy(self.rest.jacobians(uv[self.faces])) * self.rest.area
        return np.bincount(self.chart, each, minlength=self.num_charts) / self._area

    def run(
        self, uv: Float[np.ndarray, "W 2"], steps: int, gain: float = 1e-4
    ) -> Float[np.ndarray, "W 2"]:
        """Take Newton steps until no chart gains any more.

        Args:
            uv: coordinates without a flipped face.
            steps: at most so many.
            gain: stop when the mean energy falls by less than this part of its excess over 4.

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
            if fell <= gain * rest:
                break
        return uv

    def _direction(self, uv: np.ndarray) -> np.ndarray:
        gradient, hessian = newton_terms(self.rest.jacobians(uv[self.faces]))
        area = self.rest.area[:, None]
        force = area * np.einsum("fij,fi->fj", self._spread, gradient.reshape(-1, 4))
        local = np.einsum("fki,fkl,flj->fij", self._spread, hessian, self._spread, optimize=True)
        values = np.bincount(self._slot, (area[..., None] * local).reshape(-1))
        values[self._diagonal] += 1e-9 * values[self._diagonal].mean()
        right = np.zeros(2 * self.num_verts)
        slots = np.stack([2 * self.faces, 2 * self.faces + 1], -1).reshape(-1)
        right -= np.bincount(slots, force.reshape(-1), minlength=len(right))
        return self._solve(values, right).reshape(-1, 2)

    def _solve(self, values: np.ndarray, right: np.ndarray) -> np.ndarray:
        from scipy.sparse import csc_matrix

        matrix = csc_matrix((values, self._indices, self._indptr), (len(right), len(right)))
        return factorised(matrix).solve(right)

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


def factorised(matrix: Any) -> Any:
    """LU factors of a symmetric positive definite sparse matrix.

    A matrix that rounding made singular (needles, faces without area) is tried again with pivots,
    and then with more and more added to its diagonal.

    Args:
        matrix: a `scipy.sparse.csc_matrix`.

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
        for options in (_SYMMETRIC, {}):
            try:
                return splu(held, **options)
            except RuntimeError:  # a pivot of zero
                continue
    raise InputError("verts, faces: expected a mesh that can be flattened, found one that cannot")


def _spread(rest: RestShape) -> np.ndarray:
    """Matrices (F, 4, 6) from the coordinates of three corners to the entries of the Jacobian."""
    inverse = rest.inverse
    corner = np.stack([-inverse.sum(1), inverse[:, 0], inverse[:, 1]], 1)  # (F, corner, column)
    out = np.zeros((len(inverse), 2, 2, 3, 2))
    for axis in range(2):
        out[:, axis, :, :, axis] = corner.transpose(0, 2, 1)
    return out.reshape(-1, 4, 6)


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
