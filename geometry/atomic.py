"""Files that are either complete or not there: written beside the target, then renamed over it."""

import contextlib
import dataclasses
import json
import math
import os
import secrets
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from .errors import InputError


def _sync(path: Path) -> None:
    """Flush a file or a folder to the disk; folders cannot be synced on every system."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except OSError:  # Windows refuses to open a folder
        return
    try:
        os.fsync(handle)
    except OSError:  # some network file systems refuse; the rename is still atomic
        pass
    finally:
        os.close(handle)


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path` that takes its place when the block ends well.

    The temporary name keeps the extension of `path`, for writers that choose a format by it. When
    the block raises, the temporary file is removed and `path` keeps its old content.

    Args:
        path: File to write; its folder must exist.

    Yields:
        The path to write to.

    Raises:
        InputError: The folder does not exist, `path` is a folder, or the block wrote nothing.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with replacing(folder + "/a.txt") as temporary:
    ...         _ = temporary.write_text("whole")
    ...     sorted(p.name for p in Path(folder).iterdir())
    ['a.txt']
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise InputError(
            f"{target}: expected an existing folder to write into, found none; create it first"
        )
    if target.is_dir():
        raise InputError(f"{target}: expected a file name, found a folder; add a file name")
    temporary = target.parent / f".{target.stem}.{secrets.token_hex(4)}{target.suffix}"
    try:
        yield temporary
        if not temporary.is_file():
            raise InputError(f"{target}: expected a written file, found none; check the writer")
        _sync(temporary)
        os.replace(temporary, target)
        _sync(target.parent)
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path: str | os.PathLike[str], data: bytes) -> Path:
    """Write bytes so that a reader sees the old file or the whole new one.

    Args:
        path: File to write; its folder must exist.
        data: Content.

    Returns:
        `path` as a `Path`.

    Raises:
        InputError: The folder does not exist, or `path` is a folder.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(data)
    return Path(path)


def write_text(path: str | os.PathLike[str], text: str) -> Path:
    """Write text as UTF-8 with the line ends as given; see `write_bytes`.

    Args:
        path: File to write; its folder must exist.
        text: Content.

    Returns:
        `path` as a `Path`.
    """
    return write_bytes(path, text.encode("utf-8"))


def _plain(value: Any, where: str, nonfinite: str) -> Any:
    """Turn dataclasses, arrays, paths and tuples into what JSON holds."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(k): _plain(v, f"{where}.{k}", nonfinite) for k, v in value.items()}
    if isinstance(value, str | bytes):
        return value
    if isinstance(value, Sequence | set | frozenset):
        return [_plain(v, f"{where}[{i}]", nonfinite) for i, v in enumerate(value)]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, float) and not math.isfinite(value):
        if nonfinite == "null":
            return None
        raise InputError(f"{where}: expected a finite number, found {value}; JSON holds no such")
    return value


def write_json(
    path: str | os.PathLike[str],
    value: Any,
    *,
    nonfinite: Literal["error", "null"] = "error",
) -> Path:
    """Write a value as indented JSON that every strict reader accepts.

    Dataclasses, NumPy numbers and arrays, tuples and paths are converted.

    Args:
        path: File to write; its folder must exist.
        value: What to write.
        nonfinite: NaN and infinity raise an error that names the entry, or become null.

    Returns:
        `path` as a `Path`.

    Raises:
        InputError: A number is not finite (with "error"), an entry has a type that JSON does not
            hold, or the folder does not exist.
    """
    plain = _plain(value, Path(path).name, nonfinite)
    try:
        text = json.dumps(plain, indent=2, ensure_ascii=False, allow_nan=False)
    except TypeError as error:
        raise InputError(
            f"{Path(path).name}: expected numbers, strings, lists and mappings, found: {error}"
        ) from error
    return write_text(path, text + "\n")
