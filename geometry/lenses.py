"""The kinds of lens that a camera can have, behind one set of functions."""

from jaxtyping import Bool, Float
from torch import Tensor

from . import distortion, fisheye
from .errors import InputError

COUNTS: dict[str, tuple[int, ...]] = {"brown": distortion.COEFFICIENT_COUNTS, "fisheye": (0, 4)}
"""Kinds of lens and their numbers of coefficients: `brown` is OpenCV's radial, tangential,
thin-prism and tilt terms, `fisheye` its fisheye model."""


def check_lens(lens: str, count: int) -> None:
    """Refuses a kind of lens that does not exist, and a wrong number of coefficients.

    Args:
        lens: name of the kind.
        count: number of coefficients.

    Raises:
        InputError: either of them.
    """
    if lens not in COUNTS:
        raise InputError(f"lens: expected {' or '.join(COUNTS)}, found {lens!r}; choose one")
    if count not in COUNTS[lens]:
        raise InputError(
            f"distortion: expected {COUNTS[lens]} coefficients in OpenCV's order ({lens}), found "
            f"{count}; pad with zeros"
        )


def is_bent(lens: str, coefficients: Float[Tensor, "d"]) -> bool:
    """Whether a lens differs from a pinhole.

    Args:
        lens: name of the kind.
        coefficients: d.

    Returns:
        True for every fisheye, and where a coefficient is not 0.
    """
    return lens == "fisheye" or bool((coefficients.detach() != 0).any())


def lens_fold_radius(lens: str, coefficients: Float[Tensor, "d"]) -> float:
    """Radius on the plane z = 1 inside which a lens is one-to-one.

    Args:
        lens: name of the kind.
        coefficients: d.

    Returns:
        The radius, no unit; infinite where the lens never folds.
    """
    if lens == "fisheye":
        return fisheye.fisheye_fold_radius(coefficients)
    return distortion.fold_radius(coefficients)


def lens_distort(
    lens: str, points: Float[Tensor, "*b 2"], coefficients: Float[Tensor, "d"], radius: float
) -> Float[Tensor, "*b 2"]:
    """Distorted points, continued along each ray in proportion beyond a radius.

    Args:
        lens: name of the kind.
        points: ideal points on the plane z = 1, *b 2.
        coefficients: d.
        radius: from `lens_fold_radius`; at most 1000 is used.

    Returns:
        Distorted points, *b 2, finite with finite gradients for finite points.
    """
    if lens == "brown":
        return distortion.distort_extended(points, coefficients, radius)
    limit = min(radius, fisheye.MAX_RADIUS)
    stretch = distortion.stretch_beyond(points, limit)
    return fisheye.fisheye_distort(points / stretch, coefficients) * stretch


def lens_undistort(
    lens: str, points: Float[Tensor, "*b 2"], coefficients: Float[Tensor, "d"], radius: float
) -> tuple[Float[Tensor, "*b 2"], Bool[Tensor, "*b"]]:
    """Ideal points of distorted ones, and which of them exist.

    Args:
        lens: name of the kind.
        points: distorted points on the plane z = 1, *b 2.
        coefficients: d.
        radius: from `lens_fold_radius`.

    Returns:
        Points, *b 2, differentiable once in points and coefficients; mask *b, True where the
        residual is within 64 roundings and the point inside the fold.
    """
    if lens == "brown":
        return distortion.undistort(points, coefficients, radius)
    return fisheye.fisheye_undistort(points, coefficients, radius)
