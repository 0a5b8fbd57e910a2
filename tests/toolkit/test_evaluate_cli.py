"""Evaluation by the program: repeatable, merged into the run folder, the report rebuilt."""

import csv
import io
import json
import shutil

import pytest
import torch

from monopart.toolkit import cli, results
from monopart.toolkit.avatar import view_of
from monopart.toolkit.captures import describe, read_capture
from monopart.toolkit.captures.frames import spread
from monopart.toolkit.evaluate import evaluate_split, images_csv
from monopart.toolkit.lpips import load_lpips
from monopart.toolkit.protocols import SPLITS
from monopart.toolkit.report_content import capture_facts
from monopart.toolkit.runs import open_run

pytestmark = pytest.mark.usefixtures("short_strip")


@pytest.fixture
def run(trained_run, tmp_path):
    """A copy that may be changed."""
    return shutil.copytree(trained_run, tmp_path / "copy")


def test_two_evaluations_are_bitwise_equal(trained_run):
    first, second = (
        evaluate_split(open_run(trained_run), "novel_view", load_lpips()) for _ in range(2)
    )
    assert first.mean == second.mean and first.stats == second.stats
    for a, b in zip(first.images, second.images, strict=True):
        assert (a.camera, a.frame, a.scores) == (b.camera, b.frame, b.scores)
        assert torch.equal(a.rendered, b.rendered)


def test_a_full_evaluation_repeats_that_of_training(run, trained_run, capsys):
    (run / "metrics.json").unlink()
    (run / "report.html").unlink()
    assert cli.main(["eval", str(run)]) is None
    assert (run / "metrics.json").read_bytes() == (trained_run / "metrics.json").read_bytes()
    lines = capsys.readouterr().out.splitlines()
    names = [f"{split}, {kind}" for split in SPLITS for kind in ("strict", "shape")]
    assert [line.split(":")[0] for line in lines] == [*names, "report"]
    page = (run / "report.html").read_text(encoding="utf-8")
    assert "worst of split" in page and "training: colour networks" in page
    facts, before = (json.loads((r / "training.json").read_text()) for r in (run, trained_run))
    for name in ("iterations", "seconds", "cpu_seconds", "stats"):
        assert facts[name] == before[name]


def test_one_split_is_merged(run, trained_run, capsys):
    metrics = json.loads((run / "metrics.json").read_text())
    others = {name: metrics[name] for name in SPLITS[1:]}
    (run / "metrics.json").write_text(json.dumps(others))
    report = (run / "report.html").read_bytes()
    assert cli.main(["eval", str(run), "--split", "novel_view"]) is None
    assert json.loads((run / "metrics.json").read_text()) == metrics
    assert (run / "report.html").read_bytes() == report
    assert capsys.readouterr().out.startswith("novel_view, strict: full ")


def test_some_images_leave_the_run_as_it_is(run, capsys):
    before = {p.name: p.read_bytes() for p in run.iterdir()}
    assert cli.main(["eval", str(run), "--images", "1"]) is None
    assert {p.name: p.read_bytes() for p in run.iterdir()} == before
    seen = capsys.readouterr()
    assert "(1 images" in seen.out and "left as it is" in seen.err


def test_a_broken_training_file(run, capsys):
    (run / "training.json").write_text("{}")
    assert cli.main(["eval", str(run)]) == 2
    assert "training.json: expected iterations, found no such entry" in capsys.readouterr().err


def test_csv_holds_every_image(trained_run):
    avatar = open_run(trained_run)
    evaluation = evaluate_split(avatar, "novel_pose", None)
    rows = list(csv.DictReader(io.StringIO(images_csv(evaluation, avatar.record.camera_names))))
    assert [(r["camera"], r["frame"]) for r in rows] == [("Camera_B2", "3")]
    for row, image in zip(rows, evaluation.images, strict=True):
        assert float(row["strict_full_psnr"]) == pytest.approx(
            image.scores["full"]["psnr"], rel=1e-5
        )
        assert float(row["shape_full_mask_iou"]) == pytest.approx(image.shape["mask_iou"], rel=1e-5)
        assert row["strict_full_lpips"] == "" and float(row["seconds"]) >= 0
    assert evaluation.mean["box"]["lpips"] is None


def test_perfect_images_do_not_break_the_metrics(trained_run, tmp_path):
    """PSNR of identical images is infinite; JSON holds no such number."""
    avatar = open_run(trained_run)
    evaluation = evaluate_split(
        avatar, "novel_pose", None, avatar.record.split("novel_pose").pairs()[:1]
    )
    evaluation.mean["full"]["psnr"] = float("inf")
    results.write_scores(tmp_path, avatar.record, [evaluation])
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["novel_pose"]["strict"]["full"]["psnr"] is None
    assert "full inf dB" in results.summary(evaluation)


def test_spread():
    pairs = [(0, i) for i in range(10)]
    assert spread(pairs, 3) == [(0, 0), (0, 3), (0, 6)]
    assert spread(pairs, 99) == pairs


def test_facts_of_a_capture(small_capture):
    facts = capture_facts(describe(read_capture(small_capture)))
    assert facts["image size"] == "48 × 48" and facts["train"].startswith("3 images (1 cameras")
    assert view_of(read_capture(small_capture), 1, 3).frame == 3
