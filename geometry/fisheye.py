"""OpenCV's fisheye lens (Kannala and Brandt) on the plane z = 1, its fold and its inverse.

A ray at angle θ to the optical axis appears at distance θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) from
the centre. Points are given on the plane z = 1, so rays in front of the camera are covered.
"""

import math
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .errors import InputError
from .two_by_two import solve_two_by_two

MAX_RADIUS = 1e3
"""Radius on the plane z = 1 (89.94 degrees off axis) up to which points have an image."""
_SMALL = 1e-6
"""Squared radius below which atan(r)/r is its series; the error is below 1e-19."""


def _coefficients(coefficients: Float[Tensor, "d"]) -> tuple[Tensor, ...]:
    """k1 to k4 as scalars, zeros where none are given."""
    count = coefficients.shape[-1]
    if count not in (0, 4):
        raise InputError(
            f"distortion: expected the 4 coefficients of OpenCV's fisheye lens or none, found "
            f"{count}; pad with zeros"
        )
    return (coefficients if count else coefficients.new_zeros(4)).unbind(-1)


def _angle_ratio(r2: Tensor) -> tuple[Tensor, Tensor]:
    """atan(r)/r of r² and its derivative with respect to r², both smooth at 0."""
    near = r2 < _SMALL
    safe = torch.where(near, torch.ones_like(r2), r2)
    r = safe.sqrt()
    ratio = torch.where(near, 1 - r2 / 3 + r2 * r2 / 5, torch.atan(r) / r)
    slope = torch.where(
        near,
        -1 / 3 + r2 * 2 / 5 - r2 * r2 * 3 / 7,
        (1 / (1 + safe) - torch.atan(r) / r) / (2 * safe),
    )
    return ratio, slope


def _factor(r2: Tensor, k: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Distorted over ideal radius, and its derivative with respect to the squared ideal radius."""
    ratio, slope = _angle_ratio(r2)
    square = r2 * ratio * ratio
    square_slope = ratio * ratio + 2 * r2 * ratio * slope
    poly = 1 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3])))
    bend = k[0] + square * (2 * k[1] + square * (3 * k[2] + square * 4 * k[3]))
    return ratio * poly, slope * poly + ratio * bend * square_slope


def fisheye_distort(
    points: Float[Tensor, "*b 2"], coefficients: Float[Tensor, "d"]
) -> Float[Tensor, "*b 2"]:
    """Moves ideal points of the plane z = 1 to where the lens puts them.

    Args:
        points: ideal points (x/z, y/z), camera axes, no unit, *b 2.
        coefficients: k1 k2 k3 k4, or none for an equidistant lens.

    Returns:
        Distorted points, *b 2. Differentiable in both arguments.

    Raises:
        InputError: another number of coefficients.

    Reference: Kannala and Brandt, "A generic camera model", 2006; OpenCV `cv::fisheye`.

    >>> round(float(fisheye_distort(torch.tensor([1.0, 0.0]), torch.zeros(4))[0]), 4)  # π / 4
    0.7854
    """
    k = _coefficients(coefficients)
    return points * _factor(points.square().sum(-1), k)[0][..., None]


def fisheye_jacobian(
    points: Float[Tensor, "*b 2"], coefficients: Float[Tensor, "d"]
) -> Float[Tensor, "*b 2 2"]:
    """Derivative of `fisheye_distort` with respect to its points, in closed form.

    Args:
        points: ideal points on the plane z = 1, *b 2.
        coefficients: as in `fisheye_distort`.

    Returns:
        Jacobians, *b 2 2, row = output, column = input. Differentiable in both arguments.

    Raises:
        InputError: another number of coefficients.

    >>> fisheye_jacobian(torch.zeros(2), torch.zeros(4)).tolist()
    [[1.0, 0.0], [0.0, 1.0]]
    """
    factor, slope = _factor(points.square().sum(-1), _coefficients(coefficients))
    outer = points[..., :, None] * points[..., None, :]
    eye = torch.eye(2, dtype=points.dtype, device=points.device)
    return factor[..., None, None] * eye + 2 * slope[..., None, None] * outer


def fisheye_fold_radius(coefficients: Float[Tensor, "d"]) -> float:
    """Radius on the plane z = 1 inside which the lens is one-to-one.

    It is the tangent of the first angle at which the distorted radius stops growing, exact; at most
    `MAX_RADIUS`, where the plane z = 1 ends in practice.

    Args:
        coefficients: as in `fisheye_distort`.

    Returns:
        The radius, no unit.

    Raises:
        InputError: another number of coefficients.

    >>> round(fisheye_fold_radius(torch.tensor([-1.0, 0, 0, 0])), 3)  # θ² = 1/3
    0.651
    """
    values = (float(k) for k in _coefficients(coefficients.detach().to("cpu", torch.float64)))
    return math.tan(_fold_angle(tuple(values)))


@lru_cache(maxsize=256)
def _fold_angle(k: tuple[float, ...]) -> float:
    limit = math.atan(MAX_RADIUS)
    growth = np.polynomial.Polynomial([1, 3 * k[0], 5 * k[1], 7 * k[2], 9 * k[3]])  # of θ²
    roots = growth.trim().roots()
    real = roots.real[(np.abs(roots.imag) < 1e-9 * (1 + np.abs(roots.real))) & (roots.real > 0)]
    return min(limit, math.sqrt(real.min())) if real.size else limit


def fisheye_undistort(
    points: Float[Tensor, "*b 2"],
    coefficients: Float[Tensor, "d"],
    radius: float | None = None,
    steps: int = 20,
) -> tuple[Float[Tensor, "*b 2"], Bool[Tensor, "*b"]]:
    """Inverse of `fisheye_distort`: Newton's method on the angle, kept inside its bracket.

    Args:
        points: distorted points on the plane z = 1, *b 2.
        coefficients: as in `fisheye_distort`.
        radius: `fisheye_fold_radius(coefficients)` where it is at hand.
        steps: Newton steps, each bisected where it leaves the bracket.

    Returns:
        Ideal points, *b 2, finite, differentiable once in points and coefficients (implicit
        function theorem); and a mask *b, False where the residual of the angle is above 64
        roundings or no angle inside the fold has that image.

    Raises:
        InputError: another number of coefficients.

    >>> ideal, valid = fisheye_undistort(torch.tensor([0.7853982, 0.0]), torch.zeros(4))
    >>> round(float(ideal[0]), 4), bool(valid)
    (1.0, True)
    """
    k = _coefficients(coefficients)
    limit = fisheye_fold_radius(coefficients) if radius is None else radius
    fold = math.atan(min(limit * (1 - 1e-6), MAX_RADIUS))
    target, fixed = points.detach(), tuple(c.detach() for c in k)
    with torch.no_grad():
        wanted = target.norm(dim=-1)
        theta, valid = _angle_of(wanted, fixed, fold, steps)
        tiny = torch.finfo(wanted.dtype).tiny
        # tan(θ)/r near the axis is 1: r there is below any rounding
        scale = torch.where(wanted > tiny, torch.tan(theta) / wanted.clamp_min(tiny), 1.0)
        ideal = target * scale[..., None]
        jac = fisheye_jacobian(ideal, coefficients.detach())
    if torch.is_grad_enabled() and (points.requires_grad or coefficients.requires_grad):
        step = solve_two_by_two(jac, fisheye_distort(ideal, coefficients) - points)
        step = step - step.detach()  # the value is that of the angle; only the derivative is added
        ideal = ideal - torch.where(valid[..., None], step, torch.zeros_like(step))
    return ideal, valid


def _angle_of(
    wanted: Tensor, k: tuple[Tensor, ...], fold: float, steps: int
) -> tuple[Tensor, Tensor]:
    """Angle θ in [0, fold] whose distorted radius is wanted, and whether there is one."""
    low, high = torch.zeros_like(wanted), torch.full_like(wanted, fold)
    theta = wanted.clamp(0, fold)
    for _ in range(steps):
        value, growth = _radius_of(theta, k)
        low = torch.where(value <= wanted, theta, low)
        high = torch.where(value >= wanted, theta, high)
        newton = theta - (value - wanted) / growth.clamp_min(torch.finfo(theta.dtype).eps)
        inside = (newton >= low) & (newton <= high)
        theta = torch.where(inside, newton, (low + high) / 2)
    error = (_radius_of(theta, k)[0] - wanted).abs()
    return theta, error <= 64 * torch.finfo(theta.dtype).eps * (1 + wanted)


def _radius_of(theta: Tensor, k: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Distorted radius of an angle and its derivative."""
    t2 = theta * theta
    radius = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
    growth = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))
    return radius, growth
