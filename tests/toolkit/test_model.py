"""The avatar model: exact skipping, gradients everywhere, determinism."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from miniature import write_miniature

from monopart.geometry.errors import InputError, MonopartError
from monopart.toolkit.avatar import Avatar, view_of
from monopart.toolkit.captures import read_capture
from monopart.toolkit.checkpoint import load_weights, save_weights
from monopart.toolkit.config import Config
from monopart.toolkit.optimizer import make_optimizer
from monopart.toolkit.presets import preset, with_overrides
from monopart.toolkit.render import render_view
from monopart.toolkit.train import Trainer


def small(**sections: dict) -> Config:
    sections.setdefault("loss", {"lpips": 0.0})
    train = {"iterations": 4, "rays": 256, "log_every": 1} | sections.pop("train", {})
    field = {"log2_size": 10, "levels": 4, "hidden": 16} | sections.pop("field", {})
    return with_overrides(preset("fast"), train=train, field=field, **sections)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_miniature(tmp_path_factory.mktemp("captures") / "mini", size=48)


def make(capture: Path, config: Config) -> Avatar:
    torch.manual_seed(config.seed)
    return Avatar.create(read_capture(capture), config)


@pytest.fixture(scope="module")
def trained(capture: Path) -> Avatar:
    avatar = make(capture, small())
    Trainer(avatar).loop()
    return avatar


def test_skipping_does_not_change_the_image(trained: Avatar) -> None:
    view = view_of(trained.record, 0, 0)
    fast, dense = render_view(trained, view), render_view(trained, view, skip=False)
    assert float(fast.opacity.max()) > 0.5, "an empty picture proves nothing"
    assert float((fast.color - dense.color).abs().max()) <= 1e-4
    assert float((fast.opacity - dense.opacity).abs().max()) <= 1e-4
    assert float((fast.depth - dense.depth).abs().max()) <= 1e-3  # the actor is 3 m away
    assert 2.0 < float(fast.depth[fast.opacity > 0.99].mean()) < 4.0
    assert fast.stats["rays"] < dense.stats["rays"]
    assert fast.stats["samples_shell"] < dense.stats["samples_shell"]
    assert fast.stats["pairs_found"] <= dense.stats["pairs_found"]


def test_learned_pruning_changes_the_image_little_and_evaluates_less(capture: Path) -> None:
    avatar = make(capture, small(train={"iterations": 20}))
    Trainer(avatar).loop()
    view = view_of(avatar.record, 0, 0)
    exact, pruned = render_view(avatar, view), render_view(avatar, view, prune=1e-3)
    assert pruned.stats["pairs_evaluated"] < exact.stats["pairs_evaluated"]
    assert float((exact.color - pruned.color).abs().mean()) < 2e-3


def test_coarse_to_fine_changes_the_image_little_and_evaluates_less(trained: Avatar) -> None:
    view = view_of(trained.record, 0, 0)
    exact = render_view(trained, view)
    assert torch.equal(render_view(trained, view, coarse=1).color, exact.color)
    for factor in (2, 4):
        found = render_view(trained, view, coarse=factor)
        assert found.stats["samples_evaluated"] < exact.stats["samples_evaluated"]
        assert float((exact.color - found.color).abs().max()) < 2e-2
        assert float((exact.color - found.color).abs().mean()) < 1e-3
    with pytest.raises(InputError, match="coarse"):
        render_view(trained, view, coarse=2, skip=False)
    with pytest.raises(InputError, match="coarse"):
        render_view(trained, view, coarse=0)


def test_half_networks_change_the_image_little_and_leave_the_model(trained: Avatar) -> None:
    view = view_of(trained.record, 0, 0)
    exact, found = render_view(trained, view), render_view(trained, view, half=True)
    largest = float((exact.color - found.color).abs().max())
    assert 0 < largest < 2e-2
    assert torch.equal(render_view(trained, view).color, exact.color)


def test_the_untrained_avatar_is_already_a_person(capture: Path) -> None:
    avatar = make(capture, small())
    mask = avatar.record.mask(0, 0)
    opacity = render_view(avatar, view_of(avatar.record, 0, 0)).opacity > 0.5
    union, both = (opacity | mask).sum(), (opacity & mask).sum()
    assert float(both / union) > 0.6


def test_every_parameter_gets_a_finite_non_zero_gradient(capture: Path) -> None:
    spec = {"consistency_threshold": 0.0, "offset": 0.01, "lpips": 0.0}
    avatar = make(capture, small(loss=spec, train={"random_background": False}))
    trainer = Trainer(avatar)
    largest = dict.fromkeys(dict(avatar.model.named_parameters()), 0.0)
    for step in range(6):
        trainer.step(step, 0.0)
        for name, value in avatar.model.named_parameters():
            assert value.grad is not None, name
            assert bool(value.grad.isfinite().all()), name
            largest[name] = max(largest[name], float(value.grad.abs().max()))
    assert all(v > 0 for v in largest.values()), largest


def test_terms_of_weight_zero_have_no_network(capture: Path) -> None:
    model = make(capture, small(loss={"lpips": 0.0, "consistency": 0.0})).model
    assert model.forward_residual is None
    assert make(capture, small(deform={"residual": False})).model.backward_residual is None
    assert make(capture, small(appearance={"code": 0})).model.codes is None


def test_forward_makes_no_modules(trained: Avatar) -> None:
    before = {id(m) for m in trained.model.modules()}
    render_view(trained, view_of(trained.record, 0, 0))
    assert {id(m) for m in trained.model.modules()} == before


def test_training_lowers_the_loss_and_repeats_bit_for_bit(capture: Path) -> None:
    runs = []
    for _ in range(2):
        avatar = make(capture, small(train={"iterations": 30, "ema": 0.0}))
        trainer = Trainer(avatar)
        first = trainer.step(0, 0.0)["mse"]
        trainer.loop()
        assert trainer.last["mse"] < first
        runs.append({k: v.clone() for k, v in avatar.model.state_dict().items()})
    assert all(torch.equal(runs[0][k], runs[1][k]) for k in runs[0])


def test_save_load_render_is_bitwise_equal(trained: Avatar, tmp_path: Path) -> None:
    save_weights(trained.model, tmp_path)
    again = Avatar.create(trained.record, trained.config)
    load_weights(again.model, tmp_path)
    view = view_of(trained.record, 1, 1)
    assert torch.equal(render_view(trained, view).color, render_view(again, view).color)


def test_a_camera_that_sees_nothing_gives_background(trained: Avatar) -> None:
    view = view_of(trained.record, 0, 0)
    pose = type(view.pose)(
        view.pose.pose, view.pose.betas, view.pose.rotation, view.pose.translation + 50.0
    )
    picture = render_view(trained, type(view)(view.camera, pose, None), background=0.25)
    assert bool((picture.color == 0.25).all())
    assert picture.stats["rays"] == 0


@pytest.mark.parametrize("parts", ["single", "three", "six", "per_limb"])
def test_other_part_tables_train(capture: Path, parts: str) -> None:
    avatar = make(capture, small(geometry={"parts": parts}, train={"iterations": 2}))
    result = Trainer(avatar).loop()
    assert result.iterations == 2
    assert bool(render_view(avatar, view_of(avatar.record, 0, 0)).color.isfinite().all())


def test_the_sparse_optimizer_learns_and_keeps_the_gradient_buffers(capture: Path) -> None:
    first = {}
    for sparse in (False, True):
        avatar = make(capture, small(train={"sparse_optimizer": sparse, "ema": 0.0}))
        trainer = Trainer(avatar)
        trainer.warm_up()
        trainer.step(0, 0.0)
        first[sparse] = {k: v.detach().clone() for k, v in avatar.model.named_parameters()}
    for name, value in first[False].items():  # in the first step no row has missed one
        torch.testing.assert_close(value, first[True][name], rtol=1e-4, atol=1e-4)
    table = avatar.model.field.grid.table
    place = table.grad.data_ptr()
    before = trainer.last["mse"]
    for step in range(1, 10):
        trainer.step(step, 0.0)
    assert trainer.last["mse"] < before
    assert table.grad.data_ptr() == place
    assert not table.grad.any()


def test_warming_up_changes_nothing(capture: Path) -> None:
    avatar = make(capture, small())
    trainer = Trainer(avatar)
    before = {k: v.clone() for k, v in avatar.model.state_dict().items()}
    state = trainer.generator.get_state()
    trainer.warm_up()
    assert all(torch.equal(v, before[k]) for k, v in avatar.model.state_dict().items())
    assert torch.equal(trainer.generator.get_state(), state)
    assert all(p.grad is None for p in avatar.model.parameters())


def test_a_loss_that_is_not_finite_is_skipped_and_named(
    capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    avatar = make(capture, small(deform={"residual": False}))
    trainer = Trainer(avatar)
    nan = torch.tensor(float("nan"), requires_grad=True)
    monkeypatch.setattr("monopart.toolkit.objective.color_loss", lambda *_: nan * 1.0)
    before = {k: v.clone() for k, v in avatar.model.named_parameters()}
    trainer.step(0, 0.0)
    assert all(torch.equal(v, before[k]) for k, v in avatar.model.named_parameters())
    assert any("mse" in w for w in trainer.result.warnings)
    with pytest.raises(MonopartError, match="mse"):
        for step in range(1, 60):
            trainer.step(step, 0.0)


def test_the_optimiser_is_adam_of_torch(capture: Path) -> None:
    config = small(field={"prior_slope": 0.0})
    ours, theirs = make(capture, config).model, make(capture, config).model
    mine = make_optimizer(ours, config)
    groups = [
        {"params": [dict(theirs.named_parameters())[n] for n in names], "lr": 1e-3}
        for names in (
            [n for n, _ in ours.named_parameters() if n.endswith("grid.table")],
            [n for n, _ in ours.named_parameters() if not n.endswith("grid.table")],
        )
    ]
    reference = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15, fused=True)
    for step in range(4):
        for a, b in zip(ours.parameters(), theirs.parameters(), strict=True):
            a.grad = torch.randn(a.shape)
            b.grad = a.grad.clone()
        if step == 2:
            mine.load_state_dict(mine.state_dict())
        mine.step()
        reference.step()
        assert all(
            torch.equal(a, b) for a, b in zip(ours.parameters(), theirs.parameters(), strict=True)
        )
    mine.zero_grad(set_to_none=True)
    assert all(p.grad is None for p in ours.parameters())


def test_training_does_not_import_torch_compile(capture: Path) -> None:
    """It takes over a second, at every start, and nothing here uses it."""
    code = (
        "import sys, pathlib, dataclasses, torch\n"
        "torch.set_num_threads(1)\n"
        "from monopart.toolkit.avatar import Avatar\n"
        "from monopart.toolkit.captures import read_capture\n"
        "from monopart.toolkit.presets import preset, with_overrides\n"
        "from monopart.toolkit.train import Trainer\n"
        "config = with_overrides(preset('fast'), train={'iterations': 2, 'rays': 32},"
        " field={'prior_slope': 0.0, 'log2_size': 8})\n"
        "Trainer(Avatar.create(read_capture(pathlib.Path(sys.argv[1])), config)).loop()\n"
        "assert 'torch._dynamo' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code, str(capture)], check=True)


def test_voxels_are_those_of_the_configuration(capture: Path) -> None:
    avatar = make(capture, small(geometry={"voxel": 0.04}, field={"prior_slope": 0.0}))
    assert avatar.scene((0, 1)).parts.shell.voxel == 0.04
    assert avatar.pose_scene(avatar.record.poses[0]).parts.shell.voxel == 0.04
