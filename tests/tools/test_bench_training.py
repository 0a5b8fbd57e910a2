"""monopart-bench training: curves over seeds, seconds to a PSNR, budgets of either clock."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest

from monopart.tools.bench import results, training
from monopart.tools.bench.cli import main
from monopart.tools.bench.show import curve_plot
from monopart.tools.bench.training import (
    Budget,
    Mark,
    curve_rows,
    held_out,
    reached,
    time_rows,
    train_curve,
)

FIRST = [Mark(0.5, 5, 2.0, 4.0, 20.0), Mark(1.0, 9, 4.0, 8.0, 30.0)]
SECOND = [Mark(0.5, 7, 2.0, 6.0, 22.0), Mark(1.0, 13, 4.0, 10.0, 26.0)]


@pytest.mark.slow
def test_every_capture_and_seed_is_trained(tmp_path: Path, demo_capture: Path) -> None:
    other = tmp_path / "other"
    other.symlink_to(demo_capture, target_is_directory=True)
    arguments = ["training", str(demo_capture), str(other), "--seeds", "3", "4", "--quick"]
    assert main([*arguments, "--cpu-seconds", "60", "--out", str(tmp_path)]) is None
    for folder in (demo_capture, other):
        name = f"training_{folder.name}"
        report = results.read_report(tmp_path / f"{name}.json")
        curve, times = report.tables
        (row,) = curve.rows
        assert row.size == 2  # steps
        assert row.facts["seeds"] == 2.0
        assert row.facts["PSNR std"] >= 0.0
        assert row.error == pytest.approx(10 ** (-row.facts["PSNR"] / 20))
        assert times.rows or times.absent
        assert "Seeds 3, 4." in curve.notes[1] and "60 CPU seconds" in curve.notes[1]
        for clock in ("cpu", "wall"):
            ElementTree.parse(tmp_path / f"{name}_curve_{clock}.svg")


def test_budgets_end_by_their_clock() -> None:
    assert Budget(10.0).done(3, 5.0, 2.0) == 0.5
    assert Budget(10.0, cpu=True).done(3, 5.0, 2.0) == 0.2
    assert Budget(10.0, steps=4).done(3, 5.0, 2.0) == 0.75


def test_a_curve_is_scored_once_per_mark(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[tuple[int, float]] = []
    trainer: Any = SimpleNamespace(result=SimpleNamespace(iterations=0))
    trainer.step = lambda step, done: taken.append((step, done))
    monkeypatch.setattr(training, "score", lambda trainer, pairs: float(len(taken)))
    monkeypatch.setattr(training, "MARKS", (0.5, 1.0))
    (mark,) = train_curve(trainer, Budget(1.0, steps=4), [])
    assert (mark.part, mark.step, mark.psnr) == (1.0, 4, 4.0)
    assert taken == [(0, 0.0), (1, 0.25), (2, 0.5), (3, 0.75)]
    assert trainer.result.iterations == 4


def test_time_to_psnr_is_interpolated() -> None:
    marks = [Mark(0.1, 0, 0.0, 0.0, 10.0), *FIRST]
    assert reached(marks, 25.0) == (3.0, 6.0)
    assert reached(marks, 31.0) is None
    assert reached(marks, 5.0) == (0.0, 0.0)


def test_seeds_are_averaged_at_equal_parts_of_the_budget() -> None:
    half, end = curve_rows("fast", [FIRST, SECOND])
    assert (half.size, half.wall.median, half.cpu.median) == (6, 2.0, 5.0)
    assert half.facts["PSNR"] == pytest.approx(21.0)
    assert half.facts["PSNR std"] == pytest.approx(2.0**0.5)
    assert end.setting == "100 % of the budget"
    assert len(curve_rows("fast", [FIRST, SECOND[1:]])) == 1  # the first mark of one is missing
    assert "PSNR std" not in curve_rows("fast", [FIRST])[0].facts
    assert "fast" in curve_plot([half, end], "cpu")


def test_targets_say_how_many_seeds_reach_them() -> None:
    rows, never = time_rows("fast", [FIRST, SECOND])
    at = {row.setting: row for row in rows}
    assert at["25.0 dB"].wall.count == 2
    assert "28.0 dB" in at and at["28.0 dB"].facts["seeds"] == 1.0
    assert at["28.0 dB"].facts["of seeds"] == 2.0
    said = {a.method: a.reason for a in never}
    assert said["fast, 28.0 dB"] == "not reached in the budget by 1 of 2 seeds"
    assert said["fast, 30.4 dB"] == "not reached in the budget by 2 of 2 seeds"
    assert "of seeds" not in time_rows("fast", [FIRST])[0][0].facts


def test_bad_arguments_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for more in (
        ["--seconds", "0"],
        ["--cpu-seconds", "-1"],
        ["--seconds", "nan"],
        [str(tmp_path / "twice" / tmp_path.name)],
    ):
        assert main(["training", str(tmp_path), *more]) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_held_out_views_take_turns(captures_dir: Path) -> None:
    from monopart.toolkit.captures import read_capture

    pairs = held_out(read_capture(captures_dir / "actor_a"))
    assert pairs[:5] == [(1, 0), (2, 10), (3, 20), (4, 30), (1, 40)]
    assert len(pairs) == 10


def test_short_reports_say_the_same(tmp_path: Path) -> None:
    table = results.Table("curve", "C", "m", curve_rows("fast", [FIRST, SECOND]), [], [])
    report = results.Report("training_a", False, {"cores": 2}, [table])
    for short in (False, True):
        results.write_report(report, tmp_path / f"{short}.json", short)
    long, brief = (results.read_report(tmp_path / f"{short}.json") for short in (False, True))
    assert brief.tables[0].rows[0].cpu == long.tables[0].rows[0].cpu
    assert brief.environment == long.environment
    text = (tmp_path / "True.json").read_text()
    assert json.loads(text) and len(text) < (tmp_path / "False.json").stat().st_size / 1.5
