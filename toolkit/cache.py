"""Results that take a while to compute, kept on disk under a checksum of all that decides them.

An entry is one safetensors file, named by the kind of its content and the SHA-256 of its inputs:
tensors, settings, the bytes of source files, and the source code that computes it. Nothing in the
folder is trusted: an entry that is damaged or not what its name says is reported and made anew.
Entries are written beside their place and renamed into it, so that several processes can share the
folder, and those that were used longest ago are removed when all of them pass a limit.

`MONOPART_CACHE` names another folder, or "off"; `MONOPART_CACHE_GB` another limit.
"""

import contextlib
import hashlib
import json
import math
import os
import re
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import torch
from jaxtyping import Shaped
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from monopart.geometry.body import BodyModel
from monopart.geometry.errors import InputError

from .atomic import write_bytes

ENV_FOLDER = "MONOPART_CACHE"
"""Environment variable: folder of the entries, or "off"."""
ENV_LIMIT = "MONOPART_CACHE_GB"
"""Environment variable: size that all entries together may have, GB."""
LIMIT_GB = 4.0
"""The limit where the variable is not set."""

_FORMAT = "monopart-cache-1"  # a change of it makes all older entries unreachable
_NAME = re.compile(r"\.?[a-z]+-[0-9a-f]{64}(\.[0-9a-f]{8})?\.safetensors")  # hidden: being written
_ABANDONED = 3600.0  # seconds after which a file that is being written belongs to a dead process

T = TypeVar("T")
Tensors = dict[str, Tensor]


def user_folder() -> Path:
    """Where this package keeps files of the user that can be made anew.

    Returns:
        `monopart` in `XDG_CACHE_HOME`, by default `~/.cache`.
    """
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "monopart"


def content_key(*things: Any) -> str:
    """SHA-256 over values of any kind that decides a result.

    Args:
        *things: tensors (type, shape and bytes), paths (the bytes of the file), modules (their
            source code), numbers, texts, None, and tuples or lists of these.

    Returns:
        64 hexadecimal digits.

    Raises:
        OSError: a file cannot be read.
        TypeError: a value of another kind.

    >>> content_key(1, "a") == content_key(1, "a"), content_key((1, 2)) == content_key(1, 2)
    (True, False)
    """
    digest = hashlib.sha256()
    for thing in things:
        _feed(digest, thing)
    return digest.hexdigest()


def uv_fingerprint(body: BodyModel) -> str:
    """What tells bodies of different texture coordinates apart.

    Args:
        body: the body.

    Returns:
        64 hexadecimal digits; those of nothing for a body without coordinates.
    """
    return content_key(None if body.uv is None else body.uv.corner_uv.detach().cpu().float())


def _feed(digest: Any, thing: Any) -> None:
    """Add a value, framed by its kind and length, so that no two values read the same."""
    data: Any = b""
    if isinstance(thing, Tensor):
        flat = thing.detach().cpu().contiguous().reshape(-1)
        head = f"tensor {thing.dtype} {tuple(thing.shape)}"
        data = flat.view(torch.uint8).numpy() if flat.numel() else b""
    elif isinstance(thing, Path | ModuleType):
        path = thing if isinstance(thing, Path) else Path(str(thing.__file__))
        data = path.read_bytes()
        head = f"file {len(data)}"
    elif isinstance(thing, tuple | list):
        head = f"list {len(thing)}"
    elif isinstance(thing, str | int | float | bool | None):
        text = repr(thing)
        head = f"{type(thing).__name__} {len(text)} {text}"
    else:
        raise TypeError(f"content_key: no way to read a {type(thing).__name__}")
    digest.update(head.encode() + b"\0")
    digest.update(data)
    for inner in thing if isinstance(thing, tuple | list) else ():
        _feed(digest, inner)


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


@dataclass(frozen=True)
class Cache:
    """A folder of computed results.

    Attributes:
        folder: where they lie; made when the first is written. None keeps nothing.
        limit: bytes that all entries together may have.
        warn: told, in one line, about entries and folders that cannot be used.
    """

    folder: Path | None
    limit: int = int(LIMIT_GB * 1e9)
    warn: Callable[[str], None] = _tell
    _told: set[str] = field(default_factory=set, repr=False, compare=False)

    def fetch(
        self,
        kind: str,
        inputs: tuple[Any, ...],
        build: Callable[[], T],
        pack: Callable[[T], Tensors],
        unpack: Callable[[Tensors], T],
    ) -> T:
        """A result: from its entry, or built and then kept.

        Args:
            kind: what it is, in lower-case letters; part of the file name.
            inputs: all that decides it, as `content_key` takes it, source code included.
            build: computes it.
            pack: its tensors, on the CPU.
            unpack: the result of these tensors, equal bit for bit to what was packed; tensors that
                do not fit the inputs raise an `InputError` or a `KeyError`.

        Returns:
            What `build` or `unpack` returned.
        """
        if self.folder is None:
            return build()
        key = content_key(_FORMAT, kind, torch.__version__, *inputs)
        path = self.folder / f"{kind}-{key}.safetensors"
        tensors = self._read(path)
        if tensors is not None:
            try:
                return unpack(tensors)
            except (InputError, KeyError, RuntimeError) as error:
                self._once(f"warning: {path}: not of this shape ({_line(error)}); made anew")
        result = build()
        # a file that changed while it was read must not give its content to the old checksum
        if content_key(_FORMAT, kind, torch.__version__, *inputs) == key:
            self._write(path, pack(result))
        return result

    def facts(self) -> dict[str, Any]:
        """What a user asks about the cache: folder, number of entries, bytes, limit."""
        files = self._files()
        return {
            "folder": None if self.folder is None else str(self.folder),
            "entries": len(files),
            "bytes": sum(size for _, size, _ in files),
            "limit_bytes": self.limit,
        }

    def _once(self, text: str) -> None:
        if text not in self._told:
            self._told.add(text)
            self.warn(text)

    def _read(self, path: Path) -> Tensors | None:
        """The tensors of an entry; None where there is none or it is not to be trusted."""
        try:
            data = path.read_bytes()
            tensors = load(data)
            header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
            stored = header["__metadata__"]["content"]
        except FileNotFoundError:
            return None
        except (SafetensorError, OSError, ValueError, KeyError) as error:
            self._once(f"warning: {path}: cannot be read ({_line(error)}); made anew")
            return None
        if stored != _checksum(path.stem, tensors):
            self._once(f"warning: {path}: another checksum than it was written with; made anew")
            return None
        with contextlib.suppress(OSError):  # a folder without write permission serves all the same
            os.utime(path)
        return tensors

    def _write(self, path: Path, tensors: Tensors) -> None:
        packed = {name: value.contiguous() for name, value in tensors.items()}
        data = save(packed, metadata={"content": _checksum(path.stem, packed)})
        if len(data) > self.limit:
            self._once(
                f"warning: {path.name}: {len(data)} bytes are more than the cache may hold "
                f"({self.limit}); not kept; raise {ENV_LIMIT}"
            )
            return
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, data)
        except (OSError, InputError) as error:
            self._once(
                f"warning: {path.parent}: cannot be written ({_line(error)}); going on without a "
                f"cache; {ENV_FOLDER} names another folder"
            )
            return
        self._evict(path)

    def _files(self) -> list[tuple[float, int, Path]]:
        """Time of last use, bytes and path of every entry, also of those being written."""
        found = []
        with contextlib.suppress(OSError):  # no folder, no entries
            for path in self.folder.iterdir() if self.folder is not None else ():
                if _NAME.fullmatch(path.name):
                    with contextlib.suppress(FileNotFoundError):  # another process was faster
                        facts = path.stat()
                        found.append((facts.st_mtime, facts.st_size, path))
        return sorted(found)

    def _evict(self, newest: Path) -> None:
        """Remove entries that were used longest ago until the rest is within the limit."""
        files = self._files()
        total = sum(size for _, size, _ in files)
        now = time.time()
        for used, size, path in files:
            unfinished = path.name.startswith(".")
            if unfinished and now - used < _ABANDONED:
                continue
            if path != newest and (unfinished or total > self.limit):
                with contextlib.suppress(OSError):
                    path.unlink()
                    total -= size


def _checksum(name: str, tensors: Mapping[str, Shaped[Tensor, "..."]]) -> str:
    return content_key(name, *(x for item in sorted(tensors.items()) for x in item))


def _line(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split())


NO_CACHE = Cache(None)
"""Keeps nothing."""


def user_cache(warn: Callable[[str], None] = _tell) -> Cache:
    """The cache of the user, as the environment has it.

    Args:
        warn: told about entries and folders that cannot be used.

    Returns:
        The cache; nothing is read or written yet.

    Raises:
        InputError: a limit that is not a positive number.
    """
    named, limit = os.environ.get(ENV_FOLDER), os.environ.get(ENV_LIMIT)
    try:
        size = float(limit) if limit else LIMIT_GB
    except ValueError:
        size = math.nan
    if not (size > 0 and math.isfinite(size)):
        raise InputError(f"{ENV_LIMIT}: expected GB above 0, found {limit!r}; correct or unset it")
    if named == "off":
        return Cache(None, int(size * 1e9), warn)
    folder = Path(named).expanduser() if named else user_folder() / "frames"
    return Cache(folder, int(size * 1e9), warn)
