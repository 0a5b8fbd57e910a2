"""``monopart-bench training CAPTURE``: PSNR against CPU and wall-clock seconds for each preset."""

import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch

from monopart.geometry.errors import InputError

from .registry import Settings
from .results import Absence, Report, Row, Table
from .suite import environment, say
from .timing import spread

IMAGES = 10
TARGETS = (20.0, 23.0, 25.0, 26.6, 28.0, 29.0, 29.5, 30.4, 30.7)
MARKS = (0.02, 0.05, 0.08, 0.12, 0.16, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Finished parts of the budget at which the avatar is scored."""


@dataclass(frozen=True)
class Mark:
    """The state of a training at one moment."""

    part: float
    """Finished part of the budget, one of `MARKS`."""
    step: int
    """Steps taken."""
    wall: float
    """Wall-clock seconds of training, scoring not counted."""
    cpu: float
    """CPU seconds of training, scoring not counted."""
    psnr: float
    """Mean PSNR of the held-out images, strict, full image, dB."""


def held_out(record: Any, count: int = IMAGES) -> list[tuple[int, int]]:
    """(camera, frame) of evenly spaced held-out frames, the cameras taking turns."""
    split = record.split("novel_view")
    frames, cameras = split.frames, split.cameras
    count = min(count, len(frames))
    return [(cameras[i % len(cameras)], frames[i * len(frames) // count]) for i in range(count)]


@contextmanager
def averaged(trainer: Any) -> Iterator[None]:
    """The moving average in place of the weights, as at the end of a run."""
    model = trainer.avatar.model
    if not trainer.config.train.ema or not trainer.result.iterations:
        yield
        return
    own = [p.detach().clone() for p in model.parameters()]
    with torch.no_grad():
        for value, average in zip(model.parameters(), trainer.average, strict=True):
            value.copy_(average)
    try:
        yield
    finally:
        with torch.no_grad():
            for value, kept in zip(model.parameters(), own, strict=True):
                value.copy_(kept)


def score(trainer: Any, pairs: list[tuple[int, int]]) -> float:
    """Mean PSNR of held-out images, which training never sees."""
    from monopart.toolkit.evaluate import evaluate_split

    with averaged(trainer):
        mean = evaluate_split(trainer.avatar, "novel_view", None, pairs).mean
    return float(mean["full"]["psnr"] or math.nan)


@dataclass(frozen=True)
class Budget:
    """When a training ends: after some seconds, or after some steps."""

    seconds: float
    """Seconds of training, scoring not counted."""
    cpu: bool = False
    """They are CPU seconds, not those of the clock."""
    steps: int | None = None
    """Number of steps in place of the seconds; scored at the end only."""

    def done(self, step: int, wall: float, cpu: float) -> float:
        """Finished part, 0 to 1 and a little above."""
        if self.steps:
            return step / self.steps
        return (cpu if self.cpu else wall) / self.seconds


def train_curve(trainer: Any, budget: Budget, pairs: list[tuple[int, int]]) -> list[Mark]:
    """Train to the end of a budget and score on the way.

    Args:
        trainer: a new trainer.
        budget: when to end.
        pairs: images to score.
    """
    wall = cpu = 0.0
    step, marks, wanted = 0, [], list(MARKS if budget.steps is None else MARKS[-1:])
    while wanted:
        done = budget.done(step, wall, cpu)
        if done >= wanted[0]:
            part = max(m for m in wanted if m <= done)
            wanted = [m for m in wanted if m > done]
            trainer.result.iterations = step
            marks.append(Mark(part, step, wall, cpu, score(trainer, pairs)))
            say(f"    {wall:.0f} s, {cpu:.0f} CPU s, step {step}: {marks[-1].psnr:.2f} dB")
            if not wanted:
                break
        start, start_cpu = time.perf_counter(), time.process_time()
        trainer.step(step, min(done, 1.0))
        wall += time.perf_counter() - start
        cpu += time.process_time() - start_cpu
        step += 1
        trainer.result.iterations = step
    return marks


def reached(marks: list[Mark], psnr: float) -> tuple[float, float] | None:
    """Wall-clock and CPU seconds at which a PSNR is first reached, interpolated; None if never.

    >>> reached([Mark(0.1, 0, 0.0, 0.0, 10.0), Mark(1.0, 9, 4.0, 8.0, 20.0)], 15.0)
    (2.0, 4.0)
    """
    before: Mark | None = None
    for mark in marks:
        if mark.psnr >= psnr:
            if before is None:
                return mark.wall, mark.cpu
            part = (psnr - before.psnr) / (mark.psnr - before.psnr)
            return (
                before.wall + part * (mark.wall - before.wall),
                before.cpu + part * (mark.cpu - before.cpu),
            )
        before = mark
    return None


def _psnr_row(
    method: str, size: int, setting: str, clocks: tuple[list[float], list[float]], psnr: list[float]
) -> Row:
    """A row over several seeds: spread of wall and CPU seconds, mean and deviation of the PSNR."""
    mean = statistics.fmean(psnr)
    facts = {"PSNR": mean, "seeds": float(len(psnr))}
    if len(psnr) > 1:
        facts["PSNR std"] = statistics.stdev(psnr)
    wall, cpu = (spread(c) for c in clocks)
    return Row(method, True, size, setting, wall, cpu, 10.0 ** (-mean / 20.0), facts)


def curve_rows(name: str, runs: Sequence[list[Mark]]) -> list[Row]:
    """The curve of a preset, averaged over its seeds at equal parts of the budget.

    Args:
        name: of the preset.
        runs: the marks of each seed; a part that a seed has not is left out.
    """
    rows = []
    for part in MARKS:
        at = [m for marks in runs for m in marks if m.part == part]
        if len(at) == len(runs):
            steps = round(statistics.fmean(m.step for m in at))
            clocks = ([m.wall for m in at], [m.cpu for m in at])
            psnr = [m.psnr for m in at]
            rows.append(_psnr_row(name, steps, f"{100 * part:g} % of the budget", clocks, psnr))
    return rows


def time_rows(name: str, runs: Sequence[list[Mark]]) -> tuple[list[Row], list[Absence]]:
    """Seconds until a preset reaches each target, over the seeds that reach it.

    Args:
        name: of the preset.
        runs: the marks of each seed.

    Returns:
        A row per target that some seed reaches, and what was not reached by all.
    """
    rows, never = [], []
    for target in TARGETS:
        at = [time for time in (reached(marks, target) for marks in runs) if time is not None]
        if len(at) < len(runs):
            seeds = f" by {len(runs) - len(at)} of {len(runs)} seeds" if len(runs) > 1 else ""
            never.append(Absence(f"{name}, {target} dB", f"not reached in the budget{seeds}"))
        if at:
            clocks = ([wall for wall, _ in at], [cpu for _, cpu in at])
            shown = [target] * len(at)
            row = _psnr_row(name, round(target * 10), f"{target} dB", clocks, shown)
            if len(runs) > 1:
                row.facts["of seeds"] = float(len(runs))
            rows.append(row)
    return rows, never


def _config(name: str, settings: Settings, seed: int) -> Any:
    from monopart.toolkit.presets import preset, with_overrides

    config = dataclasses.replace(preset(name), seed=seed)
    if not settings.quick:
        return with_overrides(config, train={"seconds": settings.seconds})
    loss = {"lpips": 0.0, "consistency_samples": 16}
    field = {"log2_size": 8, "prior_slope": 0.0}
    return with_overrides(config, train={"rays": 32}, field=field, loss=loss)


def _starts(record: Any, config: Any) -> str:
    """Seconds before the first step, with an empty and with a full cache."""
    from monopart.toolkit.cache import NO_CACHE, user_cache

    starts = []
    for cache in (NO_CACHE, user_cache(), user_cache()):  # cold, filling the cache, warm
        start, start_cpu = time.perf_counter(), time.process_time()
        _trainer(record, config, cache)
        starts.append((time.perf_counter() - start, time.process_time() - start_cpu))
    cold, warm = starts[0], starts[-1]
    return (
        f"{config.preset}: before the first step {cold[0]:.1f} s ({cold[1]:.1f} CPU s) without the "
        f"cache, {warm[0]:.1f} s ({warm[1]:.1f} CPU s) with it; not counted in the curve."
    )


def _trainer(record: Any, config: Any, cache: Any) -> Any:
    from monopart.toolkit.avatar import Avatar
    from monopart.toolkit.train import Trainer

    torch.manual_seed(config.seed)
    return Trainer(Avatar.create(record, config, cache))


def _one_preset(name: str, record: Any, settings: Settings) -> tuple[list[list[Mark]], str]:
    """The marks of every seed, and what its start costs."""
    from monopart.toolkit.cache import user_cache

    note = _starts(record, _config(name, settings, settings.seeds[0]))
    pairs = held_out(record, 1 if settings.quick else IMAGES)
    budget = Budget(settings.seconds, settings.cpu_budget, 2 if settings.quick else None)
    runs = []
    for seed in settings.seeds:
        say(f"training: {name} on {record.name}, seed {seed}")
        trainer = _trainer(record, _config(name, settings, seed), user_cache())
        if not settings.quick:  # kernels are compiled once per machine, and stay warm
            trainer.warm_up()
        runs.append(train_curve(trainer, budget, pairs))
    return runs, note


def run_training(settings: Settings, keep: Callable[[Report], Any] = lambda report: None) -> Report:
    """Train every preset on a capture, with every seed.

    Args:
        settings: what the command line asked for.
        keep: called with the report so far after every preset: an interrupt loses little.

    Raises:
        InputError: no capture, or one without held-out views.
    """
    from monopart.toolkit.captures import read_capture
    from monopart.toolkit.presets import preset_names

    if settings.capture is None:
        raise InputError("training: expected a capture, found none; name a folder")
    record = read_capture(settings.capture)
    if "novel_view" not in record.splits:
        raise InputError(f"{settings.capture}: expected held-out views, found none; use another")
    clock = "CPU seconds" if settings.cpu_budget else "wall-clock seconds"
    seeds = ", ".join(str(s) for s in settings.seeds)
    notes = [
        f"{record.name}: mean PSNR of held-out images, strict, full image; scoring is not timed.",
        f"Seeds {seeds}. Learning rates fall over {settings.seconds:g} {clock}: another budget has "
        "other curves.",
    ]
    error = "root mean square of the colour error"
    curve = Table("curve", "PSNR against seconds (size: steps)", error, [], [], notes)
    times = Table("time_to", "Seconds to a PSNR (size: dB × 10)", error, [], [], [])
    suite = f"training_{settings.capture.absolute().name}"
    report = Report(suite, settings.quick, environment(), [curve, times])
    for name in settings.presets or (("tiny",) if settings.quick else preset_names()):
        runs, note = _one_preset(name, record, settings)
        notes.append(note)
        curve.rows.extend(curve_rows(name, runs))
        rows, missed = time_rows(name, runs)
        times.rows.extend(rows)
        times.absent.extend(missed)
        keep(report)
    return report
