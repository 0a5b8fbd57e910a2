"""Rendering front to back: a ray stops when its light is spent (MonoPartNeRF, eq. 9)."""

import dataclasses
import itertools
from collections import Counter
from dataclasses import dataclass

import torch
from torch import Tensor

from monopart.fields.volume import composite
from monopart.geometry.cameras import Rays
from monopart.geometry.culling import ShellSamples
from monopart.geometry.posed_parts import PosedParts

from .model import AvatarModel, FrameInput, Shaded, distance
from .skipping import EVERY, Skipping

SPENT = 5e-5  # light left below which a ray stops: the largest change of a colour
EMPTY = 2e-3  # light that a coarse sample takes below which its surroundings count as empty
ROUNDS_COARSE = (0, 13, 25, 49, 1 << 30)  # the same, in whole coarse steps of 2, 3, 4, 6
ROUNDS = (0, 7, 11, 15, 20, 28, 40, 1 << 30)  # samples of a ray after which the light is checked


@dataclass(frozen=True)
class Marched:
    """Colours of rays.

    Attributes:
        color: [R, 3] over black.
        opacity: [R].
        depth: [R] expected distance, metres.
        stats: counts of rays, samples and pairs.
    """

    color: Tensor
    opacity: Tensor
    depth: Tensor
    stats: Counter[str]


@torch.no_grad()
def march(
    model: AvatarModel,
    bodies: PosedParts,
    frames: FrameInput,
    rays: Rays,
    prune: float = 0.0,
    skip: Skipping = EVERY,
    coarse: int = 1,
) -> Marched:
    """Colours of the rays of one body, without what lies behind an opaque front.

    Args:
        model: the avatar.
        bodies: the posed body, in its local frame.
        frames: its time and code.
        rays: [R] rays in that frame.
        prune: see :meth:`AvatarModel.shade`.
        skip: see :meth:`AvatarModel.shade`.
        coarse: look at every so many samples of a ray first, and between two of them only where
            one of the two takes light (approximate); 1 looks at all.
    """
    step = model.config.geometry.step
    samples = bodies.shell.sample(rays, step)
    count = len(rays.directions)
    like = samples.depth
    color, light, depth = like.new_zeros(count, 3), like.new_ones(count), like.new_zeros(count)
    stats: Counter[str] = Counter(
        rays=count, samples_dense=samples.dense, samples_shell=len(samples.depth)
    )
    ray = samples.ray.long()
    place = torch.arange(len(ray), device=ray.device) - samples.ray_start[ray]
    for first, end in itertools.pairwise(ROUNDS if coarse == 1 else ROUNDS_COARSE):
        keep = (place >= first) & (place < end) & (light > SPENT)[ray]
        part = samples.rows(keep)
        if not len(part.depth):
            break  # no ray has light and samples left
        if coarse > 1:
            lattice = (place[keep] - first) % coarse == 0
            shaded = _coarse_to_fine(model, bodies, frames, part, prune, lattice, skip)
        else:
            shaded = model.shade(bodies, frames, part, prune, skip)
        delta = torch.full_like(part.depth, model.interval)
        out = composite(shaded.sigma, shaded.color, delta, part.ray_start, part.depth)
        color += light[:, None] * out.color
        depth += light * distance(out)
        light *= 1.0 - out.opacity
        stats.update(shaded.counts)
    return Marched(color, 1.0 - light, depth, stats)


def _coarse_to_fine(
    model: AvatarModel,
    bodies: PosedParts,
    frames: FrameInput,
    samples: ShellSamples,
    prune: float,
    lattice: Tensor,
    skip: Skipping,
) -> Shaded:
    """Shade the samples of a lattice, then those between two of which one takes light.

    Args:
        model: the avatar.
        bodies: the posed body.
        frames: its time and code.
        samples: [M] samples of rays.
        prune: see :meth:`AvatarModel.shade`.
        lattice: [M] whether a sample is a coarse one; the last of a ray becomes one.
        skip: see :meth:`AvatarModel.shade`.

    Returns:
        Density and colour of all samples, 0 where none was evaluated; the counts of both passes
        and the pairs of the second.
    """
    looked = lattice.clone()
    ends = samples.ray_start[1:][samples.ray_start.diff() > 0] - 1
    looked[ends] = True
    first = model.shade(bodies, frames, samples.rows(looked), prune, skip)
    sigma, color = torch.zeros_like(samples.depth), torch.zeros_like(samples.points)
    sigma[looked], color[looked] = first.sigma, first.color
    # Coarse samples before and after each sample: both lie on its ray, whose ends are coarse.
    taken = sigma[looked] * model.interval > EMPTY
    before = looked.long().cumsum(0) - 1
    fine = ~looked & (taken[before] | taken[(before + 1).clamp(max=len(taken) - 1)])
    second = model.shade(bodies, frames, samples.rows(fine), prune, skip)
    sigma[fine], color[fine] = second.sigma, second.color
    counts = {name: first.counts[name] + count for name, count in second.counts.items()}
    return dataclasses.replace(second, sigma=sigma, color=color, counts=counts)
