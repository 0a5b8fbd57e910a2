"""From results to what the report shows."""

import json
import math

import pytest
import torch

from monopart.geometry.errors import InputError
from monopart.toolkit.evaluate import Evaluation, ImageScore
from monopart.toolkit.report import report_html
from monopart.toolkit.report_content import (
    RunResults,
    chosen_images,
    headline,
    merged_metrics,
    read_curves,
    references,
    report_data,
    seconds_per_iteration,
)
from monopart.toolkit.report_data import SkipRow, Timings
from monopart.toolkit.runs import open_run
from monopart.toolkit.train_result import TrainResult


def _image(frame: int, psnr: float) -> ImageScore:
    scores = {"psnr": float(psnr), "ssim": 0.9, "lpips": None}
    picture = torch.zeros(48, 48, 3, dtype=torch.uint8)
    picture[12:40, 15:30] = 90
    return ImageScore(1, frame, {"full": scores, "box": scores}, 0.25, picture)


def _evaluation(*psnr: float, split: str = "novel_view") -> Evaluation:
    images = [_image(frame, value) for frame, value in enumerate(psnr)]
    mean = {"psnr": sum(psnr) / len(psnr), "ssim": 0.9, "lpips": None}
    return Evaluation(split, "strict", {"full": mean, "box": {**mean}}, images, {})


def test_images_to_show_include_the_worst():
    chosen = chosen_images(_evaluation(30, 31, 20, 32, 33, 34, 35).images, 3)
    assert [(i.frame, worst) for i, worst in chosen] == [(0, False), (4, False), (2, True)]
    assert [i.frame for i, _ in chosen_images(_evaluation(30, 29).images, 6)] == [0, 1]
    assert [worst for _, worst in chosen_images(_evaluation(30).images, 1)] == [True]


def test_seconds_per_iteration_is_the_median():
    rows = [{"iteration": i, "seconds": s} for i, s in ((1, 5.0), (11, 6.0), (21, 7.0), (31, 90.0))]
    result = TrainResult(iterations=31, seconds=93.0)
    assert seconds_per_iteration(rows, result) == pytest.approx(0.1)
    assert seconds_per_iteration(rows[:1], result) == 3.0
    assert seconds_per_iteration([], TrainResult()) is None


def test_headline_names_what_was_measured():
    results = RunResults([_evaluation(30.0)], TrainResult(10, 2.04, 3.9), {}, [], {})
    numbers = {h.label: h for h in headline(results, Timings(render_seconds_per_frame=0.5))}
    assert numbers["PSNR, full image"].value == 30.0
    assert numbers["PSNR, full image"].note == "novel view, full image, 1 images, strict"
    assert numbers["LPIPS"].value is None
    assert (
        numbers["Training"].value == 2.0 and numbers["Training"].note == "4 CPU seconds, 10 steps"
    )
    assert len(headline(RunResults([], TrainResult(), {}, [], {}), Timings())) == 2


def test_curves(tmp_path):
    path = tmp_path / "train.jsonl"
    assert read_curves(path) == []
    path.write_text('{"iteration": 1}\n{"iteration": 2}\n')
    assert read_curves(path) == [{"iteration": 1}, {"iteration": 2}]
    path.write_text('{"iteration": 1}\n{"iter')
    with pytest.raises(InputError, match=r"train\.jsonl, line 2: expected JSON"):
        read_curves(path)


def test_metrics_of_other_splits_are_kept(tmp_path):
    path = tmp_path / "metrics.json"
    path.write_text(json.dumps({"novel_pose": {"strict": {"full": {"psnr": 1.0}}}}))
    merged = merged_metrics(path, [_evaluation(30.0)])
    assert merged["novel_pose"]["strict"]["full"]["psnr"] == 1.0
    assert merged["novel_view"]["strict"]["full"]["psnr"] == 30.0


def test_references_belong_to_one_capture():
    assert references("actor_b") == []
    rows = references("actor_a")
    assert {(r.split, r.region) for r in rows} == {
        ("novel_view", "full"),
        ("novel_view", "box"),
        ("novel_pose", "full"),
    }
    assert all("measured on the same capture" in r.note and "CPU seconds" in r.note for r in rows)
    assert next(r for r in rows if r.name == "Instant-NVR").seconds == 2810


def test_a_page_with_infinite_scores_and_two_splits(trained_run):
    avatar = open_run(trained_run)
    results = RunResults(
        [_evaluation(math.inf, 30.0), _evaluation(25.0, 24.0, split="novel_pose")],
        TrainResult(3, 1.0, 1.0, warnings=["a warning of the training"]),
        {"training": 1.0},
        [torch.zeros(32, 32, 3)],
        {"python": "3"},
        [SkipRow("rays", 10, 5)],
        2**30,
        ["a warning of the evaluation"],
    )
    data = report_data(trained_run, avatar, results)
    assert [t.split for t in data.triples] == ["novel_view"] * 2 + ["novel_pose"] * 2
    worst = [t for t in data.triples if "worst of split" in t.label]
    assert [t.scores["psnr"] for t in worst] == [30.0, 24.0]
    assert data.timings.render_seconds_per_frame == 0.25
    assert data.config["train"]["rays"] == 128 and data.curves
    page = report_html(data)
    for text in ("a warning of the training", "a warning of the evaluation", "1.00 GiB", "inf"):
        assert text in page
