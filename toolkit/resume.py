"""The whole state of a training that may be cut short: written now and then, read by --resume."""

import dataclasses
import json
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from monopart.geometry.errors import InputError

from .atomic import write_bytes, write_text

if TYPE_CHECKING:
    from .train import Trainer

STATE = "resume.safetensors"


def save_state(trainer: "Trainer", run: Path) -> None:
    """Write weights, averages, optimiser moments, random state and counts, whole or not at all."""
    tensors = {f"model.{k}": v for k, v in trainer.avatar.model.state_dict().items()}
    tensors["generator"] = trainer.generator.get_state()
    for i, average in enumerate(trainer.average):
        tensors[f"average.{i}"] = average
    for i, moments in trainer.optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{i}.{k}": v for k, v in moments.items()}
    result = trainer.result
    facts = {f.name: getattr(result, f.name) for f in dataclasses.fields(result)}
    contiguous = {k: v.detach().contiguous() for k, v in tensors.items()}
    write_bytes(run / STATE, save(contiguous, metadata={"result": json.dumps(facts)}))


def load_state(trainer: "Trainer", run: Path) -> None:
    """Put a trainer into the state that :func:`save_state` wrote; later log lines are dropped.

    Raises:
        InputError: the file is absent, broken or of another configuration.
    """
    path = run / STATE
    if not path.is_file():
        raise InputError(
            f"{path}: expected the state of an unfinished training, found no file; "
            "train into a new folder without --resume"
        )
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}
            facts = json.loads(file.metadata()["result"])
        _restore(trainer, tensors)
    except (SafetensorError, KeyError, RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"{path}: expected the state of this configuration, found a difference ({reason}); "
            "train into a new folder without --resume"
        ) from None
    for name, value in facts.items():
        setattr(trainer.result, name, Counter(value) if name == "stats" else value)
    _trim_log(run / "train.jsonl", trainer.result.iterations)


def _restore(trainer: "Trainer", tensors: dict[str, Tensor]) -> None:
    model = {k.removeprefix("model."): v for k, v in tensors.items() if k.startswith("model.")}
    trainer.avatar.model.load_state_dict(model)
    trainer.average = [
        tensors[f"average.{i}"].to(now.device) for i, now in enumerate(trainer.average)
    ]
    trainer.generator.set_state(tensors["generator"])
    moments: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("optimizer."):
            _, index, key = name.split(".")
            moments.setdefault(int(index), {})[key] = value
    groups = trainer.optimizer.state_dict()["param_groups"]
    trainer.optimizer.load_state_dict({"state": moments, "param_groups": groups})


def _trim_log(path: Path, iterations: int) -> None:
    """Drop the lines after the saved step: they will be written again."""
    if not path.is_file():
        return
    lines = path.read_text(encoding="utf-8").splitlines()
    kept = []
    for line in lines:
        try:
            if json.loads(line)["iteration"] <= iterations:
                kept.append(line + "\n")
        except (json.JSONDecodeError, KeyError):
            break  # the line during which the run died
    write_text(path, "".join(kept))


def forget_state(run: Path) -> None:
    """Remove the state of a training that has ended."""
    (run / STATE).unlink(missing_ok=True)
