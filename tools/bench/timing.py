"""Interleaved timing: warm-up, rounds over all methods, medians with spread, wall and CPU time."""

import gc
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch


@dataclass(frozen=True)
class Effort:
    """How often methods are run."""

    rounds: int = 9
    """Most timed runs of a method."""
    least: int = 3
    """Fewest timed runs, however long they take."""
    seconds: float = 4.0
    """Wall-clock seconds after which a method leaves the rounds."""


@dataclass(frozen=True)
class Spread:
    """Order statistics of repeated measurements, in seconds."""

    median: float
    """The figure that is compared."""
    min: float
    """Smallest."""
    q1: float
    """First quartile."""
    q3: float
    """Third quartile; q3 - q1 is the interquartile range."""
    count: int
    """Number of measurements."""


@dataclass(frozen=True)
class Timing:
    """One method on one problem."""

    wall: Spread
    """Wall-clock seconds."""
    cpu: Spread
    """Processor seconds of the process, all threads."""


def spread(values: Sequence[float | int]) -> Spread:
    """Order statistics of measurements.

    Args:
        values: at least one.

    >>> spread([1.0, 2.0, 3.0]).median
    2.0
    """
    values = sorted(float(v) for v in values)

    def at(part: float) -> float:
        place = part * (len(values) - 1)
        low = int(place)
        high = min(low + 1, len(values) - 1)
        return values[low] + (values[high] - values[low]) * (place - low)

    return Spread(at(0.5), values[0], at(0.25), at(0.75), len(values))


def timed(call: Callable[[], Any]) -> tuple[float, float, Any]:
    """Wall-clock seconds, CPU seconds and result of one call; waits for a CUDA device."""
    cuda = torch.cuda.is_available()
    if cuda:
        torch.cuda.synchronize()
    wall, cpu = time.perf_counter(), time.process_time()
    result = call()
    if cuda:
        torch.cuda.synchronize()
    return time.perf_counter() - wall, time.process_time() - cpu, result


def measure(
    calls: Mapping[str, Callable[[], Any]], effort: Effort, warm: bool = False
) -> tuple[dict[str, Timing], dict[str, Any]]:
    """Time several calls in turn, so that a disturbance of the machine hits all of them.

    Each round begins with another call.

    Args:
        calls: what to time, by name.
        effort: how often.
        warm: every call has run before; otherwise each is run once untimed.

    Returns:
        The timings and the last result of each call.
    """
    results = {} if warm else {name: call() for name, call in calls.items()}
    walls: dict[str, list[float]] = {name: [] for name in calls}
    cpus: dict[str, list[float]] = {name: [] for name in calls}
    names = list(calls)
    collecting = gc.isenabled()
    if effort.rounds > 1:
        gc.collect()
    gc.disable()
    try:
        for turn in range(effort.rounds):
            shift = turn % max(len(names), 1)
            for name in names[shift:] + names[:shift]:
                if turn >= effort.least and sum(walls[name]) > effort.seconds:
                    continue
                wall, cpu, results[name] = timed(calls[name])
                walls[name].append(wall)
                cpus[name].append(cpu)
    finally:
        if collecting:
            gc.enable()
    timings = {name: Timing(spread(walls[name]), spread(cpus[name])) for name in names}
    return timings, results


def with_threads(threads: int, call: Callable[[], Any]) -> Callable[[], Any]:
    """A call that runs with a number of threads of its own.

    Args:
        threads: of torch and Warp; 0 leaves them as they are.
        call: what to run.
    """
    if not threads:
        return call

    def limited() -> Any:
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            return call()
        finally:
            torch.set_num_threads(before)

    return limited
