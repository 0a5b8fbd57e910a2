"""A step that was not finite, as a file: everything that ``monopart replay`` needs to repeat it."""

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.cameras import Camera
from monopart.geometry.errors import InputError
from monopart.geometry.kinematics import KinematicTree
from monopart.geometry.uv import UVMap

from .atomic import write_bytes
from .avatar import Avatar
from .captures.cache import Pictures
from .captures.patches import PixelBatch
from .captures.records import CaptureRecord, Split
from .config import config_of, to_json
from .guard import BadStep, diagnose

if TYPE_CHECKING:
    from .train import Trainer

FOLDER = "culprits"
FORMAT = 1
_BODY = ("v_template", "faces", "weights", "joint_regressor", "shapedirs", "posedirs")


def save_culprit(
    trainer: "Trainer", bad: BadStep, done: float, state: Tensor, folder: Path
) -> Path:
    """Write a step with the learned tensors, its pixels and the bodies: no image is in it.

    Args:
        trainer: in the state before the step.
        bad: what was found.
        done: finished part of the run.
        state: random state from before the step.
        folder: where to; made if need be.

    Returns:
        The file, some megabytes, of tensors and text alone.
    """
    record, train = trainer.avatar.record, trainer.avatar.record.split("train")
    now = trainer.generator.get_state()
    trainer.generator.set_state(state)
    batch = trainer.draw(bad.step, done)
    after = trainer.generator.get_state()
    trainer.generator.set_state(now)
    tensors = {f"model.{k}": v for k, v in trainer.avatar.model.state_dict().items()}
    tensors |= {f"batch.{f.name}": getattr(batch, f.name) for f in dataclasses.fields(batch)}
    tensors["generator"] = after
    tensors |= {f"body.{name}": getattr(record.body, name) for name in _BODY}
    tensors["body.parents"] = torch.tensor(record.body.tree.parents)
    if record.body.uv is not None:
        tensors["body.corner_uv"] = record.body.uv.corner_uv
    for field in dataclasses.fields(BodyPose):
        rows = [getattr(record.poses[f], field.name) for f in train.frames]
        tensors[f"poses.{field.name}"] = torch.stack(rows)
    for field in ("K", "R", "t", "distortion"):
        rows = [getattr(record.cameras[c], field) for c in train.cameras]
        tensors[f"cameras.{field}"] = torch.stack(rows)
    facts = {
        "format": FORMAT,
        "bad": bad.facts(),
        "done": done,
        "config": json.loads(to_json(trainer.config)),
        "capture": record.name,
        "cameras": [record.camera_names[c] for c in train.cameras],
        "image_size": record.image_size,
        "frames": train.frames,
        "joint_names": record.body.joint_names,
    }
    path = folder / f"step_{bad.step:06d}.safetensors"
    contiguous = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(path, save(contiguous, metadata={"monopart": json.dumps(facts)}))
    return path


@dataclass(frozen=True)
class Culprit:
    """A stored step, ready to be repeated.

    Attributes:
        trainer: in the state before the step; its pixels are those of the step alone.
        bad: what was found when it was written.
        done: finished part of that run.
        capture: name of the capture.
    """

    trainer: "Trainer"
    bad: BadStep
    done: float
    capture: str

    def repeat(self) -> tuple[dict[str, float], BadStep]:
        """Compute the step again: the terms, and what is not finite now."""
        state = self.trainer.generator.get_state()
        terms, _ = self.trainer.losses(self.bad.step, self.done)
        self.trainer.generator.set_state(state)
        return (
            {name: float(value.detach()) for name, value in terms.items()},
            diagnose(self.trainer, self.bad.step, self.done, state),
        )


class _StoredPixels:
    """Stands in for the sampler: draws what was drawn, and leaves random numbers as they were."""

    def __init__(self, batch: PixelBatch, size: tuple[int, int], rays: int) -> None:
        self.batch, self.rays = batch, rays
        self.height, self.width = size

    def _part(self, rows: slice) -> PixelBatch:
        fields = dataclasses.fields(self.batch)
        return PixelBatch(*(getattr(self.batch, f.name)[rows] for f in fields))

    def random(self, count: int, generator: torch.Generator) -> PixelBatch:
        """The random pixels of the step."""
        return self._part(slice(0, count))

    def patch(self, size: int, generator: torch.Generator) -> PixelBatch:
        """Its patch."""
        return self._part(slice(self.rays, None))


def load_culprit(path: Path) -> Culprit:
    """Read what :func:`save_culprit` wrote.

    Args:
        path: the file.

    Returns:
        The step.

    Raises:
        InputError: no such file, damaged, or of another version.
    """
    from .train import Trainer

    if not path.is_file():
        raise InputError(
            f"{path}: expected a file that training wrote into {FOLDER}/, found none; name one"
        )
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}
            facts = json.loads((file.metadata() or {})["monopart"])
        if facts["format"] != FORMAT:
            raise ValueError(f"format {facts['format']}")
        record = _record(facts, tensors, path)
        config = config_of(facts["config"], str(path))
        avatar = Avatar.create(record, config)
        model = {k.removeprefix("model."): v for k, v in tensors.items() if k.startswith("model.")}
        avatar.model.load_state_dict(model)
        batch = PixelBatch(
            *(tensors[f"batch.{f.name}"] for f in dataclasses.fields(PixelBatch))
        )
        bad = facts["bad"]
        bad |= {name: tuple(bad[name]) for name in ("terms", "tensors")}
        bad["pixel"] = None if bad["pixel"] is None else tuple(bad["pixel"])
        found, done = BadStep(**bad), float(facts["done"])
    except (SafetensorError, KeyError, RuntimeError, ValueError, TypeError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(
            f"{path}: expected a step that this version wrote, found a difference ({reason}); "
            "replay it with the version that wrote it"
        ) from None
    count = len(record.split("train").pairs())
    blank = Pictures(torch.zeros(count, 1, 1, 3, dtype=torch.uint8), torch.ones(count, 1, 1) > 0)
    trainer = Trainer(avatar, None, pictures=blank)
    stored: Any = _StoredPixels(batch, record.image_size, config.train.rays)
    trainer.sampler = stored
    trainer.generator.set_state(tensors["generator"])
    avatar.model.train()
    return Culprit(trainer, found, done, facts["capture"])


def _record(facts: dict, tensors: dict[str, Tensor], path: Path) -> CaptureRecord:
    """A capture of bodies and cameras, without pictures."""
    uv = tensors.get("body.corner_uv")
    body = BodyModel(
        **{name: tensors[f"body.{name}"] for name in _BODY},
        tree=KinematicTree.from_parents(tensors["body.parents"].tolist()),
        uv=None if uv is None else UVMap(uv),
        joint_names=tuple(facts["joint_names"]),
    )
    size, frames = tuple(facts["image_size"]), tuple(facts["frames"])
    names = [f.name for f in dataclasses.fields(BodyPose)]
    poses = {
        frame: BodyPose(*(tensors[f"poses.{name}"][i] for name in names))
        for i, frame in enumerate(frames)
    }
    cameras = [
        Camera(K, R, t, (size[0], size[1]), distortion)
        for K, R, t, distortion in zip(
            *(tensors[f"cameras.{name}"] for name in ("K", "R", "t", "distortion")), strict=True
        )
    ]
    return CaptureRecord(
        root=path.parent,
        name=facts["capture"],
        cameras=cameras,
        camera_names=list(facts["cameras"]),
        poses=poses,
        body=body,
        splits={"train": Split(tuple(range(len(cameras))), frames)},
        fps=None,
        image_size=(size[0], size[1]),
        frames={},
        raw_cameras=cameras,
        params="",
    )


def replay(path: Path) -> None:
    """Repeat a stored step and print what is not finite.

    Args:
        path: a file of a run's culprits folder.
    """
    culprit = load_culprit(path)
    bad = culprit.bad
    print(f"{culprit.capture}, then: {bad.text()}")
    terms, now = culprit.repeat()
    for name, value in terms.items():
        print(f"  {name}: {value:.6g}{'' if math.isfinite(value) else '   <- not finite'}")
    print(f"now:  {now.text()}" if now.repeated else "now:  all terms and gradients are finite")
