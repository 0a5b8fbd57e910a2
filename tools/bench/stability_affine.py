"""Stress of affine maps: inverses and points."""

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.rigid import invert_affine, transform_points

from .stability_cases import DOUBLE, Family, Inputs, Stress, Way
from .stability_rotations import Make, matrices


def _affine(shift: float, smallest: float = 0.5) -> Make:
    """Maps with singular values between the smallest and 1.5, moved by metres."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        (left,) = matrices((0.1, 3.0))(generator, count)
        (right,) = matrices((0.1, 3.0))(generator, count)
        values = smallest + torch.rand(count, 3, generator=generator, dtype=DOUBLE)
        values[:, 1:] = 1.0
        maps = torch.eye(4, dtype=DOUBLE).repeat(count, 1, 1)
        maps[:, :3, :3] = left @ torch.diag_embed(values) @ right
        maps[:, :3, 3] = shift * torch.randn(count, 3, generator=generator, dtype=DOUBLE)
        return (maps,)

    return make


def _singular(generator: torch.Generator, count: int) -> Inputs:
    (maps,) = _affine(1.0)(generator, count)
    maps[:, 2, :3] = maps[:, 1, :3]
    return (maps,)


def exact_inverse(extra: None, maps: np.ndarray) -> np.ndarray:
    """The upper rows of the inverses by LAPACK, with one step of refinement."""
    maps = np.where(np.isfinite(maps).all((1, 2), keepdims=True), maps, np.eye(4))
    singular = np.abs(np.linalg.det(maps[:, :3, :3])) < 1e-9
    found = np.linalg.inv(np.where(singular[:, None, None], np.eye(4), maps))
    return (found @ (2 * np.eye(4) - maps @ found))[:, :3]


def _inverse() -> Stress:
    families = (
        Family("affine", _affine(1.0)),
        Family("stretched ×0.05", _affine(1.0, smallest=0.05)),
        Family("100 km away", _affine(1e5), step=1e-6),
        Family("singular", _singular),
        Family("NaN", lambda g, n: (torch.full((n, 4, 4), torch.nan, dtype=DOUBLE),)),
    )
    lapack = Way(
        "torch.linalg.inv",
        lambda extra, maps: torch.linalg.inv(maps)[:, :3],
        serves=lambda family: family.name != "NaN",
    )
    return Stress(
        name="invert_affine",
        title="inverse of affine maps",
        domain="|det| > 1e-2; others, and what is not finite, are masked, with zero gradient",
        error="largest entry of the inverse times the condition number",
        families=families,
        ways=(
            Way("monopart", lambda extra, m: _masked(invert_affine(m)), True),
            lapack,
        ),
        exact=exact_inverse,
        scale=_inverse_scale,
        cases=512,
    )


def _masked(found: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    return found[0][:, :3], found[1]


def _inverse_scale(extra: None, exact: np.ndarray, maps: np.ndarray) -> np.ndarray:
    linear = np.nan_to_num(maps[:, :3, :3], posinf=1.0, neginf=1.0)
    norm = np.linalg.norm(linear, axis=(1, 2)) * np.linalg.norm(exact[:, :, :3], axis=(1, 2))
    return np.maximum(np.abs(exact).max((1, 2)), 1.0) * np.maximum(norm, 1.0)


def _points_far(shift: float, size: float) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        (maps,) = _affine(shift)(generator, count)
        return maps, size * torch.randn(count, 3, generator=generator, dtype=DOUBLE)

    return make


def _transform() -> Stress:
    families = [
        Family(f"points {s:g} m", _points_far(s, s), step=1e-5 * s) for s in (1e-3, 1.0, 1e3, 1e5)
    ]
    return Stress(
        name="transform_points",
        title="affine maps of points",
        domain="any finite input whose products are finite",
        error="largest term of the sum",
        families=tuple(families),
        ways=(Way("monopart", lambda extra, m, p: transform_points(m, p), True),),
        exact=lambda extra, m, p: np.einsum("nij,nj->ni", m[:, :3, :3], p) + m[:, :3, 3],
        scale=lambda extra, exact, m, p: np.abs(m[:, :3, 3]).max(1) + np.abs(p).max(1),
        wrt=(0, 1),
        cases=512,
    )


def stresses() -> list[Stress]:
    """Operations on affine maps."""
    return [_inverse(), _transform()]
