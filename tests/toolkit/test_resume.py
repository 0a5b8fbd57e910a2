"""A training that dies goes on where it was, bit for bit."""

import json
from pathlib import Path

import pytest
import torch
from miniature import write_miniature

from monopart.geometry.errors import InputError
from monopart.toolkit.avatar import Avatar
from monopart.toolkit.captures import read_capture
from monopart.toolkit.cli import main
from monopart.toolkit.presets import preset, with_overrides
from monopart.toolkit.resume import STATE, load_state, save_state
from monopart.toolkit.runs import create_run
from monopart.toolkit.train import Trainer

SMALL = with_overrides(
    preset("fast"),
    loss={"lpips": 0.0},
    train={"iterations": 8, "rays": 128, "log_every": 1},
    field={"log2_size": 9, "levels": 3, "hidden": 16},
    deform={"log2_size": 8, "hidden": 16},
)


def trainer(capture: Path, run: Path, sparse: bool = False) -> Trainer:
    run.mkdir(exist_ok=True)
    torch.manual_seed(0)
    config = with_overrides(SMALL, train={"sparse_optimizer": sparse})
    return Trainer(Avatar.create(read_capture(capture), config), run)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_miniature(tmp_path_factory.mktemp("captures") / "mini", size=32)


class _Died(Exception):
    pass


@pytest.mark.parametrize("sparse", [False, True])
def test_a_resumed_run_equals_an_unbroken_one(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sparse: bool
) -> None:
    whole = trainer(capture, tmp_path / "whole", sparse)
    whole.loop()

    broken = trainer(capture, tmp_path / "broken", sparse)
    step = broken.step

    def dying(number: int, done: float) -> dict[str, float]:
        if number == 5:
            raise _Died
        if number == 4:
            broken.checkpoint()  # then one more step, which is lost
        return step(number, done)

    monkeypatch.setattr(broken, "step", dying)
    with pytest.raises(_Died):
        broken.loop()

    again = trainer(capture, tmp_path / "broken", sparse)
    load_state(again, tmp_path / "broken")
    assert again.result.iterations == 4
    again.loop()
    expected, found = whole.avatar.model.state_dict(), again.avatar.model.state_dict()
    assert all(torch.equal(expected[k], found[k]) for k in expected)
    lines = (tmp_path / "broken" / "train.jsonl").read_text().splitlines()
    assert [json.loads(line)["iteration"] for line in lines] == list(range(1, 9))
    assert not (tmp_path / "broken" / STATE).exists(), "a finished run has no state"
    assert again.result.stats["rays"] == whole.result.stats["rays"]


def test_states_that_do_not_fit_are_refused(capture: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    first = trainer(capture, run)
    with pytest.raises(InputError, match="no file"):
        load_state(first, run)
    first.step(0, 0.0)
    save_state(first, run)
    whole = (run / STATE).read_bytes()
    (run / STATE).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="difference"):
        load_state(trainer(capture, run), run)
    (run / STATE).write_bytes(whole)
    other = with_overrides(SMALL, field={"hidden": 8})
    wrong = Trainer(Avatar.create(read_capture(capture), other), run)
    with pytest.raises(InputError, match="difference"):
        load_state(wrong, run)
    with pytest.raises(InputError, match="difference"):
        load_state(trainer(capture, run, sparse=True), run)


def test_resume_on_the_command_line(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    asked = ["train", str(capture), "--out", str(run), "--resume"]
    assert main(asked) == 2
    assert "unfinished run" in capsys.readouterr().err
    assert not run.exists()

    record = read_capture(capture)
    create_run(run, SMALL, record)
    torch.manual_seed(SMALL.seed)
    begun = Trainer(Avatar.create(record, SMALL), run)
    for step in range(5):
        begun.step(step, step / 8)
        begun.result.iterations = step + 1
    begun.checkpoint()
    facts = (run / "capture.json").read_text()
    (run / "capture.json").write_text(json.dumps(json.loads(facts) | {"uv": "0" * 64}))
    assert main(asked) == 2
    assert "other texture coordinates" in capsys.readouterr().err
    (run / "capture.json").write_text(facts)
    assert main([*asked, "--images", "1"]) is None
    assert "going on from step 5" in capsys.readouterr().err
    lines = (run / "train.jsonl").read_text().splitlines()
    assert [json.loads(line)["iteration"] for line in lines] == [6, 7, 8]
    assert (run / "report.html").is_file()
