"""Named stages of work: nothing happens while nobody listens, timed spans while a recorder does.

Geometry, fields and toolkit mark their stages by ``with stage("part search"):``; a profiler listens
by ``with StageRecorder() as recorder:``. Idle, a mark costs one call and one look at an empty list.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass

_LISTENING: list["StageRecorder"] = []
_IDLE: AbstractContextManager[None] = nullcontext()


@dataclass(frozen=True)
class Span:
    """One stage that has ended.

    Attributes:
        name: the stage, or the kernel that was launched.
        kind: "stage" or "kernel".
        thread: name of the thread.
        start: nanoseconds of ``time.perf_counter_ns``.
        end: the same clock.
        cpu: processor nanoseconds: of the whole process for spans of the recording thread (its
            helpers work for it), of the thread alone for other threads.
    """

    name: str
    kind: str
    thread: str
    start: int
    end: int
    cpu: int


def stage(name: str, kind: str = "stage") -> AbstractContextManager[None]:
    """Mark the work of a ``with`` block.

    Args:
        name: what the work is.
        kind: "stage", or "kernel" for a launch.

    Returns:
        A context manager, which does nothing while no recorder listens.

    >>> with StageRecorder() as recorder, stage("search"):
    ...     pass
    >>> [(s.name, s.kind) for s in recorder.spans]
    [('search', 'stage')]
    """
    return _LISTENING[-1].span(name, kind) if _LISTENING else _IDLE


class StageRecorder:
    """Collects the stages of all threads while it is entered; the last one entered listens."""

    def __init__(self, ranges: bool = False) -> None:
        """Prepare to listen.

        Args:
            ranges: also open a range of ``torch.profiler`` for each stage of the recording thread.
        """
        self.spans: list[Span] = []
        self.ranges = ranges
        self._owner = threading.get_ident()

    def __enter__(self) -> "StageRecorder":
        self._owner = threading.get_ident()
        _LISTENING.append(self)
        return self

    def __exit__(self, *error: object) -> None:
        _LISTENING.remove(self)

    @contextmanager
    def span(self, name: str, kind: str) -> Iterator[None]:
        """Time the work of a ``with`` block; `stage` calls this."""
        own = threading.get_ident() == self._owner
        clock = time.process_time_ns if own else time.thread_time_ns
        with self._range(name) if own and self.ranges else _IDLE:
            start, cpu = time.perf_counter_ns(), clock()
            try:
                yield
            finally:
                spent, end = clock() - cpu, time.perf_counter_ns()
                thread = threading.current_thread().name
                self.spans.append(Span(name, kind, thread, start, end, spent))

    def _range(self, name: str) -> AbstractContextManager:
        from torch.profiler import record_function

        return record_function(name)
