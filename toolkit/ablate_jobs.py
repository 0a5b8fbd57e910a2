"""Trainings in processes of their own, and the lock of the folder that they work in."""

import fcntl
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol, runtime_checkable

from monopart.geometry.errors import InputError


@runtime_checkable
class Job(Protocol):
    """A training that may be under way, such as a `subprocess.Popen`."""

    def poll(self) -> int | None:
        """Exit code, or None while it runs."""
        ...

    def terminate(self) -> None:
        """End it at once."""
        ...


Start = Callable[[Sequence[str], Path], Job]
"""Starts ``monopart`` with arguments and writes what it says into a file."""


def start_process(arguments: Sequence[str], log: Path, threads: int, lock: int) -> Job:
    """Start ``monopart`` in a process of its own.

    Args:
        arguments: after the program's name.
        log: file for what it says, appended.
        threads: for arithmetic.
        lock: descriptor of the lock of the grid, held as long as the process lives.
    """
    environment = os.environ | {"OMP_NUM_THREADS": str(threads), "PYTHONUNBUFFERED": "1"}
    with log.open("ab") as file:
        return subprocess.Popen(
            [sys.executable, "-m", "monopart.toolkit.cli", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=environment,
            pass_fds=(lock,),
        )


@contextmanager
def locked(out: Path) -> Iterator[int]:
    """The lock of a grid's folder: one program at a time.

    Args:
        out: the folder; made if it is not there.

    Yields:
        Descriptor of the lock.

    Raises:
        InputError: another program works in it, or it cannot be made.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        file = (out / "lock").open("w", encoding="utf-8")
    except OSError as error:
        raise InputError(f"--out {out}: cannot make the folder ({error.strerror})") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(
                f"--out {out}: expected a folder that nobody works in, found another monopart "
                "ablate in it; wait for it, end it, or choose another folder"
            ) from None
        yield file.fileno()


def running_part(took: Sequence[float], began: Sequence[float]) -> float:
    """Finished part of the running trainings, judged by how long the others took.

    Args:
        took: seconds that finished trainings took.
        began: when each of the running ones began, on the clock of `time.perf_counter`.

    Returns:
        Number of trainings, such as 1.3 of two; 0 while nothing has finished.
    """
    if not took:
        return 0.0
    mean, now = sum(took) / len(took), time.perf_counter()
    return sum((min((now - start) / max(mean, 1e-9), 0.95) for start in began), 0.0)
