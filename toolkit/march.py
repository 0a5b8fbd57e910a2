"""Rendering front to back: a ray stops when its light is spent (MonoPartNeRF, eq. 9)."""

import itertools
from collections import Counter
from dataclasses import dataclass

import torch
from torch import Tensor

from monopart.fields.volume import composite
from monopart.geometry.cameras import Rays
from monopart.geometry.posed_parts import PosedParts

from .model import AvatarModel, FrameInput, distance
from .skipping import EVERY, Skipping

SPENT = 5e-5  # light left below which a ray stops: the largest change of a colour
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
) -> Marched:
    """Colours of the rays of one body, without what lies behind an opaque front.

    Args:
        model: the avatar.
        bodies: the posed body, in its local frame.
        frames: its time and code.
        rays: [R] rays in that frame.
        prune: see :meth:`AvatarModel.shade`.
        skip: see :meth:`AvatarModel.shade`.
    """
    step = model.config.geometry.step
    samples = bodies.shell.sample(rays, step)
    count = len(rays.directions)
    color, light = torch.zeros(count, 3), torch.ones(count)
    depth = torch.zeros(count)
    stats: Counter[str] = Counter(
        rays=count, samples_dense=samples.dense, samples_shell=len(samples.depth)
    )
    ray = samples.ray.long()
    place = torch.arange(len(ray)) - samples.ray_start[ray]
    for first, end in itertools.pairwise(ROUNDS):
        keep = (place >= first) & (place < end) & (light > SPENT)[ray]
        if not bool(keep.any()):
            break  # no ray has light and samples left
        part = samples.rows(keep)
        shaded = model.shade(bodies, frames, part, prune, skip)
        delta = torch.full_like(part.depth, step)
        out = composite(shaded.sigma, shaded.color, delta, part.ray_start, part.depth)
        color += light[:, None] * out.color
        depth += light * distance(out)
        light *= 1.0 - out.opacity
        stats.update(shaded.counts)
    return Marched(color, 1.0 - light, depth, stats)
