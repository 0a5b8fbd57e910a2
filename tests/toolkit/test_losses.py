"""The terms of the objective against what they say."""

from pathlib import Path

import pytest
import torch
from torch import Tensor
from training import TINY

from monopart.geometry.skinning import blend_transforms, skin, unskin
from monopart.geometry.surface import SurfaceIndex
from monopart.toolkit.avatar import Avatar
from monopart.toolkit.captures import read_capture
from monopart.toolkit.losses import color_loss, offset_loss, round_trip_distance
from monopart.toolkit.model import Rendered
from monopart.toolkit.overrides import overridden
from monopart.toolkit.presets import preset
from monopart.toolkit.train import Trainer


@pytest.fixture(scope="module")
def trainer(small_capture: Path) -> Trainer:
    torch.manual_seed(0)
    config = overridden(preset("tiny"), (*TINY, "loss.lpips=0"))
    return Trainer(Avatar.create(read_capture(small_capture), config))


@pytest.fixture(scope="module")
def rendered(trainer: Trainer) -> Rendered:
    with torch.no_grad():
        return trainer.losses(0, 0.0)[1]


def wanted_distance(trainer: Trainer, out: Rendered, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Equation 3 with zero residuals, part by part and body by body, and where it has a value."""
    avatar, pairs = trainer.avatar, out.shaded.pairs
    body, canonical = avatar.record.body, avatar.canonical
    part_of_face = avatar.model.parts.face_parts(body.weights, body.faces)
    sample, part, points = pairs.sample[rows], pairs.part[rows], out.shaded.canonical[rows]
    owner = out.samples.body[sample]
    posed = torch.full_like(points, torch.nan)
    for k in part.unique().tolist():
        faces = body.faces[part_of_face == k]
        hit = SurfaceIndex(canonical.verts, faces, "torch").query(points[part == k], 0.2)
        # the weights are looked up again, at the canonical point
        weights = (hit.bary[..., None] * body.weights[faces[hit.face]]).sum(1)
        rest, valid = unskin(points[part == k], blend_transforms(canonical.transforms, weights))
        assert bool(valid.all())
        for b in owner.unique().tolist():
            there = skin(rest, blend_transforms(trainer.scene.posed.transforms[b], weights))
            posed[(part == k) & (owner == b)] = there[owner[part == k] == b]
    gap = (out.samples.points[sample] - posed).norm(dim=-1)
    return gap, gap.isfinite()


def test_the_round_trip_looks_its_weights_up_again(trainer: Trainer, rendered: Rendered) -> None:
    count = len(rendered.shaded.pairs.sample)
    rows = torch.randperm(count, generator=torch.Generator().manual_seed(0))[:150].sort()[0]
    inputs = trainer.avatar.training_input()
    bodies = (trainer.scene.parts, trainer.objective.canonical)
    found = round_trip_distance(trainer.avatar.model, *bodies, inputs, rendered, rows).detach()
    expected, known = wanted_distance(trainer, rendered, rows)
    assert bool(known.all())
    # where two faces of the rest surface tie, either has the right weights
    assert float(((found - expected).abs() < 1e-5).double().mean()) >= 0.97
    # with the weights of the way back the two maps would cancel
    assert float(found.max()) > 1e-3


def test_a_perfect_picture_costs_nothing_over_any_background(
    trainer: Trainer, rendered: Rendered, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert trainer.config.train.random_background
    for wrong in (False, True):

        def perfect(batch: object, step: int, wrong: bool = wrong) -> Rendered:
            opacity = batch.mask.float() if not wrong else 1 - batch.mask.float()
            return Rendered(
                color=batch.color,
                opacity=opacity,
                depth=opacity,
                stats={},
                samples=rendered.samples,
                shaded=rendered.shaded,
            )

        monkeypatch.setattr(trainer, "_render", perfect)
        mse = float(trainer.losses(1, 0.0)[0]["mse"])
        assert (mse > 1e-3) if wrong else (mse == 0.0)


def test_small_terms() -> None:
    color, target = torch.rand(7, 3), torch.rand(7, 3)
    assert float(color_loss(color, target)) == pytest.approx(float(((color - target) ** 2).mean()))
    residual = torch.tensor([[3e-3, 0.0, 4e-3], [0.0, 0.0, 0.0]], requires_grad=True)
    loss = offset_loss(residual)
    assert float(loss.detach()) == pytest.approx((26e-6**0.5 + 1e-3) / 2, rel=1e-3)
    loss.backward()
    assert residual.grad is not None and bool(residual.grad.isfinite().all())
    assert float(offset_loss(torch.zeros(0, 3))) == 0.0
