"""Stress of the losses of a training, and of the poses that an unseen one is blended from."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.parts import PartMap
from monopart.toolkit.losses import (
    SMOOTH,
    absolute_loss,
    color_loss,
    distortion_loss,
    elastic_loss,
    offset_loss,
)
from monopart.toolkit.memory import NEIGHBOURS, PartMemory, PoseMemory

from .stability_cases import DOUBLE, SINGLE, Family, Inputs, Stress, Way
from .stability_rotations import Make, axes, exact_angle, exact_rotmat

# --- means over rays and samples ---------------------------------------------------------------


def _pairs(kind: str) -> Make:
    """Colours or offsets, and what they are compared with."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        count = {"none": 0, "one": 1}.get(kind, count)
        first, second = torch.rand(2, count, 3, generator=generator, dtype=DOUBLE)
        if kind == "equal":
            second = first.clone()
        elif kind == "without variance":
            first, second = torch.full_like(first, 0.25), torch.full_like(second, 0.75)
        elif kind == "black and white":
            first, second = first.round(), second.round()
        elif kind == "one place apart":
            second = first * (1 + 2.0**-23)
        elif kind == "zero":
            first, second = 0 * first, 0 * second
        elif kind in ("1e-30", "1e15"):
            first, second = first * float(kind), second * float(kind)
        return first, second

    return make


_IMAGES = ("none", "one", "usual", "equal", "without variance", "black and white")
_IMAGES = (*_IMAGES, "one place apart", "zero", "1e-30", "1e15")


def _mean_loss(
    name: str,
    title: str,
    domain: str,
    loss: Callable[[Tensor, Tensor], Tensor],
    row: Callable[[np.ndarray, np.ndarray], float],
) -> Stress:
    """A loss that is a mean over rows, or entries, of what a row adds."""

    def exact(extra: None, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        total = math.fsum(row(a, b) for a, b in zip(first, second, strict=True))
        return np.array([total / max(len(first), 1)])

    def scale(extra: None, found: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        # a difference is as good as its terms: of equal images nothing is left but that
        size = max(np.abs(first).max(initial=0), np.abs(second).max(initial=0)) + 1e-30
        slope = size if name == "color_loss" else 1.0
        return np.maximum(np.abs(found), np.maximum(size * slope, 1e-30))

    # among thousands of absolute differences some are within a step of their kink
    kinks = name == "absolute_loss"
    smooth = ("one", "without variance") if kinks else ("one", "usual", "without variance", "zero")
    families = [Family(kind, _pairs(kind), smooth=kind in smooth) for kind in _IMAGES]
    return Stress(
        name=name,
        title=title,
        domain=domain,
        error="largest entry, to the power of the loss, at least 1e-30",
        families=tuple(families),
        ways=(Way("monopart", lambda extra, a, b: loss(a, b)[None], True),),
        exact=exact,
        scale=scale,
        wrt=(0, 1),
        rows_apart=False,
        cases=4096,
    )


def _mean_losses() -> list[Stress]:
    none = "entries below 1e15; no rows at all give exactly 0 with no gradient; "
    return [
        _mean_loss(
            "color_loss",
            "squared colour loss",
            none + "the gradient of equal images is 0",
            color_loss,
            lambda a, b: float(np.square(a - b).mean()),
        ),
        _mean_loss(
            "absolute_loss",
            "absolute colour loss",
            none + "the gradient where colours are equal is taken as 0",
            absolute_loss,
            lambda a, b: float(np.abs(a - b).mean()),
        ),
        _mean_loss(
            "elastic_loss",
            "elastic loss",
            none + "the length of a difference of 0 is 1 mm, smooth",
            elastic_loss,
            lambda a, b: math.sqrt(float(np.square(a - b).sum()) + SMOOTH),
        ),
        _mean_loss(
            "offset_loss",
            "offset loss",
            none + "the length of an offset of 0 is 1 mm, smooth",
            lambda a, b: offset_loss(a),
            lambda a, b: math.sqrt(float(np.square(a).sum()) + SMOOTH),
        ),
    ]


# --- distortion --------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Marched:
    """Rays of as many samples each, between two empty ones."""

    samples: int
    rays: int = 8
    near: float = 2.0

    @property
    def start(self) -> Tensor:
        inner = torch.arange(self.rays + 1) * self.samples
        return torch.cat((inner[:1], inner, inner[-1:]))


_STEP = 0.01


def _weights(rays: _Marched, kind: str) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        total = rays.samples * rays.rays
        share = torch.rand(total, generator=generator, dtype=DOUBLE) / max(rays.samples, 1)
        depth = rays.near + _STEP * (torch.arange(total, dtype=DOUBLE) % max(rays.samples, 1))
        if kind == "zero":
            share = 0 * share
        elif kind == "one sample each":
            share = (torch.arange(total) % rays.samples == 3).double()
        elif kind == "same depth":
            depth = torch.full_like(depth, rays.near)
        elif kind == "1e-30":
            share = 1e-30 * share
        return share, depth

    return make


def exact_distortion(rays: _Marched, weights: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """The double sum over the samples of each ray."""
    terms = []
    for first, last in itertools.pairwise(rays.start.tolist()):
        w, s = weights[first:last], depth[first:last]
        terms.append(float((w[:, None] * w * np.abs(s[:, None] - s)).sum()))
        terms.append(float((w * w).sum()) * _STEP / 3)
    return np.array([math.fsum(terms) / max(len(rays.start) - 1, 1)])


def _distortion() -> Stress:
    few, many = _Marched(64), _Marched(2048, 2)
    shapes = (
        *(("usual", few), ("zero", few), ("one sample each", few), ("same depth", few)),
        *(("1e-30", few), ("2048 samples", many), ("one sample", _Marched(1))),
        *(("none", _Marched(0)), ("1 km away", _Marched(64, near=1e3))),
    )
    families = [
        Family(name, _weights(rays, name), extra=rays, step=1e-7, smooth=name not in ("1e-30",))
        for name, rays in shapes
    ]

    def run(rays: _Marched, weights: Tensor, depth: Tensor) -> Tensor:
        return distortion_loss(weights, depth, rays.start, _STEP)[None]

    return Stress(
        name="distortion_loss",
        title="distortion loss",
        domain="finite weights and depths in order; without samples exactly 0; sums over a batch "
        "are taken in float64, as those of a ray are differences of them",
        error="the loss, at least 1e-30; depths are rounded to their last place first",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=exact_distortion,
        scale=lambda rays, exact, w, s: np.maximum(np.abs(exact), 1e-30),
        rows_apart=False,
        double=1e-10,
    )


# --- the poses that an unseen one is blended from ----------------------------------------------

_JOINTS = 24


@dataclasses.dataclass(frozen=True)
class _Keys:
    """Key poses in both precisions."""

    poses: Tensor
    """float64, in numbers of float32."""

    @functools.cached_property
    def rotmats(self) -> np.ndarray:
        """Their rotations, [F, J, 3, 3], to all digits of float64."""
        flat = exact_rotmat(None, self.poses.reshape(-1, 3).numpy())
        return flat.reshape(*self.poses.shape[:2], 3, 3)

    def like(self, ref: Tensor) -> PoseMemory:
        frames = tuple(range(len(self.poses)))
        return PoseMemory.build(frames, self.poses.to(ref), PartMap.default())


def _key_poses(count: int, spread: float, around: float = 0.3) -> _Keys:
    generator = torch.Generator().manual_seed(7)
    base = around * axes(generator, _JOINTS)
    moved = torch.randn(count, _JOINTS, 3, generator=generator, dtype=DOUBLE)
    return _Keys((base + spread * moved).float().double())


def _queries(keys: _Keys, kind: str) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        noise = torch.randn(count, _JOINTS, 3, generator=generator, dtype=DOUBLE)
        if kind == "equal":
            return (keys.poses[torch.arange(count) % len(keys.poses)],)
        if kind == "far":
            return (math.pi * noise / noise.norm(dim=-1, keepdim=True),)
        return (keys.poses[:1] + 0.05 * noise,)

    return make


def _exact_angles(pose: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Angle of every joint of a pose to that of each of other rotations, [F, J]."""
    mine = exact_rotmat(None, pose)
    pairs = np.broadcast_to(mine, theirs.shape).reshape(-1, 3, 3), theirs.reshape(-1, 3, 3)
    return exact_angle(None, *pairs).reshape(theirs.shape[:2])


def _blend(distance: np.ndarray, width: float, order: np.ndarray) -> np.ndarray:
    """Weights by key pose, of the nearest few, by a softmax that is free of overflow."""
    near = order[: min(NEIGHBOURS, len(order))]
    share = np.exp(-(distance[near] ** 2 - distance[near].min() ** 2) / (2 * width**2))
    out = np.zeros(len(distance))
    out[near] = share / share.sum()
    return out


def _retrieval(by_part: bool) -> Stress:
    """Compared by key pose, so that the order of equally near ones does not matter."""

    def run(keys: _Keys, poses: Tensor) -> Tensor:
        memory = keys.like(poses)
        out = poses.new_zeros(len(poses), len(keys.poses))
        for i, pose in enumerate(poses):
            if by_part:
                rows, weights = _parts(memory).of_pose(None, pose)
                out[i] = out[i].scatter(0, rows[0, 0], weights[0, 0])
            else:
                rows, weights = memory.weights(None, pose)
                out[i] = out[i].scatter(0, rows, weights)
        return out

    def exact(keys: _Keys, poses: np.ndarray) -> np.ndarray:
        memory, out = keys.like(torch.zeros(1, dtype=DOUBLE)), []
        joints = _parts(memory).joints[0] if by_part else tuple(range(1, _JOINTS))
        width = float(_parts(memory).widths[0]) if by_part else memory.width
        for pose in poses:
            angles = _exact_angles(pose, keys.rotmats)[:, list(joints)]
            distance = np.sqrt(np.square(angles).sum(1))
            out.append(_blend(distance, width, np.argsort(distance, kind="stable")))
        return np.stack(out)

    twice = _Keys(_key_poses(4, 0.2).poses.repeat(3, 1, 1))
    shapes = (
        ("8 keys", _key_poses(8, 0.2), "near"),
        ("a key itself", _key_poses(4, 0.2), "equal"),
        ("one key", _key_poses(1, 0.2), "near"),
        ("two keys", _key_poses(2, 0.2), "near"),
        ("equal keys", _key_poses(5, 0.0), "near"),
        ("π from all keys", _key_poses(5, 0.2), "far"),
        ("equal keys, π off", _key_poses(5, 0.0), "far"),
    )
    families = [
        Family(n, _queries(k, kind), extra=k, smooth=n in ("8 keys", "two keys"), step=1e-6)
        for n, k, kind in shapes
    ]
    tied = Family("every key thrice", _queries(twice, "near"), extra=twice, smooth=False)
    kind = "part" if by_part else "body"
    return Stress(
        name=f"retrieval_{kind}",
        title=f"key poses of a {kind} and their weights",
        domain="any poses, one key pose, fewer than five, equal ones; weights sum to 1; of equally "
        "near keys the first are taken; the width is at least 1 mrad; at a key pose the gradient "
        "of its distance is taken as 0",
        error="1, or d²/w² where larger: what a last place of a distance d does at a width w",
        families=(*families, tied),
        ways=(Way("monopart", run, True, (SINGLE, DOUBLE)),),
        exact=exact,
        scale=lambda keys, found, poses: _steepness(keys, poses, by_part),
        cases=16,
    )


def _parts(memory: PoseMemory) -> PartMemory:
    if memory.parts is None:
        raise RuntimeError("a memory by parts was built")
    return memory.parts


def _steepness(keys: _Keys, poses: np.ndarray, by_part: bool) -> np.ndarray:
    """How much of a weight the last place of a distance d moves at a width w: d²/w²."""
    memory, rows = keys.like(torch.zeros(1, dtype=DOUBLE)), torch.from_numpy(poses)
    if by_part:
        parts = _parts(memory)
        far, width = [parts.distances(p)[0].max() for p in rows], float(parts.widths[0])
    else:
        far, width = [memory.distances(p).max() for p in rows], memory.width
    return np.maximum(1.0, np.square([float(f) for f in far]) / width**2)


def stresses() -> list[Stress]:
    """Losses and retrieval."""
    return [*_mean_losses(), _distortion(), _retrieval(False), _retrieval(True)]
