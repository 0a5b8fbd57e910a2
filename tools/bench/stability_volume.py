"""Stress of compositing, the union of parts and visibility along rays."""

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from monopart.fields.occupancy import visible_samples
from monopart.fields.part_union import union_by_density
from monopart.fields.volume import composite

from .stability_cases import DOUBLE, Backend, Family, Inputs, Stress, Way, kinds_of
from .stability_rotations import Make
from .stability_splats import splats

_HUGE = 2.0**126  # an infinite density, as a number that can be compared

# --- compositing -------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Rays:
    """Rays of as many samples each; with empty ones at both ends."""

    samples: int
    rays: int = 16

    @property
    def start(self) -> Tensor:
        inner = torch.arange(self.rays + 1) * self.samples
        return torch.cat((inner[:1], inner, inner[-1:]))


def _march(
    rays: _Rays, sigma: Callable[[Tensor], Tensor], delta: Callable[[Tensor], Tensor]
) -> Make:
    """Densities and lengths made of numbers in [0, 1), and colours."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        share = torch.rand(5, rays.samples * rays.rays, generator=generator, dtype=DOUBLE)
        return sigma(share[0]), share[1:4].mT.contiguous(), delta(share[4])

    return make


def exact_composite(
    rays: _Rays, sigma: np.ndarray, color: np.ndarray, delta: np.ndarray
) -> np.ndarray:
    """Front to back, sample after sample: colour and opacity of each ray."""
    start, out = rays.start.tolist(), np.zeros((len(rays.start) - 1, 4))
    for r, (first, last) in enumerate(itertools.pairwise(start)):
        depth = 0.0
        for i in range(first, last):
            optical = min(min(sigma[i], 1e30) * delta[i], 1e3)
            weight = np.exp(-depth) * -np.expm1(-optical)
            out[r, :3] += weight * color[i]
            out[r, 3] += weight
            depth += optical
    return out


def _composite_way(backend: Backend) -> Way:
    def run(rays: _Rays, sigma: Tensor, color: Tensor, delta: Tensor) -> Tensor:
        seen = composite(sigma, color, delta, rays.start, backend=backend)
        return torch.cat((seen.color, seen.opacity[:, None]), 1)

    kinds = kinds_of(backend)
    return Way(f"monopart {backend}", run, True, kinds)


def _constant(value: float) -> Callable[[Tensor], Tensor]:
    return lambda share: torch.full_like(share, value)


def _composite() -> Stress:
    few, many = _Rays(64), _Rays(4096, 4)

    def centimetre(share: Tensor) -> Tensor:
        return 0.01 * share

    shapes = (
        ("usual", few, lambda s: 100 * s, centimetre, True),
        ("σ = 0", few, _constant(0.0), centimetre, False),
        ("σ = 1e-38", few, _constant(1e-38), centimetre, False),
        ("σ = 1e-7", few, _constant(1e-7), centimetre, True),
        ("σ = 1e30", few, _constant(1e30), centimetre, False),
        ("σ = ∞", few, _constant(np.inf), centimetre, False),
        ("some σ = ∞", few, lambda s: torch.where(s > 0.9, np.inf, 10 * s), centimetre, False),
        ("lengths of 0", few, lambda s: 100 * s, _constant(0.0), False),
        ("σ = ∞, lengths of 0", few, _constant(np.inf), _constant(0.0), False),
        ("saturated", few, lambda s: 1e5 * s, centimetre, False),
        ("4096 samples, thin", many, lambda s: s, lambda s: 1e-3 * s, True),
        ("4096 samples, thick", many, lambda s: 100 * s, centimetre, False),
        ("one sample", _Rays(1, 64), lambda s: 100 * s, centimetre, True),
        ("no samples", _Rays(0), lambda s: s, lambda s: s, False),
    )
    families = tuple(
        Family(name, _march(rays, sigma, delta), extra=rays, smooth=smooth, step=1e-9)
        for name, rays, sigma, delta, smooth in shapes
    )
    return Stress(
        name="composite",
        title="compositing",
        domain="σ in [0, ∞], finite lengths ≥ 0, thousands of samples; NaN stays NaN",
        error="1, the largest opacity",
        families=families,
        ways=(_composite_way("torch"), _composite_way("warp")),
        exact=exact_composite,
        wrt=(0, 1, 2),
        rows_apart=False,
        limit=3e-7,
    )


# --- the union of parts ------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Pairs:
    """Every sample in every part."""

    samples: int
    parts: int

    @property
    def index(self) -> tuple[Tensor, Tensor]:
        part = torch.arange(self.parts).repeat_interleave(self.samples)
        return torch.arange(self.samples).repeat(self.parts), part


def exact_union(pairs: _Pairs, sigma: np.ndarray) -> np.ndarray:
    """Largest density of each sample, by a loop."""
    out = np.zeros(pairs.samples)
    for at, value in zip(pairs.index[0].tolist(), sigma, strict=True):
        out[at] = max(out[at], value)
    return np.minimum(out, _HUGE)


def _densities(pairs: _Pairs, value: float | None) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        share = torch.rand(pairs.samples * pairs.parts, generator=generator, dtype=DOUBLE)
        return (share if value is None else torch.full_like(share, value),)

    return make


def _union() -> Stress:
    def run(pairs: _Pairs, sigma: Tensor) -> Tensor:
        sample, part = pairs.index
        union = union_by_density(sigma, sample, part, pairs.samples, pairs.parts)
        return union.sigma.clamp(max=_HUGE)

    five = _Pairs(256, 5)
    shapes = (
        *(("any", five, None), ("equal", five, 3.0), ("0", five, 0.0), ("1e-38", five, 1e-38)),
        *(("1e30", five, 1e30), ("∞", five, np.inf), ("one part", _Pairs(256, 1), None)),
        ("no samples", _Pairs(0, 5), None),
    )
    families = [
        Family(name, _densities(pairs, value), extra=pairs, smooth=name in ("any", "one part"))
        for name, pairs, value in shapes
    ]
    nan = _densities(five, np.nan)
    return Stress(
        name="part_union",
        title="union of parts",
        domain="densities in [0, ∞]; equal ones go to the first part; a NaN stays a NaN",
        error="largest density of the sample, at least 1",
        families=(*families, Family("NaN", nan, extra=five, inside=False)),
        ways=(Way("monopart", run, True),),
        exact=exact_union,
        scale=lambda pairs, exact, sigma: np.maximum(1.0, exact),
        rows_apart=False,
    )


# --- visibility --------------------------------------------------------------------------------


def _wall(rays: _Rays, size: float) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        total = rays.samples * rays.rays
        return (size * (0.01 + torch.rand(total, generator=generator, dtype=DOUBLE)),)

    return make


def _visible() -> Stress:
    """A wrong answer is off by how far the depth in front is from the limit."""

    def run(rays: _Rays, wall: Tensor) -> Tensor:
        ray = torch.arange(rays.rays).repeat_interleave(rays.samples) + 1
        return visible_samples(wall, rays.start, ray, 10.0).double()

    def exact(rays: _Rays, wall: np.ndarray) -> np.ndarray:
        own = np.minimum(wall.reshape(rays.rays, -1), 1e300)
        return (np.cumsum(own, 1) - own).reshape(-1)

    def off(seen: np.ndarray, before: np.ndarray) -> np.ndarray:
        wrong = np.minimum(np.nan_to_num(np.abs(before - 10.0), nan=np.inf), _HUGE)
        return np.where((before < 10.0) == (seen > 0), 0.0, wrong)

    families = [
        Family(f"{s} samples of {size:g}", _wall(_Rays(s, 2), size), extra=_Rays(s, 2))
        for s, size in ((64, 1.0), (1024, 0.05), (1024, 1e3), (64, 0.0), (64, 1e30), (64, np.inf))
    ]
    return Stress(
        name="visible_samples",
        title="visible samples (error of the depth in front)",
        domain="any optical depths: infinity is opaque, NaN no wall; sums are taken in float64",
        error="10, the limit",
        families=tuple(families),
        ways=(Way("monopart", run, True, differentiable=False),),
        exact=exact,
        off=off,
        scale=lambda rays, exact, wall: 10.0,
        wrt=(),
    )


def stresses() -> list[Stress]:
    """Operations along rays."""
    return [_composite(), _union(), _visible(), *splats()]
