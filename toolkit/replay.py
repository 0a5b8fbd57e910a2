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
from torch.func import functional_call

from monopart.fields.hash_grid import HashGrid
from monopart.fields.pose_bank import PoseBank
from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.cameras import Camera
from monopart.geometry.errors import InputError, MonopartError

from .atomic import write_bytes
from .avatar import Avatar
from .cache import content_key, uv_fingerprint
from .captures.cache import Pictures
from .captures.patches import PixelBatch
from .captures.records import CaptureRecord, Split
from .config import config_of, to_json
from .guard import BadStep, diagnose, too_many, unchanged

if TYPE_CHECKING:
    from .train import Trainer

FOLDER = "culprits"
KEPT = 3  # skipped steps of a run that are named and written
Drawn = tuple[PixelBatch, tuple[int, int] | None]
FORMAT = 1
_BODY = ("v_template", "faces", "weights", "joint_regressor", "shapedirs", "posedirs")


def note_skipped(trainer: "Trainer", step: int, done: float, state: Tensor) -> None:
    """Count a step that was not finite; name and keep the first ones; end the run after too many.

    Args:
        trainer: in the state before the step.
        step: number of the step.
        done: finished part of the run.
        state: random state from before the step.

    Raises:
        MonopartError: as many as `train.max_skipped`; a checkpoint is written before.
    """
    result, run = trainer.result, trainer.run_folder
    result.skipped += 1
    if result.skipped <= KEPT:
        bad = diagnose(trainer, step, done, state)
        if run is not None:
            file = save_culprit(trainer, bad, done, state, run / FOLDER)
            bad = dataclasses.replace(bad, file=f"{FOLDER}/{file.name}")
        result.bad_steps.append(bad.facts())
        result.warnings.append(f"A step was skipped. {bad.text()}.")
    if result.skipped >= trainer.config.train.max_skipped:
        trainer.checkpoint()
        raise MonopartError(too_many(result.skipped, result.bad_steps, run))


def save_culprit(
    trainer: "Trainer", bad: BadStep, done: float, state: Tensor, folder: Path
) -> Path:
    """Write a step: its pixels, poses and cameras, and what it touches of the learned tensors.

    No image is in it, and no body, which licences may forbid to pass on.

    Args:
        trainer: in the state before the step.
        bad: what was found.
        done: finished part of the run.
        state: random state from before the step.
        folder: where to; made if need be.

    Returns:
        The file, of tensors and text alone.
    """
    record, train = trainer.avatar.record, trainer.avatar.record.split("train")
    with unchanged(trainer):
        trainer.generator.set_state(state)
        batch, patch = trainer.draw(bad.step, done)
        after = trainer.generator.get_state()
        rows_of = _touched(trainer, (batch, patch), bad.step, done)
    pixels = {f"batch.{f.name}": getattr(batch, f.name) for f in dataclasses.fields(batch)}
    tensors = {name: value for name, value in pixels.items() if value is not None}
    tensors["generator"] = after
    for name, value in trainer.avatar.model.state_dict().items():
        rows = rows_of.get(name)
        if rows is not None:
            tensors[f"rows.{name}"] = rows
        tensors[f"model.{name}"] = value if rows is None else _by_row(value, name)[rows]
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
        "patch": patch,
        "capture": record.name,
        "cameras": [record.camera_names[c] for c in train.cameras],
        "image_size": record.image_size,
        "frames": train.frames,
        "body": _fingerprint(record.body),
        "uv": uv_fingerprint(record.body),
    }
    path = folder / f"step_{bad.step:06d}.safetensors"
    contiguous = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(path, save(contiguous, metadata={"monopart": json.dumps(facts)}))
    return path


def _fingerprint(body: BodyModel) -> str:
    """What tells bodies apart."""
    return content_key([getattr(body, name).cpu() for name in _BODY])


def _touched(trainer: "Trainer", drawn: Drawn, step: int, done: float) -> dict[str, Tensor]:
    """Rows of large tensors that a step reads: of tables, key poses, cells of the occupancy."""
    model, seen, cells = trainer.avatar.model, {}, []
    grids = {n: m for n, m in model.named_modules() if isinstance(m, HashGrid)}
    banks = {n: m for n, m in model.named_modules() if isinstance(m, PoseBank)}
    keep = model.occupancy.cells_of

    def remember(name: str) -> Any:
        return lambda _, args: seen.setdefault(name, []).append([a.detach() for a in args])

    def cells_of(*args: Tensor) -> Tensor:
        cells.append(keep(*args))
        return cells[-1]

    watched = {**grids, **banks}
    hooks = [module.register_forward_pre_hook(remember(name)) for name, module in watched.items()]
    try:
        model.occupancy.cells_of = cells_of  # type: ignore[method-assign]
        with torch.no_grad():
            trainer.losses_of(drawn, step, done)
    finally:
        del model.occupancy.cells_of
        for hook in hooks:
            hook.remove()
    rows = {f"occupancy.{name}": torch.cat(cells).unique() for name in ("peak", "floor") if cells}
    for name, bank in banks.items():
        rows[f"{name}.lines"] = _key_poses(bank, [args[3] for args in seen.pop(name, [])])
    for name, calls in seen.items():
        own = grids[name].table
        used = ~own.detach().isfinite().all(-1)
        for points, *rest in calls:
            # a gradient is not 0 just where a row has a share in a feature
            table = torch.ones_like(own, requires_grad=True)
            features = functional_call(grids[name], {"table": table}, (points, *rest))
            (grad,) = torch.autograd.grad(features.sum(), table)
            used |= (grad != 0).any(-1)
        rows[f"{name}.table"] = used.nonzero().squeeze(-1)
    return rows


def _key_poses(bank: PoseBank, calls: list[Tensor]) -> Tensor:
    """Key poses that are read, and those that are not finite: a weight of 0 times NaN is NaN."""
    parts, poses = bank.lines.shape[:2]
    used = ~bank.lines.detach().flatten(2).isfinite().all(-1)
    for rows in calls:  # [bodies, parts, key poses of each]
        part = torch.arange(parts, device=used.device)[:, None].expand(rows.shape)
        used[part, rows.long()] = True
    return used.reshape(parts * poses).nonzero().squeeze(-1)


def _by_row(value: Tensor, name: str) -> Tensor:
    """A learned tensor with the rows first that `_touched` names: of a bank part by pose."""
    return value.flatten(0, 1) if name.endswith(".lines") else value


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
        with unchanged(self.trainer):
            terms, _ = self.trainer.losses(self.bad.step, self.done)
        return (
            {name: float(value.detach()) for name, value in terms.items()},
            diagnose(self.trainer, self.bad.step, self.done, state),
        )


def load_culprit(path: Path, body: BodyModel | None = None) -> Culprit:
    """Read what :func:`save_culprit` wrote.

    Args:
        path: the file.
        body: the body of the capture; None is the default one.

    Returns:
        The step.

    Raises:
        InputError: no such file, damaged, of another version or of another body.
    """
    from .train import Trainer

    body = body or BodyModel.default()
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
        uv = uv_fingerprint(body)
        if facts["body"] != _fingerprint(body) or facts.get("uv", uv) != uv:
            raise InputError(f"{path}: expected its body, found another; name it by --body")
        record = _record(facts, tensors, path, body)
        config = config_of(facts["config"], str(path))
        avatar = Avatar.create(record, config)
        avatar.model.load_state_dict(_whole(avatar.model.state_dict(), tensors))
        names = [f.name for f in dataclasses.fields(PixelBatch)]
        batch = PixelBatch(*(tensors.get(f"batch.{name}") for name in names))  # type: ignore[arg-type]
        patch = None if facts["patch"] is None else (int(facts["patch"][0]), int(facts["patch"][1]))
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
    trainer = Trainer(avatar, None, pictures=_blank(record))

    def stored(step: int, done: float) -> Drawn:
        trainer.look = trainer.looks.at(done)
        return batch, patch

    trainer.draw = stored  # type: ignore[method-assign]
    trainer.generator.set_state(tensors["generator"])
    avatar.model.train()
    return Culprit(trainer, found, done, facts["capture"])


def _blank(record: CaptureRecord) -> Pictures:
    """Black pictures that take no memory, a pixel of each on the mask."""
    size = (len(record.split("train").pairs()), *record.image_size)
    masks = torch.zeros(size, dtype=torch.bool)
    masks[:, size[1] // 2, size[2] // 2] = True
    return Pictures(torch.zeros(1, dtype=torch.uint8).expand(*size, 3), masks)


def _whole(now: dict[str, Tensor], tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Learned tensors from the rows that were stored; rows that the step never reads stay."""
    state = {}
    for name, value in now.items():
        stored, rows = tensors[f"model.{name}"], tensors.get(f"rows.{name}")
        if rows is None:
            state[name] = stored
        else:
            state[name] = _by_row(value, name).index_copy(0, rows, stored).view(value.shape)
    return state


def _record(facts: dict, tensors: dict[str, Tensor], path: Path, body: BodyModel) -> CaptureRecord:
    """A capture of poses and cameras, without pictures."""
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


def replay(path: Path, body: Path | None = None) -> None:
    """Repeat a stored step and print what is not finite.

    Args:
        path: a file of a run's culprits folder.
        body: file of the capture's body; None is the default body.
    """
    culprit = load_culprit(path, None if body is None else BodyModel.load(body))
    bad = culprit.bad
    print(f"{culprit.capture}, then: {bad.text()}")
    terms, now = culprit.repeat()
    for name, value in terms.items():
        print(f"  {name}: {value:.6g}{'' if math.isfinite(value) else '   <- not finite'}")
    print(f"now:  {now.text()}" if now.repeated else "now:  all terms and gradients are finite")
