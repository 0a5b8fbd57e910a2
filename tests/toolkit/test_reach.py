"""How far the parts reach: what the masks show outside the body decides it."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from training import TINY

from monopart.geometry.errors import InputError
from monopart.geometry.parts import PartMap
from monopart.toolkit.avatar import Avatar
from monopart.toolkit.capacity import allocated, as_asked, capacity_lines
from monopart.toolkit.captures import read_capture
from monopart.toolkit.captures.cache import Pictures
from monopart.toolkit.captures.records import CaptureRecord
from monopart.toolkit.config import GeometryConfig
from monopart.toolkit.overrides import overridden
from monopart.toolkit.part_picture import nearest_part, part_picture
from monopart.toolkit.presets import preset
from monopart.toolkit.reach import measured_reach
from monopart.toolkit.sizes import part_radii
from monopart.toolkit.train import Trainer

LEGS, HEAD = 1, 2


def grown(record: CaptureRecord, table: PartMap, part: int | None, metres: float) -> Pictures:
    """The silhouettes of the naked body in all frames, one part of them wider by a length."""
    masks = []
    for camera, frame in record.split("train").pairs():
        view = record.cameras[camera]
        posed = record.body(record.poses[frame])
        drawn = part_picture(record.body, posed, view, table)
        mask = drawn >= 0
        if part is not None:
            own = table.vertex_parts(record.body.weights) == part
            depth = float(view.project(posed.verts_world)[1][own].mean())
            edge = 2 * round(metres * float(view.K[0, 0]) / depth) + 1
            disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (edge, edge))
            mask |= cv2.dilate((drawn == part).astype(np.uint8), disc) > 0
        masks.append(torch.from_numpy(mask))
    seen = torch.stack(masks)
    return Pictures(torch.zeros(*seen.shape, 3, dtype=torch.uint8), seen)


@pytest.fixture(scope="module")
def record(small_capture: Path) -> CaptureRecord:
    """The cameras see 384 pixels: at 48, one pixel is 5 cm of the body."""
    record = read_capture(small_capture)
    return dataclasses.replace(record, cameras=[c.resized(8.0) for c in record.cameras])


@pytest.mark.parametrize("metres", [0.15, 0.25])
def test_what_stands_out_from_a_part_is_reached(record: CaptureRecord, metres: float) -> None:
    table = PartMap.preset("five", record.body.num_joints)
    found = measured_reach(record, grown(record, table, HEAD, metres), table, 0.1)
    assert found[HEAD] == pytest.approx(min(metres + 0.005, 0.2), abs=0.015)  # two pixels
    assert found[LEGS] == 0.1, "far from the head"
    assert measured_reach(record, grown(record, table, None, 0.0), table, 0.1) == (0.1,) * 5


def test_stray_islands_and_empty_masks_give_no_reach(record: CaptureRecord) -> None:
    table = PartMap.preset("five", record.body.num_joints)
    pictures = grown(record, table, None, 0.0)
    pictures.masks[:, 0, 0] = True  # more than twice the radius away
    assert measured_reach(record, pictures, table, 0.05) == (0.05,) * 5
    empty = dataclasses.replace(pictures, masks=torch.zeros_like(pictures.masks))
    assert measured_reach(record, empty, table, 0.05) == (0.05,) * 5


def test_the_nearest_part_is_that_of_the_nearest_pixel() -> None:
    random = np.random.default_rng(0)
    picture = np.full((13, 17), -1, np.int32)
    rows, cols = random.integers(0, 13, 6), random.integers(0, 17, 6)
    picture[rows, cols] = np.arange(6)
    part, pixels = nearest_part(picture)
    for y in range(13):
        for x in range(17):
            far = np.hypot(rows - y, cols - x)
            own = np.hypot(rows[part[y, x]] - y, cols[part[y, x]] - x)
            assert own <= 1.05 * far.min() + 0.1  # OpenCV's distances are chamfers
            assert pixels[y, x] == pytest.approx(own, rel=0.05, abs=0.1)
    none, far = nearest_part(np.full((2, 3), -1, np.int32))
    assert (none == -1).all() and np.isinf(far).all()


def test_a_run_keeps_the_radii_that_were_measured(record: CaptureRecord) -> None:
    config = overridden(preset("fast"), ("geometry.reach=masks", *TINY))
    table = PartMap.preset("five", record.body.num_joints)
    filled, rows = allocated(config, record, grown(record, table, HEAD, 0.09))
    radii = filled.geometry.part_radius
    assert len(radii) == 5 and radii[HEAD] > 0.06
    assert [row["radius"] for row in rows] == list(radii)
    assert f"reaches {1e3 * radii[HEAD]:.0f} mm" in capacity_lines(rows)[HEAD]
    assert allocated(filled, record)[0] is filled, "what is there already is not measured again"
    assert as_asked(filled, config) == config and as_asked(filled, filled) == filled
    sizes = overridden(config, ("field.part_log2_size=8,8,8,8,8",))
    measured = dataclasses.replace(sizes, geometry=filled.geometry)
    assert as_asked(measured, sizes) == sizes, "capacities that are named keep no radii"
    avatar = Avatar.create(read_capture(record.root), filled)
    assert avatar.scene((0,)).parts.radius.tolist() == pytest.approx(list(radii))
    plain = Avatar.create(avatar.record, dataclasses.replace(filled, geometry=GeometryConfig()))
    wider = (avatar.model.field.edge - plain.model.field.edge)[HEAD]
    assert float(wider) == pytest.approx(2 * (radii[HEAD] - 0.06), abs=1e-6)
    trainer = Trainer(avatar)
    numbers = trainer.step(0, 0.0)
    assert all(np.isfinite(value) for value in numbers.values())


def test_radii_of_another_number_of_parts_are_refused() -> None:
    assert part_radii(GeometryConfig(radius=0.07), 3) == (0.07,) * 3
    with pytest.raises(InputError, match="part_radius"):
        part_radii(GeometryConfig(part_radius=(0.1, 0.1)), 3)
