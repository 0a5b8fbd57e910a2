"""Trainings with spoilt input: no NaN, an end, and a word on what is wrong."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "toolkit"))
from miniature import write_miniature

from monopart.tools.bench import cli
from monopart.tools.bench.stability_training import (
    BEGIN,
    CASES,
    END,
    Setting,
    run_case,
    setting_of,
    table,
)

SMALL = {
    "field": {"levels": 3, "log2_size": 9, "hidden": 16},
    "deform": {"hidden": 16, "log2_size": 8},
    "train": {"rays": 128, "patch": 16},
    "loss": {"lpips": 0.0},
}


@pytest.fixture(scope="module")
def setting(tmp_path_factory: pytest.TempPathFactory) -> Setting:
    return setting_of(write_miniature(tmp_path_factory.mktemp("captures") / "mini"), SMALL)


@pytest.mark.parametrize("case", CASES)
def test_a_training_survives_and_says_why(case: str, setting: Setting) -> None:
    rows = [run_case(case, seed, setting, 12) for seed in (0, 1)]
    for row in rows:
        assert row.finite and not row.error and row.steps == 12 and row.skipped == 0
        assert row.told, f"{case}: the warnings do not say what is wrong"
    assert case in table(rows)


def test_a_sound_capture_raises_no_doubts(setting: Setting) -> None:
    from monopart.toolkit.captures.doubts import picture_doubts

    assert picture_doubts(setting.record, setting.pictures, 16) == []


def test_the_page_needs_its_marks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "page.md"
    page.write_text("# nothing")
    assert cli.main(["stability-training", str(tmp_path), "--into", str(page)]) == 2
    err = capsys.readouterr().err
    assert BEGIN in err and END in err and page.read_text() == "# nothing"
