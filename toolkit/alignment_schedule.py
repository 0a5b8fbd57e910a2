"""When a training aligns its poses with its pictures, and with which weights."""

from typing import TYPE_CHECKING

import torch

from .config import RefineConfig
from .corrections import PoseCorrections
from .pose_alignment import Shots, align_poses
from .refine import RefinedPoses
from .scene import SceneBodies

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
    fix, avatar = refined.corrections, trainer.avatar
    fix.requires_grad_(False)
    rows = torch.arange(len(refined.frames), device=refined.given.pose.device)
    with torch.no_grad():
        poses = refined.poses(rows)
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
    parameters = list(trainer.avatar.model.parameters())
    now = [p.detach().clone() for p in parameters]
    averaged = bool(trainer.config.train.ema and trainer.result.iterations)
    with torch.no_grad():
        for value, average in zip(parameters, trainer.average, strict=True):
            if averaged and not _poses(value, fix):
                value.copy_(average)
        facts = align_poses(refined, shots)
        for value, average, before in zip(parameters, trainer.average, now, strict=True):
            if _poses(value, fix):
                average.copy_(value)
            else:
                value.copy_(before)
    return facts


def _poses(value: torch.Tensor, fix: PoseCorrections) -> bool:
    return value is fix.rotations or value is fix.translations
