"""What the presets promise, and what their switches do to the model."""

import dataclasses
from pathlib import Path

import pytest
import torch
from training import TINY

from monopart.toolkit.avatar import Avatar, view_of
from monopart.toolkit.captures import read_capture
from monopart.toolkit.config import Config, DeformConfig
from monopart.toolkit.optimizer import make_optimizer
from monopart.toolkit.overrides import overridden
from monopart.toolkit.presets import preset, preset_doubts, preset_names, with_overrides
from monopart.toolkit.render import render_view
from monopart.toolkit.step_inputs import step_inputs
from monopart.toolkit.train import Trainer


def small(config: Config, *settings: str) -> Config:
    short = ("field.levels=2", "field.log2_size=8", "field.hidden=16", "deform.hidden=16")
    few = ("deform.log2_size=8", "train.patch=48", "train.checkpoint_seconds=1000")
    return overridden(config, (*short, *few, "loss.lpips=0", *settings))


def make(capture: Path, config: Config) -> Trainer:
    torch.manual_seed(0)
    return Trainer(Avatar.create(read_capture(capture), config))


def test_the_first_preset_is_the_default_of_everything() -> None:
    assert preset_names()[0] == "fast" and preset("fast") == Config()


@pytest.mark.parametrize("name", preset_names())
def test_learning_rates_far_above_the_presets_are_doubted(name: str) -> None:
    config = preset(name)
    assert preset_doubts(config) == []
    rates = {"lr_table": 10 * config.train.lr_table, "lr_network": 4.9 * config.train.lr_network}
    (doubt,) = preset_doubts(with_overrides(config, train=rates))
    assert doubt.startswith("train.lr_table is ") and f"10 times that of preset {name}" in doubt
    other = dataclasses.replace(config, preset="of another version")
    assert preset_doubts(dataclasses.replace(other, train=Config().train)) == []


@pytest.mark.parametrize("name", ["paper", "code"])
def test_the_published_presets_have_no_accelerators(name: str) -> None:
    config = preset(name)
    loss, train = config.loss, config.train
    assert (loss.mse, loss.lpips, loss.consistency) == (1.0, 1.0, 1.0)
    assert loss.consistency_threshold == 0.05
    assert train.lr_table == train.lr_network == 5e-4 and train.lr_final == 1.0
    assert train.iterations == 3000 and train.seconds is None
    assert (train.rays, train.patch, train.lpips_every, train.lpips_start) == (0, 64, 1, 0.0)
    assert config.field.prior_slope == 0.0 and train.ema == 0.0 and not train.occupancy
    neutral = DeformConfig()
    assert config.deform.residual and config.deform.input == "uvt"
    assert config.deform.scale == 0.05 and config.deform.log2_size == 14
    assert dataclasses.replace(config.deform, lr=neutral.lr) == dataclasses.replace(
        neutral, lr=neutral.lr, **PUBLISHED
    )


PUBLISHED = {"time_jitter": 0.0, "time_span": 1.0}


def test_the_paper_has_no_term_beyond_its_three_and_the_code_has() -> None:
    paper, code = preset("paper"), preset("code")
    assert not (paper.loss.l1 or paper.loss.offset or paper.loss.distortion or paper.loss.elastic)
    assert paper.field.use_step and not paper.train.scales and not paper.train.head_focus
    assert code.loss.offset and code.loss.distortion and code.loss.elastic
    assert not code.field.use_step and code.train.scales == (0.3, 0.5, 0.5)


def test_the_baselines_differ_from_the_default_by_their_model_alone() -> None:
    fast = preset("fast")
    for name in ("instant_nvr", "single_part"):
        config = preset(name)
        assert config.train == fast.train, "equal training"
        assert config.field.prior_slope == fast.field.prior_slope, "equal start"
        assert config.loss.consistency == 0.0 and config.deform.residual
    assert preset("instant_nvr").deform.input == "uvt"
    single = preset("single_part")
    assert single.geometry.parts == "single" and single.deform.input == "xyzt"


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_takes_a_step(small_capture: Path, name: str) -> None:
    # at 24 pixels the person is thinner than the band at the edge of the mask
    trainer = make(small_capture, small(preset(name), "train.ignore_band=0"))
    numbers = trainer.step(1, 0.5)
    warnings = [w for w in trainer.result.warnings if "The person turns by" not in w]
    assert numbers["mse"] > 0 and not warnings
    out = trainer.avatar.model.backward_residual
    assert (out is None) == (name == "rigid")
    forward = trainer.avatar.model.forward_residual
    assert (forward is None) == (name in ("rigid", "instant_nvr", "single_part"))


def test_adam_has_the_epsilon_of_the_paper(small_capture: Path) -> None:
    config = small(preset("paper"))
    model = make(small_capture, config).avatar.model
    groups = make_optimizer(model, config).param_groups
    assert all(group["eps"] == 1e-15 and group["base_lr"] == 5e-4 for group in groups)


def test_residuals_in_space_and_time_train_and_reach_every_parameter(small_capture: Path) -> None:
    settings = (
        "deform.input=xyzt",
        "loss.consistency_threshold=0",
        "train.random_background=false",
    )
    trainer = make(small_capture, overridden(preset("fast"), (*TINY, "loss.lpips=0", *settings)))
    model = trainer.avatar.model
    assert model.backward_residual is not None and model.backward_residual.axes == 4
    assert model.forward_residual is not None and model.forward_residual.axes == 4
    seen = {name: 0.0 for name, _ in model.named_parameters()}
    for step in range(4):
        trainer.step(step, 0.0)
        for name, value in model.named_parameters():
            assert value.grad is not None and bool(value.grad.isfinite().all()), name
            seen[name] = max(seen[name], float(value.grad.abs().max()))
    assert all(v > 0 for n, v in seen.items() if "residual" in n), seen
    places = trainer._render(trainer.sampler.random(64, torch.Generator()), 0).shaded.place
    assert places is not None and places.shape[1] == 4
    assert float(places.min()) >= 0.0 and float(places.max()) <= 1.0


def test_without_the_step_a_density_is_an_opacity(small_capture: Path) -> None:
    bare = overridden(preset("fast"), (*TINY, "loss.lpips=0", "loss.consistency=0"))
    pictures = []
    for settings in (("field.sharpness=100",), ("field.sharpness=1.25", "field.use_step=false")):
        trainer = make(small_capture, overridden(bare, settings))
        trainer.avatar.model.eval()
        view = view_of(trainer.avatar.record, 0, 0)
        pictures += [render_view(trainer.avatar, view, skip=s).color for s in (True, False)]
    # 100 / m over steps of 0.0125 m is 1.25 a sample
    assert float(pictures[0].max()) > 0.05
    for other in pictures[1:]:
        torch.testing.assert_close(other, pictures[0], atol=2e-4, rtol=0)


def test_the_residuals_have_a_rate_of_their_own(small_capture: Path) -> None:
    config = small(preset("fast"), "deform.lr=0.5", "train.lr_table=0.04")
    model = make(small_capture, config).avatar.model
    names = {id(p): name for name, p in model.named_parameters()}
    rates = {
        names[id(p)]: group["base_lr"]
        for group in make_optimizer(model, config).param_groups
        for p in group["params"]
    }
    assert rates.keys() == dict(model.named_parameters()).keys()
    for name, rate in rates.items():
        full = 0.04 if name.endswith("grid.table") else config.train.lr_network
        assert rate == full * (0.5 if "residual" in name else 1.0), name


def test_residuals_begin_when_they_are_told_to(small_capture: Path) -> None:
    assert preset("best").deform.start > 0 == preset("full").deform.start
    trainer = make(small_capture, small(preset("fast"), "deform.start=0.5"))
    model, field = trainer.avatar.model, trainer.avatar.model.backward_residual
    assert field is not None and trainer.objective.round_trips is None
    first = [p.detach().clone() for p in field.parameters()]

    def moved() -> bool:
        return any(not torch.equal(a, b) for a, b in zip(field.parameters(), first, strict=True))

    numbers = trainer.step(0, 0.4)
    assert "consistency" not in numbers and field.grid.table.grad is None
    assert not moved() and trainer.objective.round_trips is None
    numbers = trainer.step(1, 0.5)
    assert "consistency" in numbers and moved()
    for done in (0.5, 0.51, 0.52, 0.9):
        trainer._record_round_trips(done)
    assert len(trainer.result.round_trips) == 2, "the histograms cover the part with residuals"
    trainer.step(2, 0.0)
    trainer.finish()
    assert not model.rigid, "what is rendered has them"


def test_times_get_noise_in_training_only(small_capture: Path) -> None:
    trainer = make(small_capture, small(preset("fast"), "deform.time_jitter=2"))
    exact = trainer.avatar.training_input().time
    found = torch.stack(
        [step_inputs(trainer.avatar, trainer.generator).time - exact for _ in range(400)]
    )
    assert float(found.std()) == pytest.approx(2 / (len(exact) - 1), rel=0.1)
    record = trainer.avatar.record
    given = trainer.avatar.frame_input(record.split("train").frames[1], record.poses[1])
    assert torch.equal(given.time, exact[1:2])
    still = make(small_capture, small(preset("fast"), "deform.time_jitter=0"))
    assert torch.equal(step_inputs(still.avatar, still.generator).time, exact)


def test_a_short_span_of_time_is_smoother(small_capture: Path) -> None:
    model = make(small_capture, small(preset("fast"), "deform.time_span=0.25")).avatar.model
    points, uv, part = torch.rand(3, 3), torch.rand(3, 2), torch.tensor([0, 1, 2])
    place = model.residual_place(points, uv, part, torch.tensor([0.0, 0.5, 1.0]))
    torch.testing.assert_close(place, torch.cat([uv, torch.tensor([[0.0], [0.125], [0.25]])], -1))
