"""From the results of a run to what its report shows."""

import itertools
import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from monopart.geometry.errors import InputError

from .avatar import Avatar
from .captures import describe
from .evaluate import Evaluation, ImageScore
from .report_data import Headline, ReferenceRow, ReportData, SkipRow, Timings, Triple
from .report_worst import worst_frames
from .runs import read_facts
from .train_result import TrainResult
from .video import Image

TRIPLES = 6
_SOURCE = "measured on the same capture, {}; CPU seconds"


@dataclass(frozen=True)
class RunResults:
    """What a run gave, beyond what lies in its folder."""

    evaluations: Sequence[Evaluation]
    """Scores and pictures of the held-out images."""
    training: TrainResult
    """What the training did."""
    stages: Mapping[str, float]
    """Wall-clock seconds per stage in order."""
    strip: Sequence[Image]
    """Frames of one turn."""
    environment: Mapping[str, Any]
    """From `environment_facts`."""
    skipping: Sequence[SkipRow] = ()
    """What was skipped."""
    peak_memory: int | None = None
    """Largest resident memory of the process, bytes."""
    warnings: Sequence[str] = field(default_factory=list)
    """What a reader must know, beside the warnings of the training."""


def report_data(run: Path, avatar: Avatar, results: RunResults) -> ReportData:
    """What the report of a run shows.

    Args:
        run: the run folder, for train.jsonl, config.json and metrics.json.
        avatar: the trained person.
        results: what else is known.
    """
    curves = read_curves(run / "train.jsonl")
    record, training = avatar.record, results.training
    shown = [i.seconds for e in results.evaluations for i in e.images]
    timings = Timings(
        dict(results.stages),
        seconds_per_iteration(curves, training),
        statistics.median(shown) if shown else None,
        results.peak_memory,
        f"Wall-clock seconds; the training took {training.cpu_seconds:.0f} CPU seconds for "
        f"{training.iterations} iterations. Medians per iteration and per frame.",
    )
    return ReportData(
        title=record.name if run.name == record.name else f"{record.name}: {run.name}",
        capture=capture_facts(describe(record)),
        headline=headline(results, timings),
        curves=curves,
        round_trips=training.round_trips,
        capacity=training.capacity,
        metrics=merged_metrics(run / "metrics.json", results.evaluations),
        triples=[
            t for e in results.evaluations for t in triples(avatar, e, len(results.evaluations))
        ],
        worst=[w for e in results.evaluations for w in worst_frames(record, e)],
        turntable=results.strip,
        timings=timings,
        skipping=results.skipping,
        config=read_facts(run / "config.json"),
        environment=results.environment,
        warnings=[*training.warnings, *results.warnings],
        references=references(record.name),
    )


def capture_facts(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Facts of a capture as short texts.

    Args:
        facts: from `describe`.
    """
    height, width = facts["image_size"]
    body, poses = facts["body"], facts["poses"]
    texts = {
        "frames": facts["frames"],
        "image size": f"{width} × {height}",
        "cameras": ", ".join(facts["cameras"]),
        "frames per second": facts["fps"],
        "body": f"{body['vertices']} vertices, {body['joints']} joints",
        "body track": facts["params"],
        "mean joint angle": f"{poses['mean_joint_angle_deg']:.0f}°",
        "largest joint angle": f"{poses['max_joint_angle_deg']:.0f}°",
        "way of the body": f"{poses['translation_extent_m']:.2f} m",
    }
    for name, split in facts["splits"].items():
        cameras, frames = len(split["cameras"]), split["frames"]
        texts[name] = f"{split['images']} images ({cameras} cameras × {frames} frames)"
    return texts


def read_curves(path: Path) -> list[dict[str, Any]]:
    """The rows of a train.jsonl; none where there is no file.

    Raises:
        InputError: a line that is not JSON.
    """
    if not path.is_file():
        return []
    rows = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            rows.append(json.loads(line))
        except ValueError as error:
            raise InputError(
                f"{path}, line {number}: expected JSON, found {error}; remove the line"
            ) from None
    return rows


def seconds_per_iteration(
    curves: Sequence[Mapping[str, Any]], training: TrainResult
) -> float | None:
    """Median wall-clock seconds of an iteration between log rows; the mean of a short run."""
    costs = [
        (b["seconds"] - a["seconds"]) / (b["iteration"] - a["iteration"])
        for a, b in itertools.pairwise(curves)
        if b["iteration"] > a["iteration"]
    ]
    if costs:
        return statistics.median(costs)
    return training.seconds / training.iterations if training.iterations else None


def headline(results: RunResults, timings: Timings) -> list[Headline]:
    """The numbers at the top: the first evaluated split, and what it cost."""
    numbers = []
    if results.evaluations:
        first = results.evaluations[0]
        split, count = first.split.replace("_", " "), len(first.images)
        note = f"{split}, {{}}, {count} images, {first.protocol}"
        full, box = first.mean["full"], first.mean["box"]
        numbers = [
            Headline("PSNR, full image", full["psnr"], "dB", note.format("full image")),
            Headline("PSNR, box", box["psnr"], "dB", note.format("box of the person")),
            Headline("SSIM", full["ssim"], "", note.format("full image")),
            Headline("LPIPS", full["lpips"], "", note.format("full image")),
        ]
    cpu = f"{results.training.cpu_seconds:.0f} CPU seconds, {results.training.iterations} steps"
    return [
        *numbers,
        Headline("Training", round(results.training.seconds, 1), "s", cpu),
        Headline("Rendering", timings.render_seconds_per_frame, "s", "per frame, median"),
    ]


def merged_metrics(path: Path, evaluations: Sequence[Evaluation]) -> dict[str, Any]:
    """The content of a metrics.json with the means of evaluations put in."""
    metrics: dict[str, Any] = read_facts(path) if path.is_file() else {}
    for evaluation in evaluations:
        metrics.setdefault(evaluation.split, {}).update(evaluation.means)
    return metrics


def chosen_images(images: Sequence[ImageScore], count: int) -> list[tuple[ImageScore, bool]]:
    """Images to show: evenly spread ones, and last the worst by PSNR, which is marked True."""
    worst = min(images, key=lambda i: i.scores["full"]["psnr"] or 0.0)
    others = [i for i in images if i is not worst]
    few = min(max(count - 1, 0), len(others))
    spread = [others[i * len(others) // few] for i in range(few)]
    return [*((i, False) for i in spread), (worst, True)]


def triples(avatar: Avatar, evaluation: Evaluation, splits: int) -> list[Triple]:
    """Some images of a split beside the photographs.

    Args:
        avatar: the person.
        evaluation: scores and pictures of the split.
        splits: number of splits that share the page.
    """
    record, shown = avatar.record, []
    for image, is_worst in chosen_images(evaluation.images, max(1, TRIPLES // splits)):
        label = f"{record.camera_names[image.camera]}, frame {image.frame}"
        shown.append(
            Triple(
                f"{label} (worst of split)" if is_worst else label,
                evaluation.split,
                image.rendered,
                record.masked_image(image.camera, image.frame),
                image.scores["full"],
                "The lowest PSNR of all images of this split." if is_worst else "",
            )
        )
    return shown


def references(capture: str) -> list[ReferenceRow]:
    """Figures of other methods measured on a capture; none for a capture without such.

    Args:
        capture: name of the capture.
    """
    if capture != "actor_a":
        return []
    ten, four = _SOURCE.format("10 images"), _SOURCE.format("4 images")
    body, peer = "naked body, texture from the training frames", "Instant-NVR"
    probe, mixed = "one hash-grid field, MSE only", ten + "; LPIPS of a run at 29.56 dB"
    view, pose = "novel_view", "novel_pose"
    return [
        ReferenceRow(body, 25.92, 0.949, 0.040, 15, view, note=ten),
        ReferenceRow(peer, 26.63, 0.943, 0.051, 2810, view, note=ten),
        ReferenceRow(probe, 29.76, 0.9625, 0.055, 220, view, note=mixed),
        ReferenceRow(body, 18.70, 0.738, 0.182, 15, view, region="box", note=ten),
        ReferenceRow(peer, 19.52, 0.719, 0.210, 2810, view, region="box", note=ten),
        ReferenceRow(probe, 22.56, None, 0.221, 220, view, region="box", note=mixed),
        ReferenceRow(body, 26.06, None, None, 15, pose, note=four),
        ReferenceRow(peer, 27.57, None, None, 2810, pose, note=four),
    ]
