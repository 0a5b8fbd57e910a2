"""When a training aligns its poses with its pictures, and with which weights."""

from typing import TYPE_CHECKING

import torch

from .config import RefineConfig
from .corrections import PoseCorrections
from .pose_alignment import Shots, align_poses
from .refine import RefinedPoses
from .scene import SceneBodies, stack_poses

if TYPE_CHECKING:
    from .train import Trainer


def passed(spec: RefineConfig, done: float) -> int:
    """How many alignments are due up to a finished part of the run.

    >>> spec = RefineConfig(align=3, align_start=0.2, align_end=0.4)
    >>> [passed(spec, done) for done in (0.1, 0.2, 0.35, 0.9)]
    [0, 1, 2, 3]
    """
    marks = torch.linspace(spec.align_start, spec.align_end, spec.align, dtype=torch.float64)
    return int((marks <= done + 1e-9).sum())


def align_when_due(trainer: "Trainer", done: float) -> None:
    """Align all poses where that is due; from the first time on no gradient changes them.

    Steps that a slow machine has run past are left out: the field needs the time between them.

    Args:
        trainer: a training; one that does not learn poses is left as it is.
        done: finished part of the run.
    """
    spec, said = trainer.config.refine, trainer.result.alignments
    if trainer.refined is None or not spec.align or done < spec.start:
        return
    fix = trainer.refined.corrections
    last = passed(spec, said[-1]["done"]) if said else 0
    due = passed(spec, done) > last
    if due:
        said.append({"done": done, **_align(trainer, trainer.refined)})
    if said and (due or fix.rotations.requires_grad):
        _hold(trainer, trainer.refined)


def _hold(trainer: "Trainer", refined: RefinedPoses) -> None:
    """From now on the bodies stand still, so that a step may look at all of them."""
    avatar = trainer.avatar
    refined.corrections.requires_grad_(False)
    poses = stack_poses(list(refined.corrected().values()))
    trainer.stand(
        SceneBodies.of_poses(avatar.record, poses, refined.frames, avatar.config, avatar.canonical)
    )


def _align(trainer: "Trainer", refined: RefinedPoses) -> dict[str, float]:
    """One alignment with the averaged weights, which the steps do not shake."""
    fix, looks = refined.corrections, trainer.looks
    shots = Shots(
        looks.pictures.images,
        looks.pictures.masks,
        [looks.cameras[i] for i in trainer.camera_of_image.tolist()],
        trainer.body_of_image.tolist(),
    )
    both = list(zip(trainer.avatar.model.parameters(), trainer.average, strict=True))
    field = [(value, average) for value, average in both if not _poses(value, fix)]
    now = [value.detach().clone() for value, _ in field]
    with torch.no_grad():
        if trainer.config.train.ema and trainer.result.iterations:
            for value, average in field:
                value.copy_(average)
        facts = align_poses(refined, shots)
        for (value, _), before in zip(field, now, strict=True):
            value.copy_(before)
        for value, average in both:
            if _poses(value, fix):
                average.copy_(value)
    return facts


def _poses(value: torch.Tensor, fix: PoseCorrections) -> bool:
    return value is fix.rotations or value is fix.translations
