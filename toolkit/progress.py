"""Progress of long work: a bar with rate and time left, or plain lines without a terminal."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

PLAIN_EVERY = 10.0  # seconds between two plain lines

Update = Callable[[float, str], None]


@contextmanager
def progress_bar(title: str, patient: bool = False) -> Iterator[Update]:
    """Show the progress of one piece of work on stderr.

    Args:
        title: what is being done.
        patient: without a terminal, the first plain line waits too, so that input which is refused
            at once gets the line of its refusal alone.

    Yields:
        A function of (finished part in [0, 1], short text such as "loss 0.002").
    """
    if not sys.stderr.isatty():
        yield _plain(title, patient)
        return
    columns = [
        TextColumn("[bold]{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    ]
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(title, total=1.0, note="")
        yield lambda done, note="": bar.update(task, completed=done, note=note)
        bar.update(task, completed=1.0)


def _plain(title: str, patient: bool) -> Update:
    start = time.perf_counter()
    shown = [0.0 if patient else -PLAIN_EVERY]

    def update(done: float, note: str = "") -> None:
        elapsed = time.perf_counter() - start
        if elapsed - shown[0] < PLAIN_EVERY and done < 1.0:
            return
        shown[0] = elapsed
        left = f", {elapsed / done - elapsed:.0f} s left" if done > 0.001 else ""
        line = f"{title}: {done:4.0%}, {elapsed:.0f} s{left}  {note}".rstrip()
        print(line, file=sys.stderr, flush=True)

    return update


def counted(update: Update) -> Callable[[int, int], None]:
    """A callback of (done, total) that drives a progress bar."""
    return lambda done, total: update(done / max(total, 1), f"{done}/{total}")
