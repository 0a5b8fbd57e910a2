"""Each term of the objective against slow float64, its switch, and what it costs on nothing."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from training import TINY

from monopart.geometry.errors import InputError
from monopart.toolkit.avatar import Avatar, view_of
from monopart.toolkit.captures import read_capture
from monopart.toolkit.config import LossConfig
from monopart.toolkit.losses import (
    absolute_loss,
    color_loss,
    distortion_loss,
    elastic_loss,
    offset_loss,
)
from monopart.toolkit.objective import Seen, late_growth, seen_batch, some_rows
from monopart.toolkit.overrides import overridden
from monopart.toolkit.presets import preset
from monopart.toolkit.render import render_view
from monopart.toolkit.round_trips import EDGES_MM, figures, histogram
from monopart.toolkit.train import Trainer


def make(capture: Path, *settings: str) -> Trainer:
    torch.manual_seed(0)
    config = overridden(preset("tiny"), (*TINY, "loss.lpips=0", *settings))
    return Trainer(Avatar.create(read_capture(capture), config))


def slow_distortion(weights: list[float], depth: list[float], starts: list[int], step: float):
    total = 0.0
    for first, end in itertools.pairwise(starts):
        for i in range(first, end):
            total += weights[i] ** 2 * step / 3
            for j in range(first, end):
                total += weights[i] * weights[j] * abs(depth[i] - depth[j])
    return total / (len(starts) - 1)


@pytest.mark.parametrize("starts", [[0, 4, 4, 9, 10], [0, 10], [0, 0, 10]])
def test_the_distortion_is_the_double_sum(starts: list[int]) -> None:
    weights = torch.rand(10, dtype=torch.float64)
    depth = torch.rand(10, dtype=torch.float64).sort()[0] + 3.0
    found = distortion_loss(weights, depth, torch.tensor(starts), 0.0125)
    expected = slow_distortion(weights.tolist(), depth.tolist(), starts, 0.0125)
    assert float(found) == pytest.approx(expected, rel=1e-12)
    assert expected > 0.01
    single = distortion_loss(weights.float(), depth.float(), torch.tensor(starts), 0.0125)
    assert float(single) == pytest.approx(expected, rel=1e-5)


def test_the_distortion_of_a_large_batch_keeps_its_digits() -> None:
    weights, starts = torch.rand(60_000) / 30, torch.arange(0, 60_001, 30)
    depth = (3.0 + 0.01 * torch.arange(30.0)).repeat(2000)
    few = distortion_loss(weights[-300:], depth[-300:], starts[:11], 0.01)
    first = distortion_loss(weights[:-300], depth[:-300], starts[:-10], 0.01)
    whole = distortion_loss(weights, depth, starts, 0.01)
    assert float(whole) == pytest.approx((1990 * float(first) + 10 * float(few)) / 2000, rel=1e-5)


def test_the_distortion_has_the_gradient_of_differences() -> None:
    weights = torch.rand(7, dtype=torch.float64, requires_grad=True)
    depth, starts = torch.arange(7.0, dtype=torch.float64), torch.tensor([0, 3, 3, 7])
    assert torch.autograd.gradcheck(lambda w: distortion_loss(w, depth, starts, 0.1), weights)


def test_small_terms_are_what_they_say() -> None:
    a, b = torch.rand(2, 9, 3, dtype=torch.float64)
    rows = list(zip(a.tolist(), b.tolist(), strict=True))
    apart = [abs(x - y) for p, q in rows for x, y in zip(p, q, strict=True)]
    assert float(absolute_loss(a, b)) == pytest.approx(np.mean(apart))
    assert float(color_loss(a, b)) == pytest.approx(np.mean(np.square(apart)))
    lengths = [sum((x - y) ** 2 for x, y in zip(p, q, strict=True)) for p, q in rows]
    expected = np.mean([(s + 1e-6) ** 0.5 for s in lengths])
    assert float(elastic_loss(a, b)) == pytest.approx(expected)


TERMS = {
    "mse": lambda x: color_loss(x, x.detach()),
    "l1": lambda x: absolute_loss(x, x.detach()),
    "offset": offset_loss,
    "elastic": lambda x: elastic_loss(x, x.detach()),
    "distortion": lambda x: distortion_loss(x[:, 0], x[:, 1], torch.zeros(3).long(), 0.1),
}


EMPTY_AND_ZERO = [(name, rows) for name in TERMS for rows in (0, 1)]
EMPTY_AND_ZERO.remove(("distortion", 1))  # its two rays have no samples


@pytest.mark.parametrize(("name", "rows"), EMPTY_AND_ZERO)
def test_nothing_costs_nothing_and_zeros_have_finite_gradients(name: str, rows: int) -> None:
    values = torch.zeros(rows, 3, requires_grad=True)
    loss = TERMS[name](values)
    if not rows:
        assert float(loss.detach()) == 0.0
    loss.backward()
    assert values.grad is not None and bool(values.grad.isfinite().all())


FLAGS = ("l1", "offset", "distortion", "elastic", "consistency")


@pytest.mark.parametrize("flag", FLAGS)
def test_a_term_is_computed_where_its_weight_asks_for_it(
    small_capture: Path, monkeypatch: pytest.MonkeyPatch, flag: str
) -> None:
    others = [f"loss.{name}=0" for name in FLAGS if name != flag]
    trainer = make(small_capture, *others, f"loss.{flag}=0.5")
    trainer.avatar.model.train()
    half = trainer.losses(0, 0.0)[0]
    assert set(half) == {"mse", flag}
    torch.stack(list(half.values())).sum().backward()
    grads = [p.grad for p in trainer.avatar.model.parameters() if p.grad is not None]
    assert grads and all(bool(g.isfinite().all()) for g in grads)
    name = {
        "l1": "absolute_loss",
        "offset": "offset_loss",
        "distortion": "distortion_loss",
        "elastic": "elastic_loss",
        "consistency": "round_trip_distance",
    }[flag]

    def refuse(*_: object) -> Tensor:
        raise AssertionError("computed without a weight")

    monkeypatch.setattr(f"monopart.toolkit.objective.{name}", refuse)
    with pytest.raises(AssertionError, match="without a weight"):
        trainer.losses(0, 0.0)
    bare = make(small_capture, *others, f"loss.{flag}=0")
    assert set(bare.losses(0, 0.0)[0]) == {"mse"}


def test_the_distortion_grows_in_the_last_third(small_capture: Path) -> None:
    assert [late_growth(d) for d in (0.0, 2 / 3, 5 / 6, 1.0, 1.2)] == pytest.approx(
        [1, 1, 5.5, 10, 10]
    )
    trainer = make(small_capture, "loss.distortion=1", "loss.consistency=0")
    found = []
    for done in (0.1, 1.0):
        trainer.generator.manual_seed(0)
        found.append(float(trainer.losses(0, done)[0]["distortion"].detach()))
    assert found[1] == pytest.approx(10 * found[0], rel=1e-5)


def test_colours_have_to_count(small_capture: Path) -> None:
    with pytest.raises(InputError, match=r"loss\.mse"):
        make(small_capture, "loss.mse=0", "loss.l1=0")
    trainer = make(small_capture, "loss.mse=0", "loss.l1=1")
    assert "psnr" not in trainer.step(0, 0.0)


def test_the_forward_deformation_is_for_its_loss_alone(
    small_capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = make(small_capture)
    forward = trainer.avatar.model.forward_residual
    assert forward is not None

    def refuse(*_: object) -> Tensor:
        raise AssertionError("the forward deformation ran")

    monkeypatch.setattr(forward, "forward", refuse)
    with pytest.raises(AssertionError, match="ran"):
        trainer.losses(0, 0.0)
    trainer.avatar.model.eval()
    picture = render_view(trainer.avatar, view_of(trainer.avatar.record, 1, 1))
    assert float(picture.opacity.max()) > 0.1
    without = make(small_capture, "loss.consistency=0")
    assert without.avatar.model.forward_residual is None and without.objective.canonical is None
    assert without.objective.round_trips is None


def test_untrained_round_trips_close_where_skinning_can_be_inverted(small_capture: Path) -> None:
    """With zero residuals the way back is exact where both ways have the same weights."""
    trainer = make(small_capture, f"loss.consistency_samples={1 << 30}")
    with torch.no_grad():
        _, out = trainer.losses(0, 0.0)
    distance, pairs = trainer.objective.round_trips, out.shaded.pairs
    assert distance is not None and len(distance) == len(pairs.sample)
    body = trainer.avatar.record.body
    bary = torch.cat([pairs.bary, 1 - pairs.bary.sum(-1, keepdim=True)], -1)
    here = (bary[..., None] * body.weights[body.faces[pairs.face]]).sum(1)
    assert trainer.objective.canonical is not None
    hit = trainer.objective.canonical.on_part(out.shaded.canonical, pairs.part)
    there = (hit.bary[..., None] * body.weights[body.faces[hit.face]]).sum(1)
    same = (here - there).abs().amax(-1) < 1e-5
    assert 0.05 < float(same.float().mean()) < 1.0
    assert float(distance[same].max()) < 1e-4
    assert float(distance[~same].max()) > 5e-3


def test_the_consistency_acts_early_and_less_later(small_capture: Path) -> None:
    """On a share of the pairs that a loss can live on, and training makes it smaller."""
    # without learned skipping: else early and late steps look at other pairs
    settings = ("train.seconds=none", "train.iterations=60", "train.ema=0")
    trainer = make(small_capture, *settings, "train.occupancy=false")
    assert trainer.config.loss.consistency_threshold == LossConfig().consistency_threshold
    trainer.loop()
    moments = trainer.result.round_trips
    assert moments[0]["iteration"] == 1 and moments[-1]["iteration"] == 60
    assert moments[0]["share"] > 0.01, "the loss acts on nothing"
    assert moments[-1]["p99"] < 0.8 * moments[0]["p99"]
    assert moments[-1]["share"] < 0.6 * moments[0]["share"]


def test_figures_and_histograms_of_round_trips() -> None:
    distance = torch.rand(500, generator=torch.Generator().manual_seed(0)) * 0.12
    values = distance.double().numpy()
    found = figures(distance, 0.03)
    assert found["share"] == pytest.approx((values > 0.03).mean())
    for name, q in (("median", 0.5), ("p90", 0.9), ("p99", 0.99)):
        assert found[name] == pytest.approx(np.quantile(values, q))
    counts, _ = np.histogram(1e3 * values, [*EDGES_MM, np.inf])
    assert histogram(distance) == pytest.approx((counts / 500).tolist())
    assert sum(histogram(distance)) == pytest.approx(1.0)
    assert figures(distance[:0], 0.03) == dict.fromkeys(("share", "median", "p90", "p99"))
    assert histogram(distance[:0]) == [0.0] * len(EDGES_MM)


def test_rows_are_all_or_some() -> None:
    generator = torch.Generator().manual_seed(0)
    assert some_rows(5, 5, generator).tolist() == [0, 1, 2, 3, 4]
    assert some_rows(0, 5, generator).tolist() == []
    few = some_rows(1000, 50, generator)
    assert len(few) == 50 and bool((few.diff() >= 0).all()) and int(few.max()) < 1000


def test_ignored_rows_are_right_and_have_no_gradient() -> None:
    color, target = torch.rand(6, 3, requires_grad=True), torch.rand(6, 3)
    counted = torch.tensor([True, False, True, True, False, True])
    seen = seen_batch(color, target, None, counted)
    assert isinstance(seen, Seen) and seen.counted == (4, 0)
    loss = color_loss(seen.color, seen.target) * 6 / 4
    plain = float((color[counted] - target[counted]).square().mean().detach())
    assert float(loss.detach()) == pytest.approx(plain)
    loss.backward()
    assert color.grad is not None and not bool(color.grad[~counted].any())
    assert bool(color.grad[counted].any(-1).all())
    assert seen_batch(color, target, None, None).counted == (6, 0)


@pytest.mark.parametrize("ignored", [False, True])
def test_pixels_of_a_patch_weigh_less_than_random_ones(ignored: bool) -> None:
    color, target = torch.rand(7 + 6, 3), torch.rand(7 + 6, 3)
    counted = torch.arange(13) % 4 > 0 if ignored else None
    weight = torch.tensor([1.0] * 7 + [0.25] * 6)
    weight = weight if counted is None else weight * counted
    for loss, error in ((color_loss, torch.square), (absolute_loss, torch.abs)):
        found = seen_batch(color, target, (2, 3), counted).mean(loss, 0.25)
        wanted = (error(color - target).mean(-1) * weight).sum() / weight.sum()
        assert float(found) == pytest.approx(float(wanted), rel=1e-5)
    alone = seen_batch(color[7:], target[7:], (2, 3), None)
    assert float(alone.mean(color_loss, 0.25)) == pytest.approx(
        float(color_loss(color[7:], target[7:]))
    ), "a patch alone weighs as it is"
    nothing = seen_batch(color, target, (2, 3), torch.zeros(13, dtype=torch.bool))
    assert float(nothing.mean(color_loss, 0.25)) == 0.0
