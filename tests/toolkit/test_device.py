"""Training and rendering on a device: all they need is there, and the host seldom waits."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from miniature import write_miniature
from pretend_cuda import DEVICE, HOST, Pretending, pretend_cuda

from monopart.geometry.errors import InputError
from monopart.toolkit import cli
from monopart.toolkit.animate import as_uint8, turntable_views
from monopart.toolkit.avatar import Avatar, view_of
from monopart.toolkit.captures import read_capture
from monopart.toolkit.device import pick_device
from monopart.toolkit.evaluate import evaluate_split
from monopart.toolkit.explain import why_empty
from monopart.toolkit.presets import preset, with_overrides
from monopart.toolkit.render import Picture, render_view
from monopart.toolkit.resume import load_state
from monopart.toolkit.train import Trainer

STEPS = 3
CONFIG = with_overrides(
    preset("fast"),
    train={"iterations": STEPS, "rays": 256, "patch": 16, "lpips_start": 0.0},
    field={"log2_size": 10, "levels": 4, "hidden": 16},
)
WAITS_OF_A_STEP = {
    "geometry.culling.sample tolist": 1,  # how many samples the rays have
    "geometry.posed_parts.pairs nonzero": 1,  # how many pairs of samples and parts
    "geometry.parts.rows_of_parts tolist": 4,  # rows of the parts: pairs, kept, winners, round trip
    "toolkit.model._kept nonzero": 1,  # how many pairs are worth evaluating
    "fields.part_union.union_by_density mask": 1,  # how many win
    "toolkit.train.step tolist": 1,  # the losses
    "toolkit.guard.gradients_are_finite __bool__": 1,  # a step that is not finite is left out
}
"""Sizes that the next kernels need, losses and gradients: all the waits of a training step."""


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_miniature(tmp_path_factory.mktemp("captures") / "mini", size=48)


@pytest.fixture(params=["pretend", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    if request.param == "cuda":
        yield torch.device("cuda", 0)
    else:
        with pretend_cuda():
            yield DEVICE


def trainer_on(device: torch.device, capture: Path, run: Path | None = None) -> Trainer:
    torch.manual_seed(0)
    trainer = Trainer(Avatar.create(read_capture(capture).to(device), CONFIG), run)
    trainer.warm_up()
    return trainer


def picture_of(avatar: Avatar) -> Picture:
    return render_view(avatar, view_of(avatar.record, 0, 0), prune=1e-3, coarse=2, half=False)


def test_a_training_gives_the_same_on_both_devices(device: torch.device, capture: Path) -> None:
    results = []
    for where in (HOST, device):
        trainer = trainer_on(where, capture)
        losses = [trainer.step(step, step / STEPS) for step in range(STEPS)]
        trainer.finish()
        tensors = [*trainer.avatar.model.parameters(), *trainer.avatar.model.buffers()]
        assert {t.device for t in (*tensors, *trainer.average)} == {where}
        picture = picture_of(trainer.avatar)
        assert picture.color.device == where
        results.append((losses, picture.color.cpu()))
    (wanted, color), (found, there) = results
    for want, got in zip(wanted, found, strict=True):
        assert {"mse", "consistency"} <= want.keys()
        assert got == pytest.approx(want, rel=1e-2)
    assert float(color.max()) > 0.1, "an empty picture proves nothing"
    assert float((there - color).abs().mean()) < 2e-3


def test_results_on_a_device_reach_files_and_scores(
    device: torch.device, capture: Path, tmp_path: Path
) -> None:
    trainer = trainer_on(device, capture, tmp_path)
    trainer.step(0, 0.0)
    trainer.checkpoint()
    again = trainer_on(device, capture)
    load_state(again, tmp_path)
    for new, old in zip(again.average, trainer.average, strict=True):
        assert new.device == device and torch.equal(new.cpu(), old.cpu())
    again.step(1, 0.5)
    avatar = again.avatar
    view = turntable_views(avatar, 2, size=32)[1]
    picture = render_view(avatar, view)
    why_empty(avatar, view, picture)
    assert as_uint8(picture.color).shape == (*view.camera.size, 3)
    scores = evaluate_split(avatar, "novel_view", None, pairs=[(1, 0)])
    assert scores.images[0].rendered.device == HOST


def waits_of(mode: Pretending, work) -> dict[str, int]:
    mode.waits.clear()
    work()
    return dict(mode.waits)


def test_the_host_waits_for_sizes_and_losses_only(capture: Path) -> None:
    with pretend_cuda() as mode:
        trainer = trainer_on(DEVICE, capture)
        trainer.step(1, 0.0)
        assert waits_of(mode, lambda: trainer.step(3, 0.1)) == WAITS_OF_A_STEP


@pytest.mark.parametrize("name", ["cuda:99", "gpu", "cuda:x", "auto:1", "", "CPU"])
def test_a_device_that_is_not_there_is_refused(name: str) -> None:
    with pytest.raises(InputError, match=r"--device.*expected.*found"):
        pick_device(name)


def test_devices_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert pick_device("cpu") == pick_device("auto") == HOST
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert pick_device("auto") == pick_device("cuda") == torch.device("cuda", 0)
    assert pick_device("cuda:1") == torch.device("cuda", 1)


def test_a_missing_gpu_ends_the_program_before_the_work(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert cli.main(["train", str(capture), "--out", str(out), "--device", "cuda:99"]) == 2
    assert "--device cuda:99: expected a GPU" in capsys.readouterr().err
    assert not out.exists()
