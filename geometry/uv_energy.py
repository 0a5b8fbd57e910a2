"""Symmetric Dirichlet energy of flat triangles against their rest shape, and its Newton steps."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

ISOMETRIC = 4.0
"""The energy per area of a map that keeps all lengths; the least there is."""


def flat_triangles(verts: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> np.ndarray:
    """Every triangle laid into the plane with its own lengths.

    Triangles without area get a little: each of their sides is lengthened until the longest is
    shorter than the other two together by a tenth of a thousandth of itself, or by as much as
    whole multiples of 2⁻²⁴ can show in a layout of the whole mesh.

    Args:
        verts: vertices.
        faces: vertex indices.

    Returns:
        The second and third corner of each triangle, as the columns of (F, 2, 2); the first
        corner is the origin and the second lies on the u axis.

    Reference:
        Sharp and Crane 2020, intrinsic mollification, here per face.
    """
    corners = verts[faces]
    sides = np.linalg.norm(np.roll(corners, -1, 1) - corners, axis=-1)  # 01, 12, 20
    longest = sides.max(1, keepdims=True)
    span = max(float(np.linalg.norm(longest)), 1e-30)
    slack = sides.sum(1, keepdims=True) - 2 * longest
    sides = sides + np.maximum(np.maximum(1e-4 * longest, 4e-6 * span) - slack, 0.0)
    a, b, c = sides.T
    x = (a * a + c * c - b * b) / (2 * a)
    half = sides.sum(1) / 2
    area = np.sqrt(np.maximum(half * (half - a) * (half - b) * (half - c), 0.0))
    y = 2 * area / a
    return np.stack([np.stack([a, x], -1), np.stack([np.zeros_like(a), y], -1)], 1)


@dataclass(frozen=True, eq=False)
class RestShape:
    """Triangles at rest, ready to compare with flat ones."""

    inverse: Float[np.ndarray, "F 2 2"]
    """Inverse of the matrix of the two sides from the first corner."""
    area: Float[np.ndarray, "F"]

    @classmethod
    def of(cls, verts: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> "RestShape":
        """Rest shape of a mesh."""
        return cls.of_flat(flat_triangles(verts, faces))

    @classmethod
    def of_flat(cls, flat: Float[np.ndarray, "F 2 2"]) -> "RestShape":
        """Rest shape of triangles that are laid into the plane."""
        a, x, y = flat[:, 0, 0], flat[:, 0, 1], flat[:, 1, 1]
        zero = np.zeros_like(a)
        inverse = np.stack([np.stack([1 / a, -x / (a * y)], -1), np.stack([zero, 1 / y], -1)], 1)
        return cls(inverse, a * y / 2)

    def of_faces(self, faces: np.ndarray) -> "RestShape":
        """The same for some faces."""
        return RestShape(self.inverse[faces], self.area[faces])

    def jacobians(self, corner_uv: Float[np.ndarray, "F 3 2"]) -> Float[np.ndarray, "F 2 2"]:
        """Derivative of the map of each face from its rest plane to (u, v)."""
        sides = (corner_uv[:, 1:] - corner_uv[:, :1]).transpose(0, 2, 1)
        return sides @ self.inverse


def singular_values(jacobian: Float[np.ndarray, "F 2 2"]) -> tuple[np.ndarray, np.ndarray]:
    """Singular values of 2 × 2 matrices, the larger one first; the second carries the sign of det.

    Args:
        jacobian: matrices, (F, 2, 2).

    Returns:
        Two arrays (F,).

    >>> [float(s[0]) for s in singular_values(np.diag([2.0, -3.0])[None])]
    [3.0, -2.0]
    """
    a, b, c, d = jacobian.reshape(-1, 4).T
    plus = np.hypot(a + d, c - b) / 2
    minus = np.hypot(a - d, c + b) / 2
    return plus + minus, plus - minus


def face_energy(jacobian: Float[np.ndarray, "F 2 2"]) -> Float[np.ndarray, "F"]:
    """Symmetric Dirichlet energy |J|² + |J⁻¹|² of each face; infinite where it is flipped.

    Args:
        jacobian: derivatives of the maps, (F, 2, 2).

    Returns:
        Energies per area, at least 4.

    Reference:
        Smith and Schaefer 2015, equation 2.
    """
    a, b, c, d = jacobian.reshape(-1, 4).T
    det = a * d - b * c
    safe = np.where(det > 0, det, 1.0)
    square = a * a + b * b + c * c + d * d
    return np.where(det > 0, square * (1 + 1 / (safe * safe)), np.inf)


def newton_terms(
    jacobian: Float[np.ndarray, "F 2 2"],
) -> tuple[Float[np.ndarray, "F 2 2"], Float[np.ndarray, "F 4 4"]]:
    """Gradient and positive part of the Hessian of the energy with respect to each Jacobian.

    Args:
        jacobian: derivatives of the maps, all of positive determinant.

    Returns:
        Gradients (F, 2, 2) and Hessians (F, 4, 4) over the entries row by row, positive
        semi-definite.

    Reference:
        Smith, De Goes and Kim 2019, Analytic eigensystems for isotropic distortion energies.
    """
    # two corners whose columns are the unit vectors: their coordinates are the entries of J
    corners = np.tile(np.eye(2), (len(jacobian), 1, 1))
    gradient, hessian = corner_terms(jacobian, corners)
    gradient = np.ascontiguousarray(gradient.reshape(-1, 2, 2).transpose(0, 2, 1))
    hessian = hessian.reshape(-1, 2, 2, 2, 2).transpose(0, 2, 1, 4, 3)
    return gradient, hessian.reshape(-1, 4, 4)


def corner_columns(inverse: Float[np.ndarray, "F 2 2"]) -> Float[np.ndarray, "F 3 2"]:
    """What each corner of a triangle adds to its Jacobian: J = Σ uv_k ⊗ column_k.

    Args:
        inverse: see `RestShape`.

    Returns:
        The columns.
    """
    return np.stack([-inverse.sum(1), inverse[:, 0], inverse[:, 1]], 1)


def corner_terms(
    jacobian: Float[np.ndarray, "F 2 2"], columns: Float[np.ndarray, "F k 2"]
) -> tuple[Float[np.ndarray, "F n"], Float[np.ndarray, "F n n"]]:
    """Gradient and positive part of the Hessian with respect to the coordinates of the corners.

    Args:
        jacobian: derivatives of the maps, all of positive determinant.
        columns: of `corner_columns`.

    Returns:
        Gradients and Hessians over u and v of the first corner, of the second and so on.

    Reference:
        Smith, De Goes and Kim 2019, Analytic eigensystems for isotropic distortion energies.
    """
    a, b, c, d = jacobian.reshape(-1, 4).T
    # J = U diag(s1, s2) Vᵀ by the angles of its conformal and anticonformal part
    plus_angle, minus_angle = np.arctan2(c - b, a + d), np.arctan2(c + b, a - d)
    s1, s2 = singular_values(jacobian)
    left, right = (plus_angle + minus_angle) / 2, (minus_angle - plus_angle) / 2
    cos_u, sin_u, cos_v, sin_v = np.cos(left), np.sin(left), np.cos(right), np.sin(right)
    x, y = columns[..., 0].T, columns[..., 1].T  # (k, F)
    # the columns in the frame of V, times the axes of U: derivatives of the entries of Uᵀ J V
    along, across = cos_v * x + sin_v * y, cos_v * y - sin_v * x
    stretch1 = np.stack([cos_u * along, sin_u * along], 1)
    stretch2 = np.stack([-sin_u * across, cos_u * across], 1)
    mixed1 = np.stack([cos_u * across, sin_u * across], 1)
    mixed2 = np.stack([-sin_u * along, cos_u * along], 1)
    d1, d2 = 2 * s1 - 2 / s1**3, 2 * s2 - 2 / s2**3
    h11, h22 = 2 + 6 / s1**4, 2 + 6 / s2**4
    total, product = s1 + s2, s1 * s2
    # (d1 + d2) / (s1 + s2) and (d1 − d2) / (s1 − s2), without the division by a small number
    twist = np.maximum((d1 + d2) / total, 0.0) / 2
    flip = 1 + (s1 * s1 + product + s2 * s2) / product**3
    size = 2 * len(x)
    gradient = (d1 * stretch1 + d2 * stretch2).reshape(size, -1)
    shapes = np.stack(
        [
            np.sqrt(h11) * stretch1,
            np.sqrt(h22) * stretch2,
            np.sqrt(twist) * (mixed2 - mixed1),
            np.sqrt(flip) * (mixed2 + mixed1),
        ]
    )
    rows = np.ascontiguousarray(shapes.reshape(4, size, -1).transpose(2, 0, 1))
    return np.ascontiguousarray(gradient.T), rows.transpose(0, 2, 1) @ rows
