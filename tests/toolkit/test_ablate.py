"""Grids of trainings: checked first, resumed, counted right, and written beside the paper's."""

import csv
import dataclasses
import json
import shutil
import statistics

import pytest
from training import TINY

from monopart.geometry.errors import InputError, MonopartError
from monopart.toolkit import cli
from monopart.toolkit.ablate import SUMMARY, Plan, ablate, cells_of, state_of, summarise
from monopart.toolkit.ablate_jobs import locked, running_part, start_process
from monopart.toolkit.ablate_page import page_text, replaced
from monopart.toolkit.ablate_table import Spread, collected, rows_of, verdict
from monopart.toolkit.arguments import parse, resolve
from monopart.toolkit.grid import FULL, Variant
from monopart.toolkit.protocols import SPLITS
from monopart.toolkit.resume import STATE

pytestmark = pytest.mark.usefixtures("short_strip")
GRID = {
    FULL: Variant("everything", published={"novel_view": 32.12}),
    "half_mse": Variant("half", ("loss.mse*=0.5",), published={"novel_view": 31.52}),
    "rigid": Variant("skinning alone", preset="rigid"),
    "no_change": Variant("as it is", ("loss.mse*=1",)),
}


class Ended:
    """A training that has ended."""

    def __init__(self, code):
        self.code = code

    def poll(self):
        return self.code

    def terminate(self):
        raise AssertionError("it has ended")


def in_this_process(arguments, log):
    return Ended(cli.main(list(arguments)) or 0)


def plan(capture, out, **changes):
    values = {"seeds": 2, "base": "tiny", "iterations": 2, "images": 1, "settings": TINY}
    return Plan((capture,), out, **({"variants": GRID} | values | changes))


@pytest.fixture(scope="module")
def finished(small_capture, tmp_path_factory):
    """A grid of two cells and two seeds; not to be changed."""
    out = tmp_path_factory.mktemp("grid") / "ablation"
    variants = {n: GRID[n] for n in (FULL, "half_mse", "no_change")}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("monopart.toolkit.commands.STRIP_VIEWS", 2)
        made = plan(small_capture, out, variants=variants)
        assert ablate(made, "monopart ablate …", start=in_this_process) == out / "table.md"
    return made


def test_cells_are_seeds_times_captures_times_variants(small_capture, tmp_path):
    other = tmp_path / "other"
    made = Plan((small_capture, other), tmp_path / "out", GRID, 2, "fast", seconds=5.0)
    cells, equal = cells_of(made)
    assert equal == {"no_change": FULL}
    assert len(cells) == 2 * 2 * 3 and len({c.folder for c in cells}) == len(cells)
    assert [c.seed for c in cells] == sorted(c.seed for c in cells)  # a cut grid is balanced
    half = next(c for c in cells if c.name == "half_mse" and c.seed == 1)
    assert half.config.loss.mse == 0.5 and half.config.seed == 1
    assert half.config.train.seconds == 5.0
    # what the process is told is what was checked
    told = parse(half.command)
    assert resolve(told.preset, told.set, told.seconds, told.iterations, told.seed) == half.config


@pytest.mark.parametrize(
    ("variant", "message"),
    [
        (Variant("", ("deform.nothing=1",)), "cell bad: .*expected an entry of deform"),
        (Variant("", ("loss.mse=much",)), "cell bad: .*expected float"),
        (Variant("", preset="none"), "cell bad: --preset: expected one of"),
    ],
)
def test_nothing_is_trained_where_a_cell_is_wrong(small_capture, tmp_path, variant, message):
    out = tmp_path / "out"
    with pytest.raises(InputError, match=message):
        ablate(plan(small_capture, out, variants=GRID | {"bad": variant}), "")
    assert not out.exists()


def test_nothing_is_trained_where_a_capture_is_wrong(small_capture, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(InputError, match="expected the folder of a capture, found nothing"):
        ablate(Plan((small_capture, tmp_path / "none"), out, GRID, 1, "fast"), "")
    with pytest.raises(InputError, match=r"different names, found small twice"):
        ablate(Plan((small_capture, small_capture), out, GRID, 1, "fast"), "")
    assert not out.exists()


def test_the_tables_are_of_the_runs(finished):
    out = finished.out
    page = (out / "table.md").read_text(encoding="utf-8")
    assert "measured, small: novel view, protocol strict**, 1 of 2 images, evenly spread" in page
    assert "published, ZJU-MoCap: PSNR" in page and "31.52 (-0.60)" in page
    assert "the same configuration as `full`" in page
    rows = list(csv.DictReader((out / "table.csv").read_text(encoding="utf-8").splitlines()))
    stored = json.loads((out / "table.json").read_text(encoding="utf-8"))
    assert len(stored["rows"]) == len(rows) and len(stored["trainings"]) == 4
    start = f"monopart train CAPTURES/small --out runs/{out.name}/small/"
    assert all(t["command"].startswith(start) for t in stored["trainings"]), "no absolute paths"
    metrics = {
        (name, seed): json.loads(
            (out / "small" / name / f"seed-{seed}" / "metrics.json").read_text(encoding="utf-8")
        )["novel_view"]["strict"]["box"]["ssim"]
        for name in (FULL, "half_mse")
        for seed in (0, 1)
    }
    wanted = ("novel_view", "as given", "strict", "box", "ssim", "half_mse")
    columns = ("split", "poses", "protocol", "region", "metric", "cell")
    (row,) = [r for r in rows if tuple(r[c] for c in columns) == wanted]
    halves = [metrics["half_mse", s] for s in (0, 1)]
    gaps = [metrics["half_mse", s] - metrics[FULL, s] for s in (0, 1)]
    assert float(row["mean"]) == pytest.approx(statistics.fmean(halves))
    assert float(row["deviation"]) == pytest.approx(statistics.stdev(halves))
    assert float(row["minus_full"]) == pytest.approx(statistics.fmean(gaps))
    assert float(row["minus_full_deviation"]) == pytest.approx(statistics.stdev(gaps))
    assert row["source"] == "measured, small" and row["seeds"] == "2"


def test_a_complete_grid_trains_nothing(finished):
    def start(arguments, log):
        raise AssertionError("nothing is left to train")

    before = (finished.out / "table.csv").read_bytes()
    ablate(finished, "again", start=start)
    assert (finished.out / "table.csv").read_bytes() == before


def test_other_settings_are_not_mixed(finished, small_capture):
    variants = finished.variants
    for changes, message in (
        ({"iterations": 3}, r"found train.iterations=2 in place of 3; choose another --out"),
        ({"images": None}, "expected scores of --images None, found 1"),
        ({"settings": (*TINY, "loss.mse=2")}, "found loss.mse=1.0 in place of 2.0"),
    ):
        with pytest.raises(InputError, match=message):
            ablate(plan(small_capture, finished.out, variants=variants, **changes), "")


def test_unfinished_goes_on_and_broken_begins_again(small_capture, tmp_path):
    made = plan(small_capture, tmp_path / "out", variants={FULL: GRID[FULL]}, seeds=1)
    asked = []

    def cut_short(arguments, log):
        asked.append(list(arguments))
        folder = cells[0].folder
        if "--resume" in arguments:
            (folder / STATE).unlink()  # this time nothing was saved that could go on
        else:
            assert not folder.exists()
            assert cli.main(list(arguments)) is None
            (folder / STATE).write_bytes(b"")
        return Ended(1)

    cells, _ = cells_of(made)
    for state in ("absent", "unfinished", "broken"):
        assert state_of(cells[0], made) == state
        with pytest.raises(MonopartError, match=r"1 of 1 trainings failed \(small, full, seed 0"):
            ablate(made, "", start=cut_short)
        assert not (cells[0].folder / SUMMARY).exists()
    assert ["--resume" in a for a in asked] == [False, True, False]
    log = (made.out / "logs" / "small-full-0.txt").read_text(encoding="utf-8")
    assert log.count("$ monopart train ") == 3


def test_a_folder_of_something_else_is_left_alone(small_capture, tmp_path):
    made = plan(small_capture, tmp_path)
    cell = cells_of(made)[0][0]
    cell.folder.mkdir(parents=True)
    (cell.folder / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="expected a run of this grid or nothing, found other"):
        ablate(made, "")
    assert (cell.folder / "notes.txt").read_text() == "mine"


def test_what_fails_does_not_stop_the_others(small_capture, tmp_path):
    made = plan(small_capture, tmp_path / "out", seeds=1)

    def start(arguments, log):
        return Ended(2) if "half_mse" in str(arguments) else in_this_process(arguments, log)

    with pytest.raises(MonopartError, match="1 of 3 trainings failed"):
        ablate(made, "", start=start)
    stored = json.loads((made.out / "table.json").read_text(encoding="utf-8"))
    assert {t["cell"] for t in stored["trainings"]} == {FULL, "rigid"}
    # and its place stays open
    assert "`half_mse` | as given | – | –" in (made.out / "table.md").read_text(encoding="utf-8")


def test_the_program(small_capture, tmp_path, capsys, monkeypatch):
    grid = tmp_path / "grid.json"
    grid.write_text(json.dumps({"half": {"set": ["loss.mse*=0.5"]}}))
    page = tmp_path / "results.md"
    page.write_text("# Results\n")
    monkeypatch.setattr(
        "monopart.toolkit.ablate.start_process",
        lambda a, log, threads, lock: in_this_process(a, log),
    )
    command = ["ablate", str(small_capture), "--out", str(tmp_path / "ab"), "--grid", str(grid)]
    command += ["--base", "tiny", "--iterations", "1", "--seeds", "1", "--images", "1"]
    assert cli.main([*command, "--publish", str(page), "--set", *TINY]) is None
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "ab" / "table.md")
    text = page.read_text(encoding="utf-8")
    assert text.startswith(
        "# Results\n\n<!-- ab: begin -->\nMade by\n\n    monopart ablate CAPTURES"
    )
    assert str(tmp_path) not in text
    assert {p.name for p in (tmp_path / "results").iterdir()} == {"ab.json", "ab.csv"}
    assert str(tmp_path) not in (tmp_path / "results" / "ab.csv").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--seeds", "0"], "--seeds: expected at least 1"),
        (["--jobs", "0"], "--jobs: expected at least 1"),
        (["--only", "nothing"], "--only: expected some of full"),
        (["--publish", "none.md"], "--publish none.md: expected a page"),
        (["--grid", "none.json"], "--grid none.json: expected a file"),
        (["--seconds", "1", "--iterations", "1"], "expected one of them, found both"),
    ],
)
def test_wrong_arguments(small_capture, tmp_path, capsys, words, message):
    out = tmp_path / "out"
    assert cli.main(["ablate", str(small_capture), "--out", str(out), *words]) == 2
    assert message in capsys.readouterr().err and not out.exists()


def _summary(cell, seed, psnr, lpips):
    full = {"psnr": psnr, "ssim": None, "lpips": lpips}
    metrics = {"novel_view": {"strict": {"full": full}}}
    code = {"git_commit": f"c{seed}"}
    costs = {"iterations": 5, "seconds": 1.0, "cpu_seconds": 2.0, "warnings": ["Mind."] * seed}
    names = {"capture": "c", "cell": cell, "seed": seed, "images": {"novel_view": 4}}
    return {**names, **costs, "code": code, "metrics": metrics}


def test_differences_are_paired_over_the_seeds():
    """Seeds differ by 2 dB, the cells by 0.1: unpaired noise would hide it."""
    summaries = [_summary(FULL, s, 20.0 + 2 * s, 0.1) for s in range(3)]
    summaries += [_summary("half_mse", s, 19.9 + 2.01 * s, 0.1) for s in range(1, 3)]
    table = collected(summaries)
    rows = rows_of(table, GRID, {"no_change": FULL})
    row = next(r for r in rows if r["cell"] == "half_mse" and r["metric"] == "psnr")
    assert row["minus_full"] == pytest.approx(-0.085)
    assert row["minus_full_deviation"] == pytest.approx(0.01 / 2**0.5)
    assert row["effect"] == "worse" and row["published_psnr_zju_mocap_legacy"] == 31.52
    same = next(r for r in rows if r["cell"] == "no_change" and r["metric"] == "psnr")
    assert same["minus_full"] == 0.0 and same["effect"] == "within noise"
    assert not [r for r in rows if r["metric"] == "ssim"]  # undefined is no figure
    facts = {"command": "x", "base": "fast", "equal": {}, "settings": [], "splits": {}}
    page = page_text(table, GRID, summaries, facts)
    assert "(**-0.08 ± 0.01**)" in page or "(**-0.09 ± 0.01**)" in page
    assert "different states of the code: c0, c1, c2" in page
    assert "4 of 5 trainings: Mind." in page


def test_scores_at_refit_poses_are_read_from_the_run(finished, tmp_path):
    cell = cells_of(finished)[0][0]
    moved = dataclasses.replace(cell, folder=shutil.copytree(cell.folder, tmp_path / "run"))
    row = {"split": "novel_pose", "column": "refit (training camera)", "refit": {"full": {}}}
    (moved.folder / "refit.json").write_text(json.dumps({"rows": [row]}))
    summary = summarise(moved, finished)
    assert summary["metrics"]["novel_pose@refit (training camera)"] == {"strict": {"full": {}}}
    assert summary["images"] == dict.fromkeys(SPLITS, 1)
    (moved.folder / "images_novel_pose.csv").unlink()
    with pytest.raises(InputError, match=r"images_novel_pose.csv: expected .* found none"):
        summarise(moved, finished)


def test_refit_poses_are_rows_of_their_own():
    summary = _summary(FULL, 0, 20.0, 0.1)
    summary["metrics"]["novel_view@refit"] = {"strict": {"full": {"psnr": 25.0}}}
    found = {(k.split, k.poses): v[FULL].mean for k, v in collected([summary]).items()}
    assert found["novel_view", "refit"] == 25.0


@pytest.mark.parametrize(
    ("metric", "values", "effect"),
    [
        ("psnr", [0.3, 0.2], "better"),
        ("psnr", [0.3, -0.2], "within noise"),
        ("lpips", [0.3, 0.2], "worse"),
        ("ssim", [0.3], "one seed"),
    ],
)
def test_verdicts(metric, values, effect):
    assert verdict(metric, Spread.of(dict(enumerate(values)))) == effect


def test_spreads_without_a_common_seed():
    assert Spread.of({0: 1.0}).minus(Spread.of({1: 1.0})) is None
    assert verdict("psnr", None) == "no pair"


def test_a_page_is_replaced_between_its_marks(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("a\n")
    page.write_text(replaced(page, "x", "one\n"))
    page.write_text(page.read_text() + "b\n")
    assert replaced(page, "x", "two\n") == "a\n\n<!-- x: begin -->\ntwo\n<!-- x: end -->\nb\n"
    page.write_text("<!-- x: begin -->")
    with pytest.raises(InputError, match="expected both marks"):
        replaced(page, "x", "two\n")


def test_one_program_at_a_time(tmp_path):
    with locked(tmp_path), pytest.raises(InputError, match="found another monopart"):
        with locked(tmp_path):
            pass
    with locked(tmp_path) as lock:
        assert lock >= 0


def test_part_of_running_trainings(monkeypatch):
    monkeypatch.setattr("time.perf_counter", lambda: 100.0)
    assert running_part([], [90.0]) == 0.0
    assert running_part([20.0], [90.0, 0.0]) == pytest.approx(0.5 + 0.95)


@pytest.mark.slow
def test_a_process_of_its_own(tmp_path):
    """It is told the arguments, writes into the log, and keeps the lock while it lives."""
    log = tmp_path / "log.txt"
    with locked(tmp_path) as lock:
        job = start_process(["info", str(tmp_path / "none")], log, 1, lock)
    with pytest.raises(InputError, match="found another"), locked(tmp_path):
        pass
    while job.poll() is None:
        pass
    assert job.poll() == 2 and "monopart: error: " in log.read_text(encoding="utf-8")
    with locked(tmp_path):
        pass
