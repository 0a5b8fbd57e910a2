"""Where the time of a training step goes: a table of stages, and the timeline of single steps."""

import copy
import dataclasses
import os
import statistics
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch

from monopart.geometry.stages import Span, StageRecorder, stage

from .train import PROBE_EVERY, Trainer
from .train_result import TrainResult

WARM_UP = 3 * PROBE_EVERY  # steps before the first timed one: three probes fill the occupancy
REPEATS = 4  # timed steps of each kind, in a row: one of them averages the weights
RUN = 50 * PROBE_EVERY  # steps of the model run that says how often each kind occurs
BACKWARD, OTHER, STEP = "backward", "other", "step"
_NODE = "autograd::engine::evaluate_function: "


@dataclass(frozen=True)
class StepKind:
    """Steps that do the same work.

    Attributes:
        name: such as "pruned" or "probe, LPIPS patch".
        steps: (number of the step, finished part of the run) of some of them.
        share: their part of all steps of a run.
    """

    name: str
    steps: tuple[tuple[int, float], ...]
    share: float


@dataclass(frozen=True)
class Timed:
    """Means over the timed steps, milliseconds: so the stages add up to the step."""

    wall: float
    cpu: float


@dataclass(frozen=True)
class Event:
    """Something on the timeline of a step.

    Attributes:
        name: stage, kernel, autograd function or operator.
        kind: "stage", "kernel", "autograd" or "op".
        thread: name of the thread.
        start: microseconds from the start of the step.
        duration: microseconds.
    """

    name: str
    kind: str
    thread: str
    start: float
    duration: float


@dataclass(frozen=True)
class KindProfile:
    """What was measured of one kind of steps.

    Attributes:
        kind: which steps.
        total: the whole step.
        stages: its stages in order; what is outside of all is "other".
        kernels: launches (wall: the sum over threads) in order of their names.
        backward: part of the backward pass that is due to each stage, from the traced step.
        events: timeline of the traced step, whose operators make it slower than the timed ones.
    """

    kind: StepKind
    total: Timed
    stages: Mapping[str, Timed]
    kernels: Mapping[str, Timed]
    backward: Mapping[str, float]
    events: Sequence[Event]


@dataclass(frozen=True)
class StageRow:
    """A row of the table.

    Attributes:
        name: stage; with two spaces in front, a part of the backward pass.
        wall: milliseconds in each kind of steps, None where it does not occur.
        mean_wall: milliseconds of the average step of a run.
        mean_cpu: processor milliseconds of it; None where that is not known.
        share: part of the average step's wall time.
    """

    name: str
    wall: tuple[float | None, ...]
    mean_wall: float
    mean_cpu: float | None
    share: float


def plain(name: str) -> str:
    """A kernel's own name, without that of the function which made it.

    >>> plain("forward_kernel__locals__hash_grid_forward")
    'hash_grid_forward'
    """
    return name.rpartition("__locals__")[2]


def twin_of(trainer: Trainer) -> Trainer:
    """A trainer with the same images and bodies and its own copy of all that a step changes.

    Args:
        trainer: stays as it is, whatever the twin does.
    """
    twin = copy.copy(trainer)
    model, twin.optimizer, twin.average = copy.deepcopy(
        (trainer.avatar.model, trainer.optimizer, trainer.average)
    )
    twin.avatar = dataclasses.replace(trainer.avatar, model=model)
    twin.generator = torch.Generator()
    twin.generator.set_state(trainer.generator.get_state())
    twin.run_folder, twin.result, twin.last = None, TrainResult(), {}
    return twin


def step_kinds(trainer: Trainer) -> list[StepKind]:
    """The kinds of steps of a run, with and without LPIPS patch and learned skipping."""
    found: dict[str, list[tuple[int, float]]] = defaultdict(list)
    for step in range(RUN):
        done = step / RUN
        name = "probe" if trainer.is_probe(step) else "pruned"
        if trainer.has_patch(step, done):
            name += ", LPIPS patch"
        found[name].append((step, done))
    order = sorted(found, key=lambda n: ("LPIPS" in n, "probe" in n))
    return [StepKind(n, tuple(found[n][:REPEATS]), len(found[n]) / RUN) for n in order]


def profile_training(
    trainer: Trainer, progress: Callable[[int, int], None] | None = None, warm_up: int = WARM_UP
) -> list[KindProfile]:
    """Take steps on a copy of a trainer and measure their stages.

    Args:
        trainer: where to start from; it stays as it is, its random state included.
        progress: called with (done, total) steps.
        warm_up: steps before the first that is measured.

    Returns:
        One profile for each kind of steps.
    """
    kinds, done = step_kinds(trainer), 0
    total = warm_up + sum(len(kind.steps) + 1 for kind in kinds)

    def count() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    with torch.random.fork_rng(devices=[]):
        twin = twin_of(trainer)
        for step in range(warm_up):
            twin.step(step, 0.0)
            count()
        profiles = []
        for kind in kinds:
            spans = []
            for step in kind.steps:
                spans.append(_timed_step(twin, step))
                count()
            profiles.append(_summed(kind, spans, _traced_step(twin, kind.steps[0])))
            count()
    return profiles


def _timed_step(trainer: Trainer, step: tuple[int, float]) -> list[Span]:
    with StageRecorder() as recorder, stage(STEP):
        trainer.step(*step)
    return recorder.spans


@contextmanager
def _operators() -> Iterator[Any]:
    # Its library prints a line on stderr at each start and stop below this level.
    os.environ.setdefault("KINETO_LOG_LEVEL", "6")
    with torch.autograd.profiler.profile() as found:
        yield found


def _traced_step(trainer: Trainer, step: tuple[int, float]) -> tuple[dict[str, float], list[Event]]:
    """Shares of the backward pass, and the timeline."""
    with _operators() as found, StageRecorder(ranges=True) as recorder, stage(STEP):
        trainer.step(*step)
    spans = recorder.spans
    whole = next(s for s in spans if s.name == STEP)
    events = [
        Event(
            plain(s.name), s.kind, s.thread, (s.start - whole.start) / 1e3, (s.end - s.start) / 1e3
        )
        for s in spans
    ]
    seen = found.function_events or []
    own = {s.name for s in spans if s.kind == "stage" or s.thread == whole.thread}
    origin = next((e.time_range.start for e in seen if e.name == STEP), 0.0)
    for e in seen:
        if e.name in own:
            continue  # the range of a span that is there already
        kind = "autograd" if e.name.startswith(_NODE) else "op"
        name, start = e.name.removeprefix(_NODE), e.time_range.start - origin
        events.append(Event(name, kind, whole.thread, start, e.time_range.elapsed_us()))
    return _backward_shares(seen, own), sorted(events, key=lambda e: (e.start, -e.duration))


def _backward_shares(seen: Sequence[Any], stages: set[str]) -> dict[str, float]:
    """Part of the backward pass that belongs to each stage of the forward pass.

    An operator and the node that it leaves in the graph carry the same number; the last operator of
    a number made the node.
    """
    ranges = sorted(
        (e.time_range.start, e.time_range.end, e.name) for e in seen if e.name in stages - {STEP}
    )
    maker: dict[int, float] = {}
    spent: Counter[str] = Counter()
    for e in seen:
        if e.sequence_nr >= 0 and e.scope == 0 and not e.name.startswith(_NODE):
            maker[e.sequence_nr] = max(maker.get(e.sequence_nr, 0.0), e.time_range.start)
    for e in seen:
        if e.name.startswith(_NODE):
            at = maker.get(e.sequence_nr, -1.0)
            inside = [name for start, end, name in ranges if start <= at <= end]
            if e.name.endswith("AccumulateGrad"):
                inside = ["accumulating gradients"]
            spent[inside[-1] if inside else OTHER] += int(1e3 * e.time_range.elapsed_us())
    total = sum(spent.values()) or 1
    return {name: value / total for name, value in spent.most_common()}


def _summed(
    kind: StepKind, steps: Sequence[Sequence[Span]], traced: tuple[dict[str, float], list[Event]]
) -> KindProfile:
    """Means over steps."""
    sums: dict[tuple[str, str], list[Counter[str]]] = {}
    for index, spans in enumerate(steps):
        for span in sorted(spans, key=lambda s: s.start):
            key = (span.kind, plain(span.name))
            per_step = sums.setdefault(key, [Counter() for _ in steps])[index]
            per_step.update(wall=span.end - span.start, cpu=span.cpu)

    def mean(values: Sequence[Counter[str]]) -> Timed:
        wall, cpu = (statistics.fmean(v[name] for v in values) / 1e6 for name in ("wall", "cpu"))
        return Timed(wall, cpu)

    found = {key: mean(values) for key, values in sums.items()}
    total = found.pop(("stage", STEP))
    stages = {name: timed for (what, name), timed in found.items() if what == "stage"}
    rest = Timed(
        max(total.wall - sum(t.wall for t in stages.values()), 0.0),
        max(total.cpu - sum(t.cpu for t in stages.values()), 0.0),
    )
    kernels = {name: timed for (what, name), timed in sorted(found.items()) if what == "kernel"}
    return KindProfile(kind, total, {**stages, OTHER: rest}, kernels, *traced)


def stage_rows(profiles: Sequence[KindProfile]) -> list[StageRow]:
    """The table of stages, the parts of the backward pass below it, the whole step last.

    Args:
        profiles: from `profile_training`.
    """
    step = sum(p.kind.share * p.total.wall for p in profiles)

    def row(name: str, timed: Sequence[Timed | None], cpu: bool = True) -> StageRow:
        pairs = [(p.kind.share, t) for p, t in zip(profiles, timed, strict=True) if t is not None]
        wall = sum(share * t.wall for share, t in pairs)
        mean_cpu = sum(share * t.cpu for share, t in pairs) if cpu else None
        walls = tuple(None if t is None else t.wall for t in timed)
        return StageRow(name, walls, wall, mean_cpu, wall / step if step else 0.0)

    rows = []
    for name in _ordered([p.stages for p in profiles]):
        rows.append(row(name, [p.stages.get(name) for p in profiles]))
        if name == BACKWARD:
            parts = [
                {n: Timed(s * p.stages[BACKWARD].wall, 0.0) for n, s in p.backward.items()}
                for p in profiles
            ]
            rows += [row(f"  of {n}", [t.get(n) for t in parts], False) for n in _ordered(parts)]
    return [*rows, row("whole step", [p.total for p in profiles])]


def kernel_rows(profiles: Sequence[KindProfile]) -> list[StageRow]:
    """The table of kernels: time on all threads together, most first.

    Args:
        profiles: from `profile_training`.
    """
    step = sum(p.kind.share * p.total.wall for p in profiles) or 1.0
    rows = []
    for name in _ordered([p.kernels for p in profiles]):
        timed = [p.kernels.get(name) for p in profiles]
        found = [(p.kind.share, t) for p, t in zip(profiles, timed, strict=True) if t is not None]
        wall, cpu = (sum(s * getattr(t, what) for s, t in found) for what in ("wall", "cpu"))
        walls = tuple(None if t is None else t.wall for t in timed)
        rows.append(StageRow(name, walls, wall, cpu, wall / step))
    return sorted(rows, key=lambda r: -r.mean_wall)


def _ordered(tables: Sequence[Mapping[str, object]]) -> list[str]:
    """Names of all tables; what only some have goes before what follows it there."""
    names: list[str] = []
    for table in tables:
        at = 0
        for name in table:
            if name in names:
                at = max(at, names.index(name) + 1)
            else:
                names.insert(at, name)
                at += 1
    return names
