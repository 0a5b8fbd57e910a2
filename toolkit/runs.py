"""Run folders: made once, read back strictly."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import torch

from monopart.geometry.errors import InputError

from .atomic import write_json, write_text
from .avatar import Avatar
from .cache import user_cache, uv_fingerprint
from .captures import Reading, read_capture
from .captures.records import CaptureRecord
from .checkpoint import WEIGHTS, load_weights
from .config import Config, from_json, to_json
from .device import CPU
from .environment import environment_facts
from .refine import with_corrections


def is_free(out: Path) -> bool:
    """Whether a run can be made here: nothing, or an empty folder."""
    return not out.exists() or (out.is_dir() and not any(out.iterdir()))


def check_free(out: Path) -> None:
    """Refuse a folder that holds something.

    Raises:
        InputError: the path exists and is not an empty folder.
    """
    if not is_free(out):
        found = "one with files" if out.is_dir() else "a file"
        raise InputError(
            f"--out {out}: expected a new or empty folder, found {found}; "
            "name another folder or remove this one"
        )


def next_free(out: Path) -> Path:
    """The path itself where it is free, else the first free one of out-2, out-3, ..."""
    count, path = 1, out
    while not is_free(path):
        count += 1
        path = out.with_name(f"{out.name}-{count}")
    return path


def resumable(run: Path) -> tuple[Config, Reading]:
    """Configuration of a run that is to go on, and how its capture was read.

    Raises:
        InputError: the folder is not a run.
    """
    if not (run / "config.json").is_file():
        raise InputError(
            f"--resume: expected the folder of an unfinished run at {run}, found no config.json; "
            "name the folder given to --out when it began"
        )
    config = from_json(run / "config.json")
    return config, _reading(read_facts(run / "capture.json"))


def _reading(facts: dict[str, Any]) -> Reading:
    """How the capture of a run was read; a run of an earlier version says only its body track."""
    names = {f.name for f in dataclasses.fields(Reading)}
    return Reading(**{name: value for name, value in facts.items() if name in names})


def _capture_facts(record: CaptureRecord) -> dict[str, Any]:
    """Where a capture is, and how it was read."""
    body = record.body_path
    how = Reading(
        params=record.params,
        body=None if body is None else str(body.resolve()),
        subject=record.subject,
        scale=record.scale,
        test_scale=record.test_scale,
        legacy_pixels=record.legacy_pixels,
    )
    place = {"path": str(record.root.resolve()), "uv": uv_fingerprint(record.body)}
    return place | dataclasses.asdict(how)


def check_uv(run: Path, record: CaptureRecord) -> None:
    """Refuse a body of other texture coordinates: the residual of a run is a function of them.

    Args:
        run: a run folder.
        record: the capture, with the body that is to be used.

    Raises:
        InputError: the run was trained with other coordinates.
    """
    path = run / "capture.json"
    stored = read_facts(path).get("uv") if path.is_file() else None
    if stored is not None and stored != uv_fingerprint(record.body):
        raise InputError(
            f"{path}: expected the body that the run was trained with, found one "
            "of other texture coordinates; name that body file in the entry body, or train again"
        )


def read_facts(path: Path) -> dict[str, Any]:
    """The JSON object of a file of a run folder.

    Args:
        path: the file.

    Raises:
        InputError: no file, or one that holds no JSON object.
    """
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: expected a file of a run, found none; restore it") from None
    except ValueError as error:
        raise InputError(f"{path}: expected JSON, found {error}; restore the file") from None
    if not isinstance(facts, dict):
        found = type(facts).__name__
        raise InputError(f"{path}: expected a JSON object, found {found}; restore the file")
    return facts


def create_run(out: Path, config: Config, record: CaptureRecord) -> Path:
    """Make the folder of a new run with its config.json, capture.json and environment.json.

    Args:
        out: folder to make.
        config: the resolved configuration.
        record: the capture.

    Returns:
        `out`.

    Raises:
        InputError: the folder exists and is not empty, or cannot be made.
    """
    check_free(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {out}: cannot make the folder ({error.strerror})") from None
    write_text(out / "config.json", to_json(config))
    write_json(out / "capture.json", _capture_facts(record))
    device = str(record.body.v_template.device)
    write_json(out / "environment.json", environment_facts() | {"device": device})
    return out


def open_run(run: Path, capture: Path | None = None, device: torch.device = CPU) -> Avatar:
    """The trained avatar of a run folder.

    Args:
        run: folder that ``monopart train`` made.
        capture: the capture if it has moved.
        device: where it renders.

    Returns:
        The avatar, ready to render.

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
    reading = None
    if (run / "capture.json").is_file():
        stored = read_facts(run / "capture.json")
        path, params = stored.get("path"), stored.get("params")
        reading = _reading(stored)
        if not (isinstance(path, str) and isinstance(params, str)):
            raise InputError(
                f"{run / 'capture.json'}: expected texts path and params, found {stored}; "
                "restore the file"
            )
        capture = capture or Path(path)
    if capture is None:
        raise InputError(
            f"{run / 'capture.json'}: expected the file that names the capture, found none; "
            "name the capture by --capture"
        )
    if not capture.is_dir():
        raise InputError(
            f"{capture}: expected the capture of {run}, found nothing; name it by --capture"
        )
    record = read_capture(capture, reading=reading).to(device)
    check_uv(run, record)
    torch.manual_seed(config.seed)
    avatar = Avatar.create(record, config, user_cache())
    load_weights(avatar.model, run)
    avatar.model.eval()
    return with_corrections(avatar)
