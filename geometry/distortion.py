"""OpenCV's lens on the plane z = 1 (Brown-Conrady and more): Jacobian, fold and inverse."""

import math
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .errors import InputError
from .tilt import map_plane, map_plane_jacobian, tilt_matrix
from .two_by_two import solve_two_by_two

COEFFICIENT_COUNTS = (0, 4, 5, 8, 12, 14)
"""Accepted lengths: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [τx τy]]]], OpenCV's order."""

MAX_RADIUS = 10.0
"""Radius on the plane z = 1 (84 degrees off axis) up to which a lens without a fold is trusted."""


def _check_count(coefficients: Tensor) -> None:
    count = coefficients.shape[-1]
    if count not in COEFFICIENT_COUNTS:
        raise InputError(
            f"distortion: expected {COEFFICIENT_COUNTS} coefficients in OpenCV's order, found "
            f"{count}; pad with zeros"
        )


def _padded(coefficients: Float[Tensor, "d"]) -> tuple[Tensor, ...]:
    """The first twelve coefficients as scalars, missing ones zero."""
    _check_count(coefficients)
    missing = coefficients.new_zeros(max(0, 12 - coefficients.shape[-1]))
    return torch.cat([coefficients[:12], missing]).unbind(-1)


def _tilt(coefficients: Float[Tensor, "d"]) -> Float[Tensor, "3 3"] | None:
    """Homography of the tilted sensor; None where it stands upright."""
    return tilt_matrix(coefficients[12:]) if coefficients.shape[-1] == 14 else None


def _radial(r2: Tensor, k: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Radial factor f(r²) and its derivative with respect to r²."""
    k1, k2, _, _, k3, k4, k5, k6 = k[:8]
    above = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    above_slope = k1 + r2 * (2 * k2 + 3 * r2 * k3)
    below_slope = k4 + r2 * (2 * k5 + 3 * r2 * k6)
    factor = above / below
    return factor, (above_slope - factor * below_slope) / below


def distort(
    points: Float[Tensor, "*b 2"], coefficients: Float[Tensor, "d"]
) -> Float[Tensor, "*b 2"]:
    """Moves ideal points of the plane z = 1 to where the lens puts them.

    Args:
        points: ideal points (x/z, y/z), camera axes, no unit, *b 2.
        coefficients: OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [τx τy]]]]; 0, 4, 5, 8, 12
            or 14 of them.

    Returns:
        Distorted points, *b 2. Differentiable in both arguments.

    Raises:
        InputError: another number of coefficients.

    Reference: Brown, "Decentering distortion of lenses", 1966; OpenCV calib3d, equation of
    `projectPoints`.

    >>> distort(torch.tensor([[1.0, 0.0]]), torch.tensor([0.5, 0.0, 0.0, 0.0])).tolist()
    [[1.5, 0.0]]
    """
    if coefficients.shape[-1] == 0:
        return points
    from kornia.geometry.calibration import distort_points

    _check_count(coefficients)
    tilt, coefficients = _tilt(coefficients), coefficients[:12]
    # kornia works on pixels: the plane z = 1 is the image of the identity intrinsics
    flat, eye = points.reshape(1, -1, 2), torch.eye(3, dtype=points.dtype, device=points.device)
    bent = distort_points(flat, eye[None], coefficients[None]).reshape(points.shape)
    return bent if tilt is None else map_plane(bent, tilt)[0]


def distortion_jacobian(
    points: Float[Tensor, "*b 2"], coefficients: Float[Tensor, "d"]
) -> Float[Tensor, "*b 2 2"]:
    """Derivative of `distort` with respect to its points, in closed form.

    Args:
        points: ideal points on the plane z = 1, *b 2.
        coefficients: as in `distort`.

    Returns:
        Jacobians, *b 2 2, row = output, column = input. Differentiable in both arguments.

    Raises:
        InputError: another number of coefficients.

    >>> distortion_jacobian(torch.zeros(2), torch.tensor([0.5, 0.0, 0.0, 0.0])).tolist()
    [[1.0, 0.0], [0.0, 1.0]]
    """
    k = _padded(coefficients)
    x, y = points.unbind(-1)
    r2 = x * x + y * y
    factor, slope = _radial(r2, k)
    p1, p2, s1, s2, s3, s4 = k[2], k[3], k[8], k[9], k[10], k[11]
    prism_u = 2 * (s1 + 2 * s2 * r2)
    prism_v = 2 * (s3 + 2 * s4 * r2)
    shared = 2 * (x * y * slope + p1 * x + p2 * y)
    du_dx = factor + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x + prism_u * x
    dv_dy = factor + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x + prism_v * y
    rows = [du_dx, shared + prism_u * y, shared + prism_v * x, dv_dy]
    jac, tilt = torch.stack(rows, -1).unflatten(-1, (2, 2)), _tilt(coefficients)
    if tilt is None:
        return jac
    return map_plane_jacobian(distort(points, coefficients[:12]), tilt) @ jac


def fold_radius(coefficients: Float[Tensor, "d"]) -> float:
    """Radius on the plane z = 1 inside which the lens is one-to-one; beyond it images fold back.

    Inside this disc the symmetric part of the Jacobian is positive definite, and a map with that
    property on a convex set is injective. For radial lenses the radius is the exact first root of
    d(r f)/dr (or pole of f); with tangential or prism terms it is searched along 72 rays, rounded
    down, and at most `MAX_RADIUS`. A tilted sensor ends the disc at its horizon.

    Args:
        coefficients: as in `distort`.

    Returns:
        The radius, no unit; infinite where a radial lens never folds.

    Raises:
        InputError: another number of coefficients.

    >>> round(fold_radius(torch.tensor([-0.1, 0.0, 0.0, 0.0], dtype=torch.float64)), 4)
    1.8257
    """
    _check_count(coefficients)
    return _fold_radius(tuple(coefficients.detach().to("cpu", torch.float64).tolist()))


@lru_cache(maxsize=256)
def _fold_radius(coefficients: tuple[float, ...]) -> float:
    """As `fold_radius`; crops and resizes of a camera share their lens, hence the cache."""
    exact = torch.tensor(coefficients, dtype=torch.float64)
    k = [float(c) for c in _padded(exact)]
    above = np.polynomial.Polynomial([1.0, k[0], k[1], k[4]])
    below = np.polynomial.Polynomial([1.0, k[5], k[6], k[7]])
    s = np.polynomial.Polynomial([0.0, 1.0])
    slope = above * below + 2 * s * (above.deriv() * below - above * below.deriv())
    roots = np.concatenate([slope.trim().roots(), below.trim().roots()])
    real = roots.real[(np.abs(roots.imag) < 1e-9 * (1 + np.abs(roots.real))) & (roots.real > 0)]
    radius = math.sqrt(real.min()) if real.size else math.inf
    tilt = _tilt(exact) if any(coefficients[12:]) else None
    if tilt is None and not any(k[2:4] + k[8:12]):
        return radius
    limit = min(radius, MAX_RADIUS)
    radii = torch.linspace(0, limit, 501, dtype=torch.float64)
    angles = torch.linspace(0, 2 * math.pi, 73, dtype=torch.float64)[:-1]
    rays = torch.stack([angles.cos(), angles.sin()], -1)
    jac = distortion_jacobian(radii[:-1, None, None] * rays, exact[:12])
    trace = jac[..., 0, 0] + jac[..., 1, 1]
    det = jac[..., 0, 0] * jac[..., 1, 1] - (jac[..., 0, 1] + jac[..., 1, 0]).square() / 4
    bad = ((trace <= 0) | (det <= 0)).any(-1)
    if tilt is not None:
        bad |= ~map_plane(distort(radii[:-1, None, None] * rays, exact[:12]), tilt)[1].all(-1)
    return float(radii[max(int(bad.float().argmax()) - 1, 1)]) if bool(bad.any()) else limit


def distort_extended(
    points: Float[Tensor, "*b 2"], coefficients: Float[Tensor, "d"], radius: float
) -> Float[Tensor, "*b 2"]:
    """As `distort` up to a radius, and continued along each ray in proportion beyond it.

    Points past the fold would otherwise land back inside the image, and powers of large radii
    overflow float32.

    Args:
        points: ideal points on the plane z = 1, *b 2.
        coefficients: as in `distort`.
        radius: where the continuation starts, from `fold_radius`; at most 1000 is used.

    Returns:
        Distorted points, *b 2, finite with finite gradients for finite points.

    >>> barrel = torch.tensor([-0.5, 0.0, 0.0, 0.0])
    >>> distort_extended(torch.tensor([4.0, 0.0]), barrel, 0.5).tolist()
    [3.5, 0.0]
    """
    if coefficients.shape[-1] == 0:
        return points
    stretch = stretch_beyond(points, min(radius, 1e3))
    tilt, coefficients = _tilt(coefficients), coefficients[:12]
    bent = distort(points / stretch, coefficients) * stretch
    return bent if tilt is None else map_plane(bent, tilt)[0]


def stretch_beyond(points: Float[Tensor, "*b 2"], limit: float) -> Float[Tensor, "*b 1"]:
    """How many times farther than a radius points lie; 1 inside it.

    Args:
        points: finite points of a plane, *b 2, however far: squares are taken of shares of their
            largest coordinate, which do not overflow.
        limit: the radius, above 0.

    Returns:
        max(|point| / limit, 1), *b 1, differentiable.

    >>> far = stretch_beyond(torch.tensor([[3e30, 4e30], [0.3, 0.4]]), 1.0)
    >>> [f"{float(value):.4g}" for value in far]
    ['5e+30', '1']
    """
    size = points.detach().abs().amax(-1, keepdim=True).clamp_min(limit)
    # the clamp keeps sqrt away from 0, where its gradient is infinite
    square = (points / size).square().sum(-1, keepdim=True)
    return torch.sqrt(torch.maximum(square, (limit / size).square())) * (size / limit)


def undistort(
    points: Float[Tensor, "*b 2"],
    coefficients: Float[Tensor, "d"],
    radius: float | None = None,
    steps: int = 12,
) -> tuple[Float[Tensor, "*b 2"], Bool[Tensor, "*b"]]:
    """Inverse of `distort` by Newton's method with the analytic 2×2 Jacobian.

    Args:
        points: distorted points on the plane z = 1, *b 2.
        coefficients: as in `distort`.
        radius: `fold_radius(coefficients)` where it is at hand (it is computed otherwise).
        steps: Newton steps after a first guess from a radial table; 8 reach 1e-13 on usual
            lenses.

    Returns:
        Ideal points, *b 2, finite, differentiable once in points and coefficients (implicit
        function theorem); and a mask *b, False where Newton did not converge inside the fold
        radius, so that no ideal point exists.

    Raises:
        InputError: another number of coefficients.

    Reference: Newton's method; derivative of the inverse by the implicit function theorem.

    >>> ideal, valid = undistort(torch.tensor([1.5, 0.0]), torch.tensor([0.5, 0.0, 0.0, 0.0]))
    >>> [round(v, 5) for v in ideal.tolist()], bool(valid)
    ([1.0, 0.0], True)
    """
    if coefficients.shape[-1] == 0:
        return points, torch.ones_like(points[..., 0], dtype=torch.bool)
    limit = fold_radius(coefficients) if radius is None else radius
    tilt, exists = _tilt(coefficients), torch.ones_like(points[..., 0], dtype=torch.bool)
    if tilt is not None:  # a homography has an exact inverse; what is left is the lens of 12
        points, exists = map_plane(points, torch.linalg.inv(tilt))
        coefficients = coefficients[:12]
    # strictly inside: at the fold itself the Jacobian is singular
    inner = min(limit * (1 - 1e-6), 1e3)
    target, fixed = points.detach(), coefficients.detach()
    tolerance = 64 * torch.finfo(points.dtype).eps
    with torch.no_grad():
        ideal = _first_guess(target, fixed, min(inner, MAX_RADIUS))
        for _ in range(steps):
            error = distort(ideal, fixed) - target
            ideal = _into_disc(
                ideal - solve_two_by_two(distortion_jacobian(ideal, fixed), error), inner
            )
        error = (distort(ideal, fixed) - target).abs().amax(-1)
        valid = exists & (error <= tolerance * (1 + target.abs().amax(-1)))
        jac = distortion_jacobian(ideal, fixed)
    if torch.is_grad_enabled() and (points.requires_grad or coefficients.requires_grad):
        # one more Newton step whose value changes nothing carries the implicit derivative
        step = solve_two_by_two(jac, distort(ideal, coefficients) - points)
        ideal = ideal - torch.where(valid[..., None], step, torch.zeros_like(step))
    return ideal, valid


def _first_guess(
    target: Float[Tensor, "*b 2"], coefficients: Float[Tensor, "d"], radius: float
) -> Float[Tensor, "*b 2"]:
    """Inverts the radial part by a table: Newton alone crawls from far on strong pincushions."""
    # the radial part grows all the way to the fold, so the table is sorted
    table = torch.linspace(0, radius, 257).to(target)
    images = table * _radial(table * table, _padded(coefficients))[0]
    norm = target.norm(dim=-1)
    upper = torch.searchsorted(images, norm.contiguous()).clamp(1, 256)
    below, above = images[upper - 1], images[upper]
    part = ((norm - below) / (above - below)).clamp(0, 1)
    found = torch.lerp(table[upper - 1], table[upper], part)
    return target * (found / norm.clamp_min(torch.finfo(norm.dtype).tiny))[..., None]


def _into_disc(points: Float[Tensor, "*b 2"], radius: float) -> Float[Tensor, "*b 2"]:
    """Pulls points beyond the radius back onto it, along their ray."""
    norm = points.norm(dim=-1, keepdim=True)
    return points * (radius / norm.clamp_min(radius))
