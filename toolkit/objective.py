"""The objective of a training step: which terms are computed, and their weights (METHOD 8)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from monopart.geometry.consistency import consistency_loss
from monopart.geometry.posed_parts import PosedParts
from monopart.geometry.stages import stage

from .config import Config
from .device import sent
from .losses import color_loss, offset_loss, round_trip_distance
from .lpips import LPIPS
from .model import AvatarModel, FrameInput, Rendered


@dataclass(frozen=True)
class Seen:
    """A rendered batch over its background, beside what it should be.

    Attributes:
        color: [N, 3] rendered colours; the rows of a patch come last.
        target: [N, 3] photographed colours.
        patch: height and width of the patch, or None.
    """

    color: Tensor
    target: Tensor
    patch: tuple[int, int] | None


class Objective:
    """Named, weighted terms; one of weight 0 is not computed."""

    def __init__(self, config: Config, canonical: PosedParts | None) -> None:
        """Choose the terms.

        Args:
            config: weights and thresholds.
            canonical: the canonical body, for the round trip; None leaves consistency out.
        """
        self.config, self.canonical = config, canonical

    def color(self, seen: Seen, lpips: LPIPS | None) -> dict[str, Tensor]:
        """Terms of colours.

        Args:
            seen: the batch.
            lpips: the perceptual metric where the batch has a patch.
        """
        spec = self.config.loss
        with stage("loss: colour"):
            terms = {"mse": spec.mse * color_loss(seen.color, seen.target)}
        if seen.patch is not None and lpips is not None:
            height, width = seen.patch
            rows, shape = len(seen.color) - height * width, (1, height, width, 3)
            with stage("loss: LPIPS"):
                shown, wanted = seen.color[rows:].reshape(shape), seen.target[rows:].reshape(shape)
                terms["lpips"] = spec.lpips * lpips(shown.clamp(0, 1), wanted).mean()
        return terms

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
        if self.canonical is not None and model.forward_residual is not None:
            with stage("loss: consistency"):
                rows = some_rows(len(out.shaded.pairs.sample), spec.consistency_samples, generator)
                rows = sent(rows, out.color.device)
                distance = round_trip_distance(model, bodies, self.canonical, frames, out, rows)
                cost = consistency_loss(distance, spec.consistency_threshold)
                terms["consistency"] = spec.consistency * cost
        return terms


def some_rows(count: int, most: int, generator: torch.Generator) -> Tensor:
    """At most ``most`` random rows of ``count``, ascending, with repetitions."""
    return torch.randint(max(count, 1), (min(most, count),), generator=generator).sort()[0]
