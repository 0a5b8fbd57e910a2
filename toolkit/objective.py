"""The objective of a training step: which terms are computed, and their weights (METHOD 8)."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from monopart.geometry.consistency import consistency_loss
from monopart.geometry.errors import InputError, MonopartError
from monopart.geometry.parts import rows_of_parts
from monopart.geometry.posed_parts import PosedParts
from monopart.geometry.stages import stage

from .config import Config
from .device import sent
from .losses import (
    absolute_loss,
    color_loss,
    distortion_loss,
    elastic_loss,
    offset_loss,
    round_trip_distance,
)
from .lpips import LPIPS
from .model import AvatarModel, FrameInput, Rendered, Shaded
from .unseen import UnseenResiduals


@dataclass(frozen=True)
class Seen:
    """A rendered batch over its background, beside what it should be.

    Attributes:
        color: [N, 3] rendered colours; the rows of a patch come last.
        target: [N, 3] photographed colours.
        patch: height and width of the patch, or None.
        counted: number of rows before the patch, and of the patch, that count; in the others color
            and target are equal.
    """

    color: Tensor
    target: Tensor
    patch: tuple[int, int] | None
    counted: tuple[int, int]

    @property
    def random(self) -> int:
        """Rows before those of the patch."""
        return _before_patch(self.color, self.patch)

    def mean(self, loss: Callable[[Tensor, Tensor], Tensor], patch_pixels: float) -> Tensor:
        """A colour loss over all rows that count.

        Args:
            loss: mean over rows of colours and targets.
            patch_pixels: weight of a row of the patch beside any other.
        """
        rows, weight = self.random, patch_pixels if self.random else 1.0
        parts = ((slice(0, rows), 1.0), (slice(rows, None), weight))
        sums = [w * len(self.color[r]) * loss(self.color[r], self.target[r]) for r, w in parts]
        return (sums[0] + sums[1]) / max(self.counted[0] + weight * self.counted[1], 1e-9)


def seen_batch(
    color: Tensor, target: Tensor, patch: tuple[int, int] | None, counted: Tensor | None
) -> Seen:
    """A batch whose ignored pixels are right by definition, and so have no gradient.

    Args:
        color: [N, 3] rendered colours.
        target: [N, 3] photographed colours.
        patch: height and width of the patch in the last rows, or None.
        counted: [N] on the host, False where a pixel is ignored; None: all count.
    """
    rows = _before_patch(color, patch)
    if counted is None:
        return Seen(color, target, patch, (rows, len(color) - rows))
    known, numbers = sent(counted, color.device)[:, None], (counted[:rows], counted[rows:])
    shown = torch.where(known, color, target)
    return Seen(shown, target, patch, (int(numbers[0].sum()), int(numbers[1].sum())))


def _before_patch(color: Tensor, patch: tuple[int, int] | None) -> int:
    return len(color) - (math.prod(patch) if patch else 0)


class Objective:
    """Named, weighted terms; one of weight 0 is not computed."""

    def __init__(self, config: Config, canonical: PosedParts | None) -> None:
        """Choose the terms.

        Args:
            config: weights and thresholds.
            canonical: the canonical body, for the round trip and for places that no picture shows;
                None leaves both terms out.

        Raises:
            InputError: no term compares colours in every step.
        """
        if not (config.loss.mse or config.loss.l1):
            raise InputError(
                "loss.mse, loss.l1: expected a weight above 0 in one of them, found 0 in both"
            )
        self.config, self.canonical = config, canonical
        self.unseen = None
        if config.loss.unseen and canonical is not None:
            self.unseen = UnseenResiduals(canonical, config.loss.unseen_samples)
        self.round_trips: Tensor | None = None  # distances of the last step, metres

    def color(self, seen: Seen, lpips: LPIPS | None) -> dict[str, Tensor]:
        """Terms of colours.

        Args:
            seen: the batch.
            lpips: the perceptual metric where the batch has a patch.
        """
        spec = self.config.loss
        with stage("loss: colour"):
            terms = {}
            if spec.mse:
                terms["mse"] = spec.mse * seen.mean(color_loss, spec.patch_pixels)
            if spec.l1:
                terms["l1"] = spec.l1 * seen.mean(absolute_loss, spec.patch_pixels)
        if seen.patch is not None and lpips is not None:
            height, width = seen.patch
            rows, shape = seen.random, (1, height, width, 3)
            with stage("loss: LPIPS"):
                shown, wanted = seen.color[rows:].reshape(shape), seen.target[rows:].reshape(shape)
                terms["lpips"] = spec.lpips * lpips(shown.clamp(0, 1), wanted).mean()
        return terms

    def density(self, out: Rendered, done: float) -> dict[str, Tensor]:
        """Terms of the density along rays.

        Args:
            out: a rendering of the batch.
            done: finished part of the run: the weight grows tenfold in the last third.
        """
        weight, step = self.config.loss.distortion, self.config.geometry.step
        if not weight or out.weights is None:
            return {}
        with stage("loss: distortion"):
            spread = distortion_loss(out.weights, out.samples.depth, out.samples.ray_start, step)
            return {"distortion": weight * late_growth(done) * spread}

    def deformation(
        self,
        model: AvatarModel,
        bodies: PosedParts,
        frames: FrameInput,
        out: Rendered,
        generator: torch.Generator,
    ) -> dict[str, Tensor]:
        """Terms of the deformation.

        Args:
            model: the avatar.
            bodies: posed bodies of the batch.
            frames: times of the bodies.
            out: a rendering of the batch.
            generator: chooses pairs.
        """
        spec, terms = self.config.loss, {}
        if out.shaded.residual is None:
            return terms
        if spec.offset:
            with stage("loss: offset"):
                terms["offset"] = spec.offset * offset_loss(out.shaded.residual)
        if self.unseen is not None:
            with stage("loss: unseen"):
                terms["unseen"] = spec.unseen * self.unseen.loss(model, generator)
        if spec.elastic:
            with stage("loss: elastic"):
                terms["elastic"] = spec.elastic * self._elastic(model, out.shaded, generator)
        if self.canonical is not None and model.forward_residual is not None:
            with stage("loss: consistency"):
                rows = some_rows(len(out.shaded.pairs.sample), spec.consistency_samples, generator)
                rows = sent(rows, out.color.device)
                distance = round_trip_distance(model, bodies, self.canonical, frames, out, rows)
                self.round_trips = distance.detach()
                cost = consistency_loss(distance, spec.consistency_threshold)
                terms["consistency"] = spec.consistency * cost
        return terms

    def _elastic(self, model: AvatarModel, shaded: Shaded, generator: torch.Generator) -> Tensor:
        """Residuals of some pairs against those beside them at the same time."""
        spec, field = self.config.loss, model.backward_residual
        if shaded.place is None or shaded.residual is None or field is None:
            raise MonopartError("elastic loss: expected residuals in the rendering, found none")
        rows = some_rows(len(shaded.place), spec.consistency_samples, generator)
        noise = torch.randn(len(rows), shaded.place.shape[1] - 1, generator=generator)
        rows, noise = sent(rows, shaded.place.device), sent(noise, shaded.place.device)
        part, place = shaded.pairs.part[rows], shaded.place[rows]
        beside = (place[:, :-1] + spec.elastic_reach * noise).clamp(0.0, 1.0)
        beside = torch.cat([beside, place[:, -1:]], -1)
        neighbour = field(beside, part, rows_of_parts(part, model.num_parts))
        return elastic_loss(shaded.residual.index_select(0, rows), neighbour)


def late_growth(done: float) -> float:
    """Factor of the distortion loss: 1 until two thirds of the run, then linearly up to 10.

    >>> late_growth(0.5), late_growth(1.0)
    (1.0, 10.0)
    """
    return 1.0 + 9.0 * min(max(3.0 * done - 2.0, 0.0), 1.0)


def some_rows(count: int, most: int, generator: torch.Generator) -> Tensor:
    """At most ``most`` rows of ``count``, ascending: all of them, or random ones, maybe twice."""
    if count <= most:
        return torch.arange(count)
    return torch.randint(count, (most,), generator=generator).sort()[0]
