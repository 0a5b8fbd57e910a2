"""The sections on round trips and on the capacity of the parts, and their figures."""

import json
from pathlib import Path

import torch

from monopart.toolkit.report import ReportData, report_html
from monopart.toolkit.report_training import capacity_section, round_trips_section
from monopart.toolkit.round_trips import EDGES_MM, moment
from monopart.toolkit.runs import read_facts

EMPTY = torch.zeros(0)


def test_nothing_recorded_is_no_section() -> None:
    assert round_trips_section([{"seconds": 1.0, "losses": {}}], []) == ""
    assert capacity_section([]) == ""
    assert 'id="capacity"' not in report_html(ReportData("x"))


def test_the_sections_show_what_was_recorded() -> None:
    rows = [
        {"seconds": s, "round_trip": {"share": 0.25, "median": 1e-3, "p90": m, "p99": None}}
        for s, m in ((1.0, 2e-3), (2.0, 4e-3), (3.0, 5e-3))
    ]
    share = [0.0] * len(EDGES_MM)
    share[3] = 1.0  # 2 to 3 mm
    moments = [{"iteration": 7, "share": 0.25, "histogram": share}]
    page = round_trips_section(rows, moments)
    assert page.count("<svg") == 3 and "step 7: 100" in page and "No drawable value" in page
    part = {"part": "le<ft", "log2_size": 14, "finest": 0.0025, "rows": 300, "radius": 0.08}
    seen = {"part": "head", "rows": 100, "area": 12.0, "detail": 0.5}
    page = capacity_section([part, part | seen])
    assert "le&lt;ft" in page and "75.0 %" in page and "2^14" in page and "0.5000" in page
    data = ReportData("x", curves=rows, round_trips=moments, capacity=[part])
    assert 'id="round_trips"' in report_html(data) and "Finest cell" in report_html(data)


def test_a_run_records_round_trips_and_capacity(trained_run: Path) -> None:
    facts = read_facts(trained_run / "training.json")
    assert [m["iteration"] for m in facts["round_trips"]] == [1, 2, 3, 3]
    assert all(set(m) == set(moment(EMPTY, 0.01, 0)) for m in facts["round_trips"])
    assert all(abs(sum(m["histogram"]) - 1) < 1e-6 for m in facts["round_trips"])
    assert [p["part"] for p in facts["capacity"]][2] == "head" and facts["capacity"][0]["rows"] > 0
    rows = [json.loads(line) for line in (trained_run / "train.jsonl").read_text().splitlines()]
    assert all(0.0 <= row["round_trip"]["share"] <= 1.0 for row in rows)
    page = (trained_run / "report.html").read_text()
    assert 'id="round_trips"' in page and 'id="capacity"' in page
