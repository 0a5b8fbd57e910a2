"""Steps that are not finite: skipped, counted, named, kept as a file that repeats them."""

import json
import math
from pathlib import Path

import pytest
import torch
from miniature import write_miniature
from safetensors import safe_open
from safetensors.torch import save_file
from training import TINY

from monopart.fields.occupancy import PartOccupancy
from monopart.geometry.errors import InputError, MonopartError
from monopart.toolkit import cli
from monopart.toolkit.avatar import Avatar
from monopart.toolkit.captures import read_capture
from monopart.toolkit.checkpoint import load_weights
from monopart.toolkit.guard import HUGE, gradients_are_finite
from monopart.toolkit.overrides import overridden
from monopart.toolkit.presets import preset
from monopart.toolkit.replay import load_culprit
from monopart.toolkit.train import Trainer


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_miniature(tmp_path_factory.mktemp("captures") / "mini", size=40)


def trainer_of(capture: Path, run: Path | None, *settings: str) -> Trainer:
    torch.manual_seed(0)
    config = overridden(preset("fast"), (*TINY, "loss.lpips=0", *settings))
    if run is not None:
        run.mkdir()
    return Trainer(Avatar.create(read_capture(capture), config), run)


def weights_of(trainer: Trainer) -> dict[str, torch.Tensor]:
    return {k: v.clone() for k, v in trainer.avatar.model.named_parameters()}


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(v.nan_to_num(9.0), b[k].nan_to_num(9.0)) for k, v in a.items())


def poison(trainer: Trainer) -> None:
    """Weights of a head that turn every density of one part into NaN."""
    with torch.no_grad():
        dict(trainer.avatar.model.named_parameters())["field.density_mlp.biases.1"][1] = math.nan


def test_a_step_with_a_bad_loss_is_named_kept_and_repeated(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trainer = trainer_of(capture, tmp_path / "run")
    trainer.step(0, 0.0)
    poison(trainer)
    before = weights_of(trainer)
    trainer.step(1, 0.1)
    assert same(before, weights_of(trainer)) and trainer.result.skipped == 1
    (bad,) = trainer.result.bad_steps
    assert bad["step"] == 1 and "mse" in bad["terms"] and bad["repeated"]
    assert {"density", "rendered colour"} <= set(bad["tensors"])
    assert any(t.startswith("gradient of field.") for t in bad["tensors"])
    record = trainer.avatar.record
    assert bad["frame"] in record.split("train").frames and bad["camera"] in record.camera_names
    x, y = bad["pixel"]
    assert 0 < x < 40 and 0 < y < 40 and x % 1 == 0.5
    json.dumps(bad)
    (warning,) = (w for w in trainer.result.warnings if "The person turns by" not in w)
    assert f"frame {bad['frame']}" in warning and "density" in warning

    file = tmp_path / "run" / bad["file"]
    assert 0 < file.stat().st_size < 4e6
    culprit = load_culprit(file)
    terms, now = culprit.repeat()
    assert math.isnan(terms["mse"])
    assert (now.terms, now.tensors, now.pixel) == (culprit.bad.terms, culprit.bad.tensors, (x, y))
    assert cli.main(["replay", str(file)]) is None
    shown = capsys.readouterr().out
    assert "mse: nan" in shown and f"pixel ({x:g}, {y:g})" in shown


def test_a_gradient_that_is_not_finite_is_found_behind_a_finite_loss(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = trainer_of(capture, tmp_path / "run", "loss.consistency=0")
    trainer.step(0, 0.0)
    before = weights_of(trainer)

    def unsafe(color: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        return ((color - target) * 0.0).square().sum(-1).sqrt().mean()  # slope of a root at 0

    monkeypatch.setattr("monopart.toolkit.objective.color_loss", unsafe)
    trainer.step(1, 0.1)
    assert same(before, weights_of(trainer)) and trainer.result.skipped == 1
    (bad,) = trainer.result.bad_steps
    assert bad["terms"] == ("mse",) and all("gradient" in t for t in bad["tensors"])
    assert bad["frame"] is not None
    monkeypatch.undo()
    _, now = load_culprit(tmp_path / "run" / bad["file"]).repeat()
    assert not now.repeated and not now.terms  # the fault was in the code, and is mended
    trainer.step(2, 0.2)
    assert trainer.result.skipped == 1 and not same(before, weights_of(trainer))


def test_the_stored_step_is_the_step(capture: Path, tmp_path: Path) -> None:
    """Bit for bit: what is repeated is what was computed."""
    trainer = trainer_of(capture, tmp_path / "run")
    trainer.step(0, 0.0)
    state = trainer.generator.get_state()
    poison(trainer)
    trainer.step(1, 0.1)
    file = tmp_path / "run" / trainer.result.bad_steps[0]["file"]
    again, _ = load_culprit(file).repeat()
    trainer.generator.set_state(state)
    trainer.avatar.model.train()
    terms, _ = trainer.losses(1, 0.1)
    assert set(again) == set(terms) and math.isnan(again["mse"])
    for name, value in terms.items():
        assert again[name] == float(value.detach()) or math.isnan(again[name])


def test_of_the_pose_bank_only_the_key_poses_that_are_read_are_stored(tmp_path: Path) -> None:
    capture = write_miniature(tmp_path / "long", frames=13, size=24)  # a pose reads five of 12
    settings = ("train.rays=1", "train.patch=2", "appearance.pose_feature=true")
    trainer = trainer_of(capture, tmp_path / "run", *settings)
    bank = trainer.avatar.model.appearance.bank
    assert bank is not None
    with torch.no_grad():
        bank.lines += 0.1 * torch.randn(bank.lines.shape)  # else all key poses are the same
        bank.lines[2, 1, 0, 0, 0] = math.nan
        dict(trainer.avatar.model.named_parameters())["field.density_mlp.biases.1"][:] = math.nan
    number, state = 0, trainer.generator.get_state()
    while not trainer.result.bad_steps and number < 20:  # until the ray meets the body
        number, state = number + 1, trainer.generator.get_state()
        trainer.step(number, 0.1)
    file = tmp_path / "run" / trainer.result.bad_steps[0]["file"]
    with safe_open(file, framework="pt") as stored:
        rows = stored.get_tensor("rows.appearance.bank.lines")
        kept = stored.get_tensor("model.appearance.bank.lines")
    parts, poses = bank.lines.shape[:2]
    assert 0 < len(rows) == len(kept) < parts * poses and 2 * poses + 1 in rows.tolist()
    assert torch.equal(kept.nan_to_num(9.0), bank.lines.flatten(0, 1)[rows].nan_to_num(9.0))
    culprit = load_culprit(file)
    loaded = culprit.trainer.avatar.model.appearance.bank
    assert loaded is not None
    missing = sorted(set(range(parts * poses)) - set(rows.tolist()))
    assert loaded.lines.flatten(0, 1)[missing].isfinite().all()
    again, _ = culprit.repeat()
    trainer.generator.set_state(state)
    trainer.avatar.model.train()
    terms, _ = trainer.losses(number, 0.1)
    for name, value in terms.items():
        assert again[name] == float(value.detach()) or math.isnan(again[name])


def test_too_many_end_the_run_with_good_weights(capture: Path, tmp_path: Path) -> None:
    trainer = trainer_of(capture, tmp_path / "run", "train.max_skipped=4", "train.iterations=9")
    good = weights_of(trainer)
    real = trainer.losses_of

    def broken(drawn, step, done):
        terms, out = real(drawn, step, done)
        return terms | {"mse": terms["mse"] * math.inf}, out

    trainer.losses_of = broken  # type: ignore[method-assign]
    with pytest.raises(MonopartError, match=r"4 steps.*train.max_skipped.*step 0.*mse.*replay"):
        trainer.loop()
    saved = Avatar.create(trainer.avatar.record, trainer.config).model
    load_weights(saved, tmp_path / "run")
    assert all(torch.equal(v, good[k]) for k, v in saved.named_parameters())
    files = sorted((tmp_path / "run" / "culprits").iterdir())
    assert [f.name for f in files] == [f"step_{i:06d}.safetensors" for i in range(3)]


def test_finite_and_huge() -> None:
    a, b = torch.zeros(3, requires_grad=True), torch.zeros(2, requires_grad=True)
    assert gradients_are_finite([a, b])
    a.grad = torch.tensor([0.0, -3.0, 1e4])
    assert gradients_are_finite([a, b])
    for value in (math.nan, math.inf, -math.inf, 10 * HUGE):
        b.grad = torch.tensor([0.0, value])
        assert not gradients_are_finite([a, b])
    assert gradients_are_finite([])


def test_unknown_densities_are_neither_empty_nor_walls() -> None:
    grid = PartOccupancy(torch.zeros(1, 3), torch.ones(1), cells=4)
    cell = torch.tensor([0, 1, 1])
    grid.see(cell, torch.tensor([math.nan, math.inf, 2.0]))
    assert grid.keep(torch.tensor([0, 1]), 1e6).all() and (grid.floor[:2] == 0).all()
    grid.see(cell, torch.tensor([0.5, 0.5, 0.25]))
    assert grid.peak[:2].tolist() == [0.5, 0.5] and not grid.peak.isnan().any()


def test_files_that_are_no_culprits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], capture: Path
) -> None:
    text, other = tmp_path / "text.safetensors", tmp_path / "other.safetensors"
    text.write_text("no tensors")
    save_file({"x": torch.zeros(2)}, other)
    for file in (tmp_path / "none", text, other, tmp_path):
        with pytest.raises(InputError, match="expected"):
            load_culprit(file)
        assert cli.main(["replay", str(file)]) == 2
        err = capsys.readouterr().err
        assert file.name in err and err.count("\n") == 1
    trainer = trainer_of(capture, tmp_path / "run")
    poison(trainer)
    trainer.step(0, 0.0)
    file = tmp_path / "run" / trainer.result.bad_steps[0]["file"]
    file.write_bytes(file.read_bytes()[:-1000])
    with pytest.raises(InputError, match="step_000000"):
        load_culprit(file)
