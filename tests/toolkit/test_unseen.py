"""Residuals of places that no picture shows: where they are drawn, and what their weight does."""

import dataclasses
from pathlib import Path

import pytest
import torch
from miniature import write_miniature

from monopart.fields.residual import ResidualField
from monopart.geometry.parts import rows_of_parts
from monopart.toolkit.avatar import Avatar
from monopart.toolkit.captures import read_capture
from monopart.toolkit.losses import SMOOTH
from monopart.toolkit.presets import preset, with_overrides
from monopart.toolkit.train import Trainer
from monopart.toolkit.unseen import UnseenResiduals


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_miniature(tmp_path_factory.mktemp("captures") / "mini", size=40)


def make(capture: Path, **loss: float) -> Avatar:
    torch.manual_seed(0)
    config = with_overrides(
        preset("fast"),
        loss={"lpips": 0.0, "consistency": 0.0} | loss,
        train={"iterations": 20, "rays": 128},
        field={"log2_size": 9, "levels": 3, "hidden": 16},
        deform={"log2_size": 8, "hidden": 16},
    )
    return Avatar.create(read_capture(capture), config)


def test_places_are_even_over_area_and_time(capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    avatar = make(capture, unseen=1.0)
    field, seen = avatar.model.backward_residual, []
    assert field is not None
    forward = ResidualField.forward

    def look(self: ResidualField, place, part, counts):
        seen.append((place, part, counts))
        return forward(self, place, part, counts)

    monkeypatch.setattr(ResidualField, "forward", look)
    parts = avatar.canonical_parts()
    draws = UnseenResiduals(parts, 8000)
    generator = torch.Generator().manual_seed(1)
    draws.loss(avatar.model, generator).backward()
    ((place, part, counts),) = seen
    assert bool((part.diff() >= 0).all()) and rows_of_parts(part, 5) == tuple(counts)
    corners = parts.verts[0][parts.faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = area.norm(dim=-1)
    for k in range(5):
        share = float(area[parts.face_part == k].sum() / area.sum())
        assert counts[k] / 8000 == pytest.approx(share, abs=0.025)
    quarters = torch.histc(place[:, 2], 4, 0.0, 1.0) / 8000
    assert bool(((quarters - 0.25).abs() < 0.025).all())
    low, high = parts.corner_uv.amin((0, 1)), parts.corner_uv.amax((0, 1))
    assert bool(((place[:, :2] >= low - 1e-6) & (place[:, :2] <= high + 1e-6)).all())
    assert field.grid.table.grad is not None and bool(field.grid.table.grad.isfinite().all())


def test_residuals_of_zero_cost_the_floor_alone(capture: Path) -> None:
    avatar = make(capture, unseen=1.0)
    assert avatar.model.backward_residual is not None
    for weights in avatar.model.backward_residual.mlp.parameters():
        torch.nn.init.zeros_(weights)
    loss = UnseenResiduals(avatar.canonical_parts(), 100).loss(avatar.model, torch.Generator())
    assert float(loss.detach()) == pytest.approx(SMOOTH**0.5)


def test_the_weight_shortens_what_is_not_seen(capture: Path) -> None:
    lengths = {}
    for weight in (0.0, 1.0):
        avatar = make(capture, unseen=weight)
        trainer = Trainer(avatar)
        assert (trainer.objective.unseen is None) == (weight == 0.0)
        residual = avatar.model.backward_residual
        assert residual is not None
        with torch.no_grad():  # what other places left behind
            residual.mlp.biases[-1].normal_(0.0, 0.3, generator=torch.Generator().manual_seed(2))
        for step in range(20):
            numbers = trainer.step(step, 0.0)
            assert ("unseen" in numbers) == (weight > 0.0)
        asked = UnseenResiduals(avatar.canonical_parts(), 500)
        length = asked.loss(avatar.model, torch.Generator().manual_seed(3))
        lengths[weight] = float(length.detach())
    assert lengths[1.0] < 0.7 * lengths[0.0]


def test_in_space_and_time_too(capture: Path) -> None:
    avatar = make(capture, unseen=1.0)
    config = with_overrides(avatar.config, deform={"input": "xyzt"})
    torch.manual_seed(0)
    other = Avatar.create(avatar.record, config)
    terms, _ = Trainer(dataclasses.replace(other)).losses(1, 0.0)
    assert bool(terms["unseen"].isfinite())
