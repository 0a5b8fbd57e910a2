"""Run folders: made once, read back strictly."""

import json
from pathlib import Path

import torch

from monopart.geometry.errors import InputError

from .atomic import write_json, write_text
from .avatar import Avatar
from .captures import read_capture
from .captures.records import CaptureRecord
from .checkpoint import WEIGHTS, load_weights
from .config import Config, from_json, to_json
from .environment import environment_facts


def create_run(out: Path, config: Config, record: CaptureRecord) -> Path:
    """Make the folder of a new run with its config.json, capture.json and environment.json.

    Raises:
        InputError: the folder exists and is not empty, or cannot be made.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(
            f"--out {out}: expected a new or empty folder, found one with files; "
            "name another folder or remove this one"
        )
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {out}: cannot make the folder ({error.strerror})") from None
    write_text(out / "config.json", to_json(config))
    write_json(out / "capture.json", {"path": str(record.root.resolve()), "params": record.params})
    write_json(out / "environment.json", environment_facts())
    return out


def open_run(run: Path, capture: Path | None = None) -> Avatar:
    """The trained avatar of a run folder.

    Args:
        run: folder that ``monopart train`` made.
        capture: the capture if it has moved.

    Raises:
        InputError: something is missing or does not fit.
    """
    if not (run / "config.json").is_file():
        raise InputError(
            f"{run}: expected a run folder with config.json, found none; pass the folder given to "
            "monopart train --out"
        )
    if not (run / WEIGHTS).is_file():
        raise InputError(f"{run / WEIGHTS}: expected trained weights, found no file; train first")
    config = from_json(run / "config.json")
    params = None
    if (run / "capture.json").is_file():
        stored = json.loads((run / "capture.json").read_text(encoding="utf-8"))
        capture, params = capture or Path(stored["path"]), stored["params"]
    if capture is None:
        raise InputError(f"{run / 'capture.json'}: found no file; name the capture by --capture")
    record = read_capture(capture, params=params)
    torch.manual_seed(config.seed)
    avatar = Avatar.create(record, config)
    load_weights(avatar.model, run)
    avatar.model.eval()
    return avatar
