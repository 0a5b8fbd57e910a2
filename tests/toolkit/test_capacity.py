"""Capacity of the parts from data: what is measured, how it is shared out, what it costs."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from training import TINY

from monopart.geometry.errors import InputError
from monopart.geometry.parts import PartMap
from monopart.toolkit.avatar import Avatar
from monopart.toolkit.capacity import (
    Demand,
    allocate,
    allocated,
    capacity_lines,
    measured,
)
from monopart.toolkit.captures import read_capture
from monopart.toolkit.captures.cache import read_pictures
from monopart.toolkit.config import FieldConfig
from monopart.toolkit.overrides import overridden
from monopart.toolkit.part_picture import part_picture
from monopart.toolkit.presets import preset
from monopart.toolkit.sizes import field_spec
from monopart.toolkit.train import Trainer

EDGES = (0.9, 1.2, 0.5, 0.8, 0.8)


def rows(sizes: tuple[int, ...] | int, cells: tuple[float, ...] | float) -> list[int]:
    spec = dataclasses.replace(field_spec(FieldConfig(), 5), log2_size=sizes, finest=cells)
    return [sum(grid.sizes) for grid in spec.grid_specs(EDGES)]


def test_the_whole_is_never_larger_and_hardly_smaller_than_the_uniform_one() -> None:
    budget = sum(rows(15, 0.003))
    for seed in range(30):
        random = np.random.default_rng(seed)
        area, detail = random.uniform(100, 9000, 5), random.uniform(0.01, 0.08, 5)
        found = sum(rows(*allocate(Demand(tuple(area), tuple(detail)), EDGES, FieldConfig())))
        assert 0.9 * budget < found <= budget


def test_need_decides_who_gets_more() -> None:
    demand = Demand((8000.0, 4000.0, 2000.0, 1000.0, 0.0), (0.05, 0.05, 0.05, 0.05, 0.0))
    sizes, cells = allocate(demand, EDGES, FieldConfig())
    assert list(sizes[:4]) == sorted(sizes[:4], reverse=True) and sizes[0] > sizes[3]
    assert cells[:4] == pytest.approx([0.003] * 4), "equal detail, equal cells"
    assert sizes[4] == 15 - 4 and cells[4] == 0.006
    fine = Demand((1000.0, 1000.0), (0.08, 0.02))
    _, cells = allocate(fine, EDGES[:2], FieldConfig())
    assert cells[0] < 0.003 < cells[1]


def test_nothing_seen_is_the_uniform_allocation() -> None:
    none = Demand((0.0,) * 5, (0.0,) * 5)
    assert allocate(none, EDGES, FieldConfig()) == ((15,) * 5, (0.003,) * 5)
    plain = Demand((500.0,) * 5, (0.0,) * 5)  # seen, but without any texture
    assert allocate(plain, EDGES, FieldConfig()) == ((15,) * 5, (0.003,) * 5)


def test_the_drawn_parts_are_those_at_the_joints(small_capture: Path) -> None:
    record = read_capture(small_capture)
    table = PartMap.preset("five", record.body.num_joints)
    posed = record.body(record.poses[0])
    camera = record.cameras[0].resized(4.0)
    picture = part_picture(record.body, posed, camera, table)
    mask = record.mask(0, 0).numpy()
    drawn = picture[2::4, 2::4] >= 0  # the pixel at the centre of each coarse one
    assert (drawn & mask).sum() > 0.95 * drawn.sum()
    assert drawn.sum() > 0.7 * mask.sum()  # the mask of the miniature is half a coarse pixel wider
    # the nearest vertex of a pixel's ray has the pixel's part
    pixels, depth = camera.project(posed.verts_world)
    vertex_part = table.vertex_parts(record.body.weights)
    front = torch.nonzero(depth < depth.mean() - 0.05).squeeze(-1)[::40]
    agree = [
        int(picture[int(pixels[v, 1]), int(pixels[v, 0])]) == int(vertex_part[v]) for v in front
    ]
    assert len(agree) > 10 and np.mean(agree) > 0.9


def test_areas_add_up_to_the_masks_and_stripes_are_detail(small_capture: Path) -> None:
    record = read_capture(small_capture)
    pictures = read_pictures(record, "train")
    table = PartMap.preset("five", record.body.num_joints)
    plain = measured(record, pictures, table)
    assert sum(plain.area) == pytest.approx(float(pictures.masks.sum()) / len(pictures.masks))
    striped = dataclasses.replace(pictures, images=pictures.images.clone())
    striped.images[:, ::2] = 0
    assert sum(measured(record, striped, table).detail) > 2 * sum(plain.detail)
    assert min(plain.detail) > 0.0, "arms of a few pixels are all outline, and still seen"
    empty = dataclasses.replace(pictures, masks=torch.zeros_like(pictures.masks))
    assert measured(record, empty, table) == Demand((0.0,) * 5, (0.0,) * 5)


def test_the_model_has_the_sizes_of_the_configuration(small_capture: Path) -> None:
    record = read_capture(small_capture)
    config = overridden(preset("fast"), ("field.allocation=data", "field.log2_size=12"))
    filled, parts = allocated(config, record)
    assert len(filled.field.part_log2_size) == len(filled.field.part_finest) == 5
    assert allocated(filled, record)[0] is filled, "what is there already is not measured again"
    avatar = Avatar.create(record, config)
    assert avatar.config == filled
    specs = avatar.model.field.grid.specs
    assert [spec.log2_size for spec in specs] == [part["log2_size"] for part in parts]
    assert [sum(spec.sizes) for spec in specs] == [part["rows"] for part in parts]
    assert len(avatar.model.field.grid.table) == sum(part["rows"] for part in parts)
    assert all("pixels an image" in line for line in capacity_lines(parts))
    same, uniform = allocated(preset("fast"), record)
    assert same == preset("fast") and {part["log2_size"] for part in uniform} == {15}
    with pytest.raises(InputError, match="part_log2_size"):
        field_spec(FieldConfig(part_log2_size=(9, 9)), 5)


def test_a_part_that_is_never_seen_trains_without_nan(
    small_capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def hidden(*_: object) -> Demand:
        return Demand((900.0, 900.0, 0.0, 50.0, 50.0), (0.03, 0.02, 0.0, 0.0, 0.05))

    monkeypatch.setattr("monopart.toolkit.capacity.measured", hidden)
    torch.manual_seed(0)
    config = overridden(preset("tiny"), (*TINY, "loss.lpips=0", "field.allocation=data"))
    avatar = Avatar.create(read_capture(small_capture), config)
    assert avatar.config.field.part_log2_size[2] == 4
    trainer = Trainer(avatar)
    for step in range(3):
        trainer.step(step, 0.0)
    assert not [w for w in trainer.result.warnings if "The person turns by" not in w]
    assert all(bool(p.isfinite().all()) for p in avatar.model.parameters())
