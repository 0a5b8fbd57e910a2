"""--profile, --explain and --no-skip: what they measure, and that they change nothing."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from training import TINY

from monopart.geometry.errors import InputError
from monopart.geometry.stages import StageRecorder, stage
from monopart.toolkit import cli
from monopart.toolkit.avatar import Avatar, view_of
from monopart.toolkit.captures import read_capture
from monopart.toolkit.overrides import overridden
from monopart.toolkit.presets import preset
from monopart.toolkit.profile_page import chrome_trace, profile_html
from monopart.toolkit.profiling import profile_training, stage_rows
from monopart.toolkit.render import render_view
from monopart.toolkit.savings import rendering_savings, training_savings
from monopart.toolkit.skipping import EVERY, KINDS, NONE
from monopart.toolkit.train import Trainer


@pytest.fixture(scope="module")
def trainer(small_capture: Path) -> Trainer:
    config = overridden(preset("tiny"), TINY)
    torch.manual_seed(0)
    return Trainer(Avatar.create(read_capture(small_capture), config))


def weights_of(trainer: Trainer) -> list[torch.Tensor]:
    model = trainer.avatar.model
    return [t.detach().clone() for t in (*model.parameters(), *model.buffers())]


def test_a_profile_leaves_the_trainer_as_it_is_and_adds_up(trainer: Trainer) -> None:
    before, state = weights_of(trainer), trainer.generator.get_state()
    profiles = profile_training(trainer, warm_up=2)
    assert all(torch.equal(a, b) for a, b in zip(before, weights_of(trainer), strict=True))
    assert torch.equal(state, trainer.generator.get_state())
    assert sum(p.kind.share for p in profiles) == pytest.approx(1.0)
    rows = {row.name: row for row in stage_rows(profiles)}
    for name in ("part search", "hash encode", "compositing", "backward", "optimiser"):
        assert rows[name].mean_wall > 0, name
    whole = rows["whole step"].mean_wall
    parts = sum(r.mean_wall for n, r in rows.items() if n[0] != " " and n != "whole step")
    assert parts == pytest.approx(whole, rel=0.05)
    trace = json.loads(json.dumps(chrome_trace(profiles)))
    names = {e["name"] for e in trace["traceEvents"]}
    assert {"part search", "backward", "closest_on_parts", "hash_grid_forward"} <= names
    for event in trace["traceEvents"]:
        assert event["ph"] in ("X", "M")
        assert event["ph"] == "M" or event["dur"] >= 0
    page = profile_html(profiles)
    assert "http://" not in page.replace("http://www.w3.org", "") and "https://" not in page


def test_marks_cost_nothing_while_nobody_listens() -> None:
    assert stage("a") is stage("b")
    with StageRecorder() as recorder:
        with stage("outer"), stage("inner"):
            pass
    assert [s.name for s in recorder.spans] == ["inner", "outer"]


@pytest.mark.parametrize("kind", [*KINDS, "all"])
def test_each_kind_of_skipping_leaves_the_picture(trainer: Trainer, kind: str) -> None:
    view = view_of(trainer.avatar.record, 1, trainer.avatar.memory.frames[0])
    full = render_view(trainer.avatar, view)
    other = render_view(trainer.avatar, view, skip=NONE if kind == "all" else EVERY.without([kind]))
    assert (full.color - other.color).abs().max() <= 1e-4
    for count in ("rays_box", "rays", "samples_shell", "samples_evaluated", "pairs_found"):
        assert other.stats[count] >= full.stats[count], count
    assert full.stats["colors_evaluated"] <= full.stats["samples_evaluated"]
    assert full.stats["rays"] <= full.stats["rays_box"] <= full.stats["pixels"]


def test_savings_name_every_kind_and_what_it_changes(trainer: Trainer) -> None:
    view = view_of(trainer.avatar.record, 1, trainer.avatar.memory.frames[0])
    found = {row.kind: row for row in rendering_savings(trainer.avatar, view)}
    assert set(found) == {*KINDS, "forward"}
    assert all(row.seconds > 0 and row.seconds_without > 0 for row in found.values())
    assert all(row.change <= 1e-4 for kind, row in found.items() if kind != "cells")
    before = weights_of(trainer)
    trained = {row.kind for row in training_savings(trainer)}
    assert trained == {"voxels", "parts", "colors", "cells", "all"}
    assert all(torch.equal(a, b) for a, b in zip(before, weights_of(trainer), strict=True))


def test_an_unknown_kind_is_one_line() -> None:
    with pytest.raises(InputError, match=r"--no-skip: expected box, .*found 'boxes'"):
        EVERY.without(["boxes"])
    assert not any(dataclasses.asdict(NONE).values())


def test_the_program_profiles_and_trains_the_same(
    small_capture: Path, trained_run: Path, tmp_path: Path, short_strip: None
) -> None:
    run = tmp_path / "run"
    command = ["train", str(small_capture), "--out", str(run), "--preset", "tiny", "--profile"]
    assert cli.main([*command, "--iterations", "3", "--set", *TINY]) is None
    assert json.loads((run / "profile.json").read_text())["traceEvents"]
    page = (run / "profile.html").read_text()
    assert "part search" in page and "whole step" in page
    same = (run / "model.safetensors").read_bytes()
    assert same == (trained_run / "model.safetensors").read_bytes()


def test_the_program_renders_without_skipping(
    trained_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ["--camera", "1", "--frame", "0"]
    pictures = [tmp_path / "a.png", tmp_path / "b.png"]
    plain = ["render", str(trained_run), *where, "--out"]
    assert cli.main([*plain, str(pictures[0])]) is None
    assert cli.main([*plain, str(pictures[1]), "--no-skip", "shell", "parts", "--explain"]) is None
    assert pictures[0].read_bytes() == pictures[1].read_bytes()
    assert "What skipping saves" in capsys.readouterr().err
    assert cli.main([*plain, str(pictures[1]), "--no-skip", "nothing"]) == 2
    assert "--no-skip" in capsys.readouterr().err
    assert cli.main([*plain, str(pictures[1]), "--no-skip", "light", "--coarse", "2"]) == 2
