"""``monopart-bench training CAPTURE``: PSNR against CPU and wall-clock seconds for each preset."""

import dataclasses
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch

from monopart.geometry.errors import InputError

from .plots import Dots, log_plot
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


def train_curve(
    trainer: Any, budget: float, pairs: list[tuple[int, int]], steps: int | None = None
) -> list[Mark]:
    """Train to the end of a budget and score on the way.

    Args:
        trainer: a new trainer.
        budget: wall-clock seconds of training.
        pairs: images to score.
        steps: number of steps in place of the budget; scored at the end only.
    """
    wall = cpu = 0.0
    step, marks, wanted = 0, [], list(MARKS if steps is None else MARKS[-1:])
    while wanted:
        done = step / steps if steps else wall / budget
        if done >= wanted[0]:
            wanted = [m for m in wanted if m > done]
            trainer.result.iterations = step
            marks.append(Mark(step, wall, cpu, score(trainer, pairs)))
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

    >>> reached([Mark(0, 0.0, 0.0, 10.0), Mark(9, 4.0, 8.0, 20.0)], 15.0)
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


def _row(method: str, size: int, setting: str, wall: float, cpu: float, psnr: float) -> Row:
    error, facts = 10.0 ** (-psnr / 20.0), {"PSNR": psnr}
    return Row(method, True, size, setting, spread([wall]), spread([cpu]), error, facts)


def _one_preset(name: str, record: Any, settings: Settings) -> tuple[list[Mark], str]:
    from monopart.toolkit.avatar import Avatar
    from monopart.toolkit.cache import NO_CACHE, user_cache
    from monopart.toolkit.presets import preset, with_overrides
    from monopart.toolkit.train import Trainer

    config = preset(name)
    if settings.quick:
        loss = {"lpips": 0.0, "consistency_samples": 16}
        field = {"log2_size": 8, "prior_slope": 0.0}
        config = with_overrides(config, train={"rays": 32}, field=field, loss=loss)
    else:
        config = with_overrides(config, train={"seconds": settings.seconds})
    starts = []
    for cache in (NO_CACHE, user_cache(), user_cache()):  # cold, filling the cache, warm
        torch.manual_seed(config.seed)
        start, start_cpu = time.perf_counter(), time.process_time()
        trainer = Trainer(Avatar.create(record, config, cache))
        starts.append((time.perf_counter() - start, time.process_time() - start_cpu))
    cold, warm = starts[0], starts[-1]
    pairs = held_out(record, 1 if settings.quick else IMAGES)
    if not settings.quick:  # kernels are compiled once per machine, and are warm in every later run
        trainer.losses(0, 0.0)
    marks = train_curve(trainer, settings.seconds, pairs, 2 if settings.quick else None)
    return marks, (
        f"{name}: before the first step {cold[0]:.1f} s ({cold[1]:.1f} CPU s) without the cache, "
        f"{warm[0]:.1f} s ({warm[1]:.1f} CPU s) with it; not counted in the curve."
    )


def run_training(settings: Settings) -> tuple[Report, dict[str, str]]:
    """Train every preset on a capture.

    Returns:
        The report and the curves as SVG files by name.

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
    names = settings.presets or (("tiny",) if settings.quick else preset_names())
    curve: list[Row] = []
    times: list[Row] = []
    never: list[Absence] = []
    notes = [
        f"{record.name}: mean PSNR of held-out images, strict, full image; scoring is not timed.",
        f"Learning rates fall over {settings.seconds:g} s: another budget has other curves.",
    ]
    for name in names:
        say(f"training: {name} on {record.name}")
        marks, note = _one_preset(name, record, settings)
        notes.append(note)
        curve += [_row(name, m.step, f"{m.wall:.1f} s", m.wall, m.cpu, m.psnr) for m in marks]
        for target in TARGETS:
            at = reached(marks, target)
            if at is None:
                never.append(Absence(f"{name}, {target} dB", "not reached in the budget"))
            else:
                times.append(_row(name, round(target * 10), f"{target} dB", *at, target))
    error = "root mean square of the colour error"
    tables = [
        Table("curve", "PSNR against seconds (size: steps)", error, curve, [], notes),
        Table("time_to", "Seconds to a PSNR (size: dB × 10)", error, times, never, []),
    ]
    plots = {
        "training_cpu.svg": curve_plot(curve, "cpu"),
        "training_wall.svg": curve_plot(curve, "wall"),
    }
    return Report(f"training_{record.name}", settings.quick, environment(), tables), plots


def curve_plot(rows: list[Row], clock: str) -> str:
    """Error of held-out views against seconds, one line per preset.

    Args:
        rows: of the table "curve".
        clock: "cpu" or "wall".
    """
    names = list(dict.fromkeys(r.method for r in rows))
    series = []
    for name in names:
        own = [r for r in rows if r.method == name and r.wall.median > 0]
        times = [dataclasses.asdict(r)[clock]["median"] for r in own]
        series.append(Dots(name, times, [r.error or 1.0 for r in own], True, True))
    label = "CPU seconds" if clock == "cpu" else "wall-clock seconds"
    return log_plot(series, "Error of held-out views", label, "root mean square colour error")
