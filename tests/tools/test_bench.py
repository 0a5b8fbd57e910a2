"""monopart-bench: every suite runs at tiny sizes, absent peers are named, reports are read back.

No time is asserted: only that the clocks, the errors and the files are there.
"""

import dataclasses
import importlib.util
import json
import math
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.errors import InputError
from monopart.tools.bench import compare, results, suite, uv
from monopart.tools.bench.bodies import near_points, pose_list, surface_data
from monopart.tools.bench.cli import main
from monopart.tools.bench.meshes import subdivided
from monopart.tools.bench.plots import Dots, log_plot, pareto_front
from monopart.tools.bench.registry import Method, Operation, Problem, Settings, load_open3d
from monopart.tools.bench.scaling import exponents
from monopart.tools.bench.show import cells, markdown
from monopart.tools.bench.skinning_methods import plain_arrays, plain_skinning
from monopart.tools.bench.surface_methods import judge_surface
from monopart.tools.bench.timing import Effort, measure, spread
from monopart.tools.bench.unwrap_meshes import MESHES

SPREAD = {"median", "min", "q1", "q3", "count"}
ROW = {"method", "ours", "size", "setting", "wall", "cpu", "error", "facts"}


def _check_schema(path: Path, suite_name: str) -> dict:
    data = json.loads(path.read_text())
    assert set(data) == {"schema", "suite", "quick", "environment", "tables"}
    assert data["schema"] == results.SCHEMA
    assert data["suite"] == suite_name
    assert data["quick"] is True
    assert data["environment"]["packages"]["torch"]
    assert "open3d" in data["environment"]["peers"]
    for table in data["tables"]:
        assert set(table) == {"operation", "title", "error", "rows", "absent", "notes"}
        for row in table["rows"]:
            assert set(row) == ROW
            for clock in ("wall", "cpu"):
                assert set(row[clock]) == SPREAD
                assert row[clock]["count"] >= 1
            assert row["error"] is None or row["error"] >= 0
        for absence in table["absent"]:
            assert absence["reason"]
    assert results.read_report(path).suite == suite_name
    return data


def _run(name: str, out: Path, *arguments: str) -> dict:
    assert main([name, *arguments, "--quick", "--out", str(out)]) is None
    data = _check_schema(out / f"{name}.json", name)
    assert (out / f"{name}.md").read_text()
    for plot in out.glob("*.svg"):
        ElementTree.parse(plot)
    return data


@pytest.mark.slow
def test_meshes_of_the_uv_suite() -> None:
    assert {o.name for o in uv.operations()} == set(MESHES)
    for name in ("ring", "two_rings", "holes", "part_3"):
        data = MESHES[name][1]()
        assert data.faces.max() == len(data.verts) - 1
        assert len(data.parts) == len(data.faces) > 500


@pytest.mark.slow
def test_uv_suite(tmp_path: Path) -> None:
    data = _run("uv", tmp_path, "--only", "ring")
    rows = {row["method"]: row for row in data["tables"][0]["rows"]}
    assert {"monopart", "monopart, few charts", "xatlas", "LSCM (libigl) on cut parts"} <= set(rows)
    for row in rows.values():
        if row["ours"]:
            assert row["facts"]["flips"] == row["facts"]["overlaps"] == 0
    assert rows["monopart"]["error"] <= 0.0301
    report = results.read_report(tmp_path / "uv.json")
    lines = uv.tables(report).splitlines()
    assert sum(line.startswith("| **monopart") for line in lines) == 2
    page = tmp_path / "page.md"
    page.write_text("a\n<!-- uv: begin -->\nold\n<!-- uv: end -->\nb\n")
    with pytest.raises(InputError, match="--quick run"):
        uv.write_page(report, page)
    full = dataclasses.replace(report, quick=False)
    uv.write_page(full, page)
    text = page.read_text()
    assert text.startswith("a\n") and text.endswith("b\n") and "old" not in text
    assert "### Ring, 80 faces" in text
    page.write_text("no marks")
    with pytest.raises(InputError, match="marks"):
        uv.write_page(full, page)
    with pytest.raises(InputError, match="expected a Markdown page"):
        uv.write_page(full, tmp_path / "none.md")


@pytest.mark.slow
def test_geometry_suite(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = _run("geometry", tmp_path)
    tables = {t["operation"]: t for t in data["tables"]}
    ours = [r for r in tables["surface"]["rows"] if r["method"] == "monopart"]
    assert {r["setting"] for r in ours} == {"pose 00", "pose 01"}
    for row in tables["surface"]["rows"]:
        assert row["error"] < (2e-6 if row["ours"] else 1e-4), row  # trimesh rounds more
    methods = {r["method"] for r in tables["unskin"]["rows"]}
    assert {"broyden on Warp's query, 1 start", "broyden on our tree, 13 starts"} <= methods
    for row in tables["skinning_backward"]["rows"]:
        assert row["error"] < 5e-6, row
        assert row["facts"]["gradient error"] < 1e-4, row
    for row in tables["to_matrix"]["rows"] + tables["to_vector"]["rows"]:
        assert row["error"] < 2e-6, row
    (lens,) = {r["error"] < 1e-9 for r in tables["undistort"]["rows"] if r["ours"]}
    assert lens
    assert (tmp_path / "geometry_surface_pareto.svg").is_file()
    printed = capsys.readouterr().out
    for table in data["tables"]:
        for absence in table["absent"]:
            assert f"absent: {absence['method']}" in printed


@pytest.mark.slow
def test_fields_suite(tmp_path: Path) -> None:
    data = _run("fields", tmp_path)
    for table in data["tables"]:
        methods = {r["method"] for r in table["rows"]}
        assert any(m.startswith("monopart") for m in methods)
        assert len(methods) >= 2
        for row in table["rows"]:
            assert row["error"] < 1e-4, (table["operation"], row)
            assert row["facts"].get("gradient error", 0.0) < 1e-3, (table["operation"], row)
    compiled = [a for t in data["tables"] for a in t["absent"] if a["method"] == "torch.compile"]
    assert len(compiled) == 6


@pytest.mark.slow
def test_scaling_suite(tmp_path: Path) -> None:
    data = _run("scaling", tmp_path, "--only", "scaling_rays", "--only", "scaling_parts")
    rays, parts = data["tables"]
    assert {r["size"] for r in rays["rows"]} == {16, 32}
    assert {r["size"] for r in parts["rows"]} == {1, 5}
    assert any("size^" in note for note in rays["notes"])
    assert all(r["facts"]["samples"] > 0 for r in rays["rows"])


@pytest.mark.slow
def test_render_and_skipping_suites(tmp_path: Path, demo_capture: Path) -> None:
    from monopart.toolkit.avatar import Avatar
    from monopart.toolkit.captures import read_capture
    from monopart.toolkit.checkpoint import save_weights
    from monopart.toolkit.presets import preset, with_overrides
    from monopart.toolkit.runs import create_run

    out = tmp_path / "bench"
    record = read_capture(demo_capture)
    config = with_overrides(preset("tiny"), field={"log2_size": 8, "prior_slope": 0.0})
    run = create_run(tmp_path / "run", config, record)
    save_weights(Avatar.create(record, config).model, run)
    data = _run("render", out, str(run))
    rows = {r["method"]: r for r in data["tables"][0]["rows"]}
    assert rows["exact skipping"]["error"] < 1e-4
    assert 0 < rows["exact skipping"]["facts"]["rays %"] <= 100
    untrained = _run("skipping", out, str(demo_capture), "--only", "shares")["tables"][0]["rows"]
    assert {r["method"] for r in untrained} == {"exact skipping", "learned occupancy, 0.002"}
    assert all(r["error"] < 1e-4 for r in untrained)
    data = _run("skipping", out, str(run))
    (left,) = data["tables"][0]["rows"][:1]
    facts = left["facts"]
    assert left["error"] < 1e-4
    assert facts["reach a network %"] <= facts["within a part's radius %"]
    assert facts["within a part's radius %"] <= facts["in shell voxels %"] <= facts["in the box %"]
    steps = {r["method"]: r for r in data["tables"][1]["rows"]}
    every = next(r for name, r in steps.items() if name.startswith("nothing skipped"))
    assert steps["exact skipping only"]["error"] < 1e-4
    assert steps["exact skipping only"]["facts"]["pairs"] < every["facts"]["pairs"]


def test_absent_peers_name_their_install_line() -> None:
    ghost = Method("ghost", lambda data: data, ("no_such_module_xyz",), "pip install ghost")
    broken = Method("broken", lambda data: _raise(), install="pip install broken")
    ours = Method("ours", lambda data: lambda: data, ours=True)
    operation = Operation(
        *("id", "Identity", "none", (ghost, broken, ours)),
        lambda settings: [Problem(3, "a", 3.0), Problem(4, "a", 4.0)],
        lambda data, result: {"error": abs(data - result), "twice": 2.0 * data},
    )
    table = suite.run_operation(operation, Settings(quick=True))
    reasons = {a.method: a.reason for a in table.absent}
    assert reasons["ghost"] == "not installed; pip install ghost"
    assert "wrong version" in reasons["broken"]
    assert "pip install broken" in reasons["broken"]
    assert [r.method for r in table.rows] == ["ours", "ours"]
    assert table.rows[0].wall.count == 1
    assert table.rows[1].facts == {"twice": 8.0}


def _raise() -> None:
    raise ImportError("wrong version")


def test_our_own_errors_are_not_hidden() -> None:
    def fail() -> None:
        raise ValueError("a bug of ours")

    operation = Operation(
        *("id", "Identity", "none", (Method("ours", lambda data: fail, ours=True),)),
        lambda settings: [Problem(3, "a", 3.0)],
        lambda data, result: {},
    )
    with pytest.raises(ValueError, match="a bug of ours"):
        suite.run_operation(operation, Settings(quick=True))


def test_slow_methods_run_once_and_rare_ones_seldom() -> None:
    calls: list[str] = []

    def method(name: str, single: bool = False, rare: bool = False) -> Method:
        ours = name == "ours"
        return Method(
            name, lambda data: lambda: calls.append(name), ours=ours, single=single, rare=rare
        )

    methods = (
        method("ours"),
        method("single", single=True),
        method("rare", rare=True),
    )
    effort = Effort(rounds=2, least=2)
    problems = [Problem(1, name, 0.0, effort, name == "a") for name in ("a", "b", "c")]
    operation = Operation(
        *("id", "Identity", "none", methods), lambda settings: problems, lambda data, result: {}
    )
    table = suite.run_operation(operation, Settings())
    assert calls.count("single") == 3
    assert calls.count("rare") == 3  # one problem, a first run and two rounds
    counts = {r.method: r.wall.count for r in table.rows}
    assert counts == {"ours": 2, "single": 1, "rare": 2}
    few = {s.method: (s.problems, s.of) for s in results.summarise(table)}
    assert few == {"ours": (3, 3), "single": (3, 3), "rare": (1, 3)}
    assert "| **ours** |" in markdown(results.Report("x", False, suite.environment(), [table]))
    said = {s.method: cells(s)[-1] for s in results.summarise(table)}
    assert said == {"ours": "", "single": "", "rare": "on 1 of 3 problems"}


def test_open3d_needs_nothing_to_draw_with() -> None:
    if importlib.util.find_spec("open3d") is None:
        pytest.skip("Open3D is not installed")
    before = {name for name in ("dash", "plotly", "plotly.graph_objects") if name in sys.modules}
    assert load_open3d().core.Tensor([1.0]).shape[0] == 1
    if importlib.util.find_spec("dash") is None:
        assert "dash" not in sys.modules
    assert before <= set(sys.modules)


def test_measure_takes_turns() -> None:
    order: list[str] = []
    calls = {name: lambda name=name: order.append(name) for name in "abc"}
    timings, _ = measure(calls, Effort(rounds=3, least=3))
    assert order == list("abc" + "abc" + "bca" + "cab")
    assert timings["a"].wall.count == 3


def test_spread_against_numpy() -> None:
    values = np.random.default_rng(0).random(11).tolist()
    got = spread(values)
    q1, median, q3 = np.quantile(values, [0.25, 0.5, 0.75])
    assert got.median == pytest.approx(median)
    assert (got.q1, got.q3) == pytest.approx((q1, q3))
    assert got.min == min(values)


def test_compare_pairs_rows_by_problem(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = _report(1.0), _report(2.0)
    for name, report in (("a", a), ("b", b)):
        results.write_report(report, tmp_path / f"{name}.json")
    (change,) = compare.changes(a, b)
    assert change.ratio == pytest.approx(2.0)
    assert change.clear
    assert main(["compare", str(tmp_path / "a.json"), str(tmp_path / "b.json")]) is None
    assert "2.00*" in capsys.readouterr().out
    assert main(["show", str(tmp_path / "a.json"), "--markdown"]) is None
    assert "| 5 | **m** |" in capsys.readouterr().out


def _report(seconds: float) -> results.Report:
    one = spread([seconds])
    row = results.Row("m", True, 5, "s", one, one, 1e-7, {})
    table = results.Table("o", "O", "m", [row], [], [])
    return results.Report("geometry", True, suite.environment(), [table])


def test_bad_reports_and_names_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "x.json"
    path.write_text('{"schema": 99}')
    for arguments in (
        ["compare", str(path), str(path)],
        ["compare", str(tmp_path / "none.json"), str(path)],
        ["fields", "--quick", "--only", "nothing", "--out", str(tmp_path)],
    ):
        assert main(arguments) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1
    with pytest.raises(InputError, match="schema"):
        results.read_report(path)


def test_poses_grow_from_rest_to_contorted() -> None:
    body = BodyModel.default()
    poses = pose_list(body)
    size = [float(pose.pose.abs().max()) for _, pose in poses]
    assert len(poses) == 20
    assert size[0] == 0.0
    assert size[-1] > 1.5
    again = pose_list(body)[-1][1].pose
    assert torch.equal(again, poses[-1][1].pose)


def test_near_points_lie_near() -> None:
    body = BodyModel.default()
    data = surface_data(body, pose_list(body, 3)[1][1], 64)
    assert data.distance.max() <= 0.03 + 1e-6
    assert data.distance.max() > 0.02
    points = near_points(data.verts, body.faces, 64, seed=0)
    assert torch.equal(points, data.points)


def test_judge_sees_a_wrong_face() -> None:
    body = BodyModel.default()
    data = surface_data(body, pose_list(body, 3)[1][1], 16)
    bary = np.tile([1.0, 0.0, 0.0], (16, 1))
    assert judge_surface(data, (np.zeros(16, np.int64), bary))["error"] > 1e-2


def test_plain_skinning_is_the_body() -> None:
    body = BodyModel.default().to(torch.zeros(1, dtype=torch.float64))
    pose, betas = pose_list(body, 3)[2][1].pose.double()[None], torch.randn(1, 10).double()
    posed = body(BodyPose(pose, betas, torch.zeros(1, 3).double(), torch.zeros(1, 3).double()))
    plain = plain_skinning(pose, betas, plain_arrays(body), body.tree.parents)
    assert torch.allclose(plain, posed.verts, atol=1e-7)


def test_subdivided_body_keeps_its_surface() -> None:
    body = BodyModel.default()
    fine = subdivided(body)
    assert fine.faces.shape[0] == 4 * body.faces.shape[0]
    pose = pose_list(body, 3)[1][1]
    assert torch.allclose(fine(pose).verts[: body.num_verts], body(pose).verts, atol=1e-5)

    def area(b: BodyModel) -> torch.Tensor:
        a, c, d = b.v_template[b.faces].unbind(1)
        return 0.5 * torch.linalg.cross(c - a, d - a).norm(dim=-1).sum()

    assert area(fine) == pytest.approx(float(area(body)), rel=1e-4)
    assert fine.uv is not None
    assert fine.uv.corner_uv.shape[0] == len(fine.faces)


def test_pareto_front_drops_beaten_points() -> None:
    points = [(1.0, 3.0), (2.0, 2.0), (2.5, 2.0), (3.0, 1.0), (4.0, 5.0)]
    assert pareto_front(points) == [(1.0, 3.0), (2.0, 2.0), (3.0, 1.0)]
    assert not math.isnan(sum(y for _, y in pareto_front(points)))


def test_plots_mark_the_front() -> None:
    series = [Dots("fast", [1.0], [1.0]), Dots("exact", [9.0], [0.1]), Dots("beaten", [9.0], [2.0])]
    drawn = ElementTree.fromstring(log_plot(series, "t", "s", "m", front=True))
    texts = {e.text: e.get("class") for e in drawn.iter() if e.tag.endswith("text")}
    assert (texts["fast"], texts["exact"], texts["beaten"]) == ("on", "on", None)
    assert "Pareto front" in texts
    border = next(e for e in drawn.iter() if e.tag.endswith("polyline")).get("points") or ""
    assert len(border.split()) == 6  # level and down, twice, and an end on either side


def test_exponents_over_all_and_at_the_end() -> None:
    rows = [
        results.Row("m", True, n, "", spread([t]), spread([t]), None, {})
        for n, t in ((1, 1.0), (2, 1.0), (4, 2.0))
    ]
    (line,) = exponents(results.Table("o", "O", "none", rows, [], []))
    assert line == "m: time ~ size^0.50 from 1 to 4, size^1.00 in the last step"
    assert not exponents(results.Table("o", "O", "none", rows[:1], [], []))
