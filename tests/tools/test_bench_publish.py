"""Reports are written into a page in place, with their plots beside it; axes of geometry run."""

import dataclasses
from pathlib import Path

import pytest
import torch

from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.errors import InputError
from monopart.tools.bench import results
from monopart.tools.bench.cli import main
from monopart.tools.bench.publish import publish, section
from monopart.tools.bench.scaling_geometry import with_joints
from monopart.tools.bench.suite import environment
from monopart.tools.bench.timing import spread
from monopart.tools.bench.training import Mark, curve_rows, time_rows


def _report(folder: Path, suite: str = "geometry", quick: bool = False) -> Path:
    rows = [
        results.Row(name, name == "monopart", size, "", spread([s]), spread([s]), 1e-6 * s, {})
        for size in (10, 100)
        for name, s in (("monopart", 0.1 * size), ("peer", 0.3 * size))
    ]
    table = results.Table("surface", "Closest surface", "m", rows, [], ["a note"])
    path = folder / f"{suite}.json"
    results.write_report(results.Report(suite, quick, environment(), [table]), path)
    return path


def test_a_page_keeps_what_is_outside_the_marks(tmp_path: Path) -> None:
    page = tmp_path / "bench.md"
    page.write_text("# top\n<!-- geometry: begin -->\nold\n<!-- geometry: end -->\nbottom\n")
    path = _report(tmp_path)
    assert publish([path], page) == ["geometry"]
    once = page.read_text()
    assert once.startswith("# top\n") and once.endswith("\nbottom\n") and "old" not in once
    assert "Size 100." in once and "3.00" in once and "- a note" in once
    assert "| median by size | 10 | 100 |" in once and "| **monopart** | 1 s | 10 s |" in once
    for name in ("geometry_surface_pareto.svg", "geometry_surface_growth.svg", "geometry.json"):
        assert (tmp_path / "bench" / name).is_file()
    assert "(bench/geometry_surface_growth.svg)" in once
    assert main(["publish", str(path), "--into", str(page)]) is None
    assert page.read_text() == once
    path.unlink()
    assert main(["publish", "--into", str(page)]) is None  # from what the page holds
    assert page.read_text() == once


def test_training_is_a_line_per_preset(tmp_path: Path) -> None:
    runs = [[Mark(0.5, 5, 2.0, 4.0, 20.0), Mark(1.0, 9, 4.0, 8.0, p)] for p in (24.0, 30.0)]
    rows, never = time_rows("fast", runs)
    tables = [
        results.Table("curve", "Curve", "m", curve_rows("fast", runs), [], ["a note"]),
        results.Table("time_to", "Seconds to a PSNR", "m", rows, never, []),
    ]
    report = results.Report("training_a", False, environment(), tables)
    text = section(report, "training_a", "bench")
    assert "| preset | 20 | 23 | 25 | 26.6 | 28 | 29 | 29.5 |" in text
    assert "| fast | 4 (2) | 6 (3) | 6 (3), 1 of 2 seeds |" in text
    assert "(bench/training_a_curve_cpu.svg)" in text and "- a note" in text
    assert "steps" not in text and "Absent" not in text


def test_growth_is_one_table(tmp_path: Path) -> None:
    table = results.read_report(_report(tmp_path)).tables[0]
    grown = dataclasses.replace(table, error="none")
    text = section(results.Report("scaling", False, environment(), [grown]), "scaling", "bench")
    assert "| median by size | 10 | 100 |" in text
    assert "× ours" not in text


def test_what_cannot_be_published_is_named(tmp_path: Path) -> None:
    page = tmp_path / "bench.md"
    with pytest.raises(InputError, match=r"bench.md: expected a Markdown page"):
        publish([_report(tmp_path)], page)
    page.write_text("no marks")
    with pytest.raises(InputError, match="expected reports, found none"):
        publish([], page)
    with pytest.raises(InputError, match="expected the marks"):
        publish([_report(tmp_path)], page)
    with pytest.raises(InputError, match="--quick"):
        publish([_report(tmp_path, quick=True)], page)
    assert page.read_text() == "no marks"


def test_more_joints_move_the_same() -> None:
    body = BodyModel.default()
    grown = with_joints(body, 60)
    assert grown.num_joints == 60
    assert torch.allclose(grown.weights.sum(1), torch.ones(body.num_verts), atol=1e-5)
    pose = 0.2 * torch.randn(24, 3, generator=torch.Generator().manual_seed(0))
    still, betas = torch.zeros(3), torch.zeros(body.num_betas)
    plain = body(BodyPose(pose, betas, still, still)).verts
    full = torch.cat([pose, torch.zeros(36, 3)])
    assert torch.allclose(grown(BodyPose(full, betas, still, still)).verts, plain, atol=1e-5)
    few = with_joints(body, 12)
    assert few.num_joints == 12
    assert torch.allclose(few.weights.sum(1), torch.ones(body.num_verts), atol=1e-5)
    straight = torch.cat([pose[:12], torch.zeros(12, 3)])
    plain = body(BodyPose(straight, betas, still, still)).verts
    assert torch.allclose(few(BodyPose(pose[:12], betas, still, still)).verts, plain, atol=1e-5)


@pytest.mark.slow
def test_geometry_axes_run(tmp_path: Path) -> None:
    only = ("scaling_points", "scaling_faces", "scaling_joints", "scaling_bodies", "scaling_cores")
    arguments = [word for name in only for word in ("--only", name)]
    assert main(["scaling", *arguments, "--quick", "--out", str(tmp_path)]) is None
    report = results.read_report(tmp_path / "scaling.json")
    assert [t.operation for t in report.tables] == list(only)
    assert all(t.rows for t in report.tables)
    assert dataclasses.asdict(report)["quick"] is True
