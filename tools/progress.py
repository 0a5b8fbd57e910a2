"""Progress of long work on stderr: a bar in a terminal, a line now and then elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PLAIN_EVERY = 10.0
"""Seconds between two plain lines; work that is done sooner prints none."""

Update = Callable[[float, str], None]


@contextmanager
def progress_bar(title: str) -> Iterator[Update]:
    """Show the progress of one piece of work.

    Args:
        title: what is being done.

    Yields:
        A function of the finished part in [0, 1] and a short text.
    """
    if not sys.stderr.isatty():
        yield _plain(title)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("[bold]{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=1.0, note="")
        yield lambda done, note="": bar.update(task, completed=done, note=note)


def _plain(title: str) -> Update:
    shown = [time.monotonic()]

    def update(done: float, note: str = "") -> None:
        now = time.monotonic()
        if now - shown[0] >= PLAIN_EVERY:
            shown[0] = now
            print(f"{title}: {done:4.0%}  {note}".rstrip(), file=sys.stderr, flush=True)

    return update
