"""``monopart-bench skipping RUN``: what is left of the work, and what leaving it out saves."""

import copy
import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch

from monopart.geometry.errors import InputError

from .registry import Method, Operation, Problem, Settings
from .render import PRUNE, ViewData, trained, view_problems
from .timing import Effort

RAYS = 2048  # as in training
BEYOND = 10.0  # metres: a radius within which every part of a person lies
ONCE = Effort(1, 1, 0.0)
SLOW = Effort(rounds=5, least=3, seconds=30.0)


@dataclass(eq=False)
class BatchData:
    """A batch of training pixels and a trained avatar."""

    trainer: Any
    batch: Any

    @cached_property
    def dense(self) -> Any:
        """Colours with every part searched at every sample in the box."""
        with torch.no_grad():
            return _colors(self, self.trainer.scene.parts.unculled(), 0.0).color


def _colors(data: BatchData, parts: Any, prune: float) -> Any:
    trainer = data.trainer
    rays, body = trainer.rays(data.batch)
    inputs = trainer.avatar.training_input()
    return trainer.avatar.model.render_rays(parts, inputs, rays, body, None, prune)


def _everything(parts: Any) -> Any:
    """Parts whose every (sample, part) pair reaches the networks."""
    other = copy.copy(parts.unculled())
    other.radius = torch.full_like(parts.radius, BEYOND)
    return other


def _step(
    view: Callable[[Any], Any], prune: bool = False
) -> Callable[[BatchData], Callable[[], Any]]:
    """Forward and backward of the colour loss over some version of the parts."""

    def prepare(data: BatchData) -> Callable[[], Any]:
        from monopart.toolkit.train import PRUNE

        parts = view(data.trainer.scene.parts)
        model = data.trainer.avatar.model.eval()
        weights = list(model.parameters())

        def call() -> Any:
            out = _colors(data, parts, PRUNE if prune else 0.0)
            loss = (out.color - data.batch.color).square().mean()
            torch.autograd.grad(loss, weights, allow_unused=True)
            return out

        return call

    return prepare


def opened(settings: Settings) -> Any:
    """The avatar of a run, or an untrained one of a capture.

    Raises:
        InputError: neither was named, or it cannot be read.
    """
    from monopart.toolkit.avatar import Avatar
    from monopart.toolkit.cache import user_cache
    from monopart.toolkit.captures import read_capture
    from monopart.toolkit.presets import preset

    if settings.run is None:
        raise InputError("skipping: expected a run or a capture, found none; name a folder")
    if (settings.run / "config.json").is_file():
        return trained(settings)
    record, config = read_capture(settings.run), preset("fast")
    torch.manual_seed(config.seed)
    return Avatar.create(record, config, user_cache())


def _trainer(settings: Settings) -> Any:
    from monopart.toolkit.train import Trainer

    return Trainer(opened(settings))


def _near(settings: Settings) -> Iterator[Problem]:
    """Pixels as training draws them."""
    trainer, count = _trainer(settings), 16 if settings.quick else RAYS
    batch = trainer.sampler.random(count, torch.Generator().manual_seed(2))
    yield Problem(count, "pixels near the person", BatchData(trainer, batch), SLOW)


def _anywhere(settings: Settings) -> Iterator[Problem]:
    """Pixels of whole images, most of them far from the person."""
    from monopart.toolkit.captures.patches import PixelBatch

    trainer, count = _trainer(settings), 16 if settings.quick else RAYS
    generator = torch.Generator().manual_seed(2)
    images, height, width = trainer.sampler.masks.shape
    image = torch.randint(images, (count,), generator=generator).sort().values
    x, y = (torch.randint(n, (count,), generator=generator) for n in (width, height))
    mask = trainer.sampler.masks[image, y, x]
    color = trainer.sampler.images[image, y, x].float() / 255.0 * mask[:, None]
    pixels = torch.stack([x, y], -1).float() + 0.5
    batch = PixelBatch(image, pixels, color, mask)
    yield Problem(count, "pixels of whole images", BatchData(trainer, batch), SLOW)


def _judge_step(data: BatchData, out: Any) -> dict[str, float]:
    return {
        "error": float((out.color.detach() - data.dense).abs().max()),
        "samples": float(out.stats["samples_shell"]),
        "pairs": float(out.stats["pairs_evaluated"]),
        "reach a network": float(out.stats["samples_reached"]),
    }


def _views(settings: Settings) -> Iterator[Problem]:
    for problem in view_problems(settings, opened):
        yield dataclasses.replace(problem, effort=ONCE)


def _shares(prune: float) -> Callable[[ViewData], Callable[[], Any]]:
    """Samples of a picture before and after each kind of skipping, in percent of the dense ones."""

    def prepare(data: ViewData) -> Callable[[], Any]:
        return lambda: _counted(data, prune)

    return prepare


def _counted(data: ViewData, prune: float) -> dict[str, float]:
    from monopart.toolkit.render import render_view
    from monopart.toolkit.scene import shell_pixels

    avatar, view = data.avatar, data.view
    scene = avatar.pose_scene(view.pose)
    _, rays, *_ = shell_pixels(view.camera, scene, 0)
    samples = scene.parts.shell.sample(rays, avatar.config.geometry.step)
    pairs = scene.parts.pairs(samples)
    picture = render_view(avatar, view, scene=scene, prune=prune)
    height, width = view.camera.size
    per_ray = 64.0 * height * width / 100.0
    return {
        "error": float((picture.color - data.dense.color).abs().max()),
        "in the box %": samples.dense / per_ray,
        "in shell voxels %": len(samples.depth) / per_ray,
        "within a part's radius %": len(pairs.sample.unique()) / per_ray,
        "reach a network %": picture.stats["samples_reached"] / per_ray,
    }


def operations() -> tuple[Operation, ...]:
    """Shares of a picture, and seconds of a training step."""
    return (
        Operation(
            *("shares", "Samples of a picture that are left"),
            "largest difference in colour from the picture with nothing skipped",
            (
                Method("exact skipping", _shares(0.0), ours=True),
                Method(f"learned occupancy, {PRUNE}", _shares(PRUNE), ours=True),
            ),
            _views,
            lambda data, figures: figures,
            (
                "Percent of 64 samples for every pixel of the image; the time is of counting.",
                "In the box: of the rays that meet the shell. Without a part in its radius nothing "
                "is evaluated; samples behind an opaque front reach no network.",
            ),
        ),
        *(
            Operation(
                *(name, f"Training step, forward and backward, {where}"),
                "largest difference in colour from the dense renderer",
                (
                    Method("all skipping (learned occupancy too)", _step(_same, True), ours=True),
                    Method("exact skipping only", _step(_same), ours=True),
                    Method("parts searched at all samples of the box", _step(_unculled)),
                    Method("nothing skipped: all networks at all samples", _step(_everything)),
                ),
                problems,
                _judge_step,
                (_NOTE,),
            )
            for name, where, problems in (
                ("step", "pixels near the person, as in training", _near),
                ("step_whole", "pixels of whole images", _anywhere),
            )
        ),
    )


_NOTE = (
    "Nothing skipped: the same lattice of samples through the box of the body, every part "
    "evaluated at every sample; its colours differ, for no part ends at its radius."
)


def _same(parts: Any) -> Any:
    return parts


def _unculled(parts: Any) -> Any:
    return parts.unculled()
