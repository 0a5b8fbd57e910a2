"""The pictures of the capture that presets are chosen on."""

import dataclasses
from pathlib import Path

import hidden_half
import numpy as np
import pytest
from dressed_capture import Dressed

from monopart.geometry.parts import PartMap
from monopart.toolkit.captures import patches, read_capture
from monopart.toolkit.part_picture import part_picture


def test_a_dressed_person_covers_the_body_and_stands_in_its_light(small_capture: Path) -> None:
    record = read_capture(small_capture)
    record = dataclasses.replace(record, cameras=[c.resized(4.0) for c in record.cameras])
    person = Dressed(record, 1)
    image, alpha = person.picture(0, 0)
    assert image.shape == (192, 192, 3) and alpha.shape == (192, 192)
    assert 0.0 <= image.min() and image.max() <= 1.0 and np.isfinite(image).all()
    table = PartMap.preset("five", record.body.num_joints)
    naked = part_picture(record.body, record.body(record.poses[0]), record.cameras[0], table) >= 0
    assert (alpha > 0.5)[naked].mean() > 0.9, "the cover lies over the body"
    assert 0.9 * naked.sum() < alpha.sum() < 2.0 * naked.sum()
    inside = alpha > 0.99
    darker = Dressed(record, 1)
    darker.power = darker.power * 0.0  # the sky alone
    sky, same = darker.picture(0, 0)
    assert np.array_equal(alpha, same) and (image - sky)[inside].min() > -1e-6
    assert (image - sky)[inside].max() > 0.1
    moved = np.abs(person.covered(0.5) - person.covered(0.0)).max()
    assert 0.002 < moved < 0.08, "clothes move by millimetres to centimetres"
    other = Dressed(record, 2).picture(0, 0)[0]
    assert np.abs(other - image)[inside].mean() > 0.01, "another seed, another light"


def test_hidden_pixels_look_to_one_side_and_are_learned_from_no_picture(
    small_capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = read_capture(small_capture)
    frames = record.split("train").frames
    monkeypatch.setattr(hidden_half, "TRAIN", frames)
    way = hidden_half.aside(record)
    camera = record.cameras[record.split("train").cameras[0]]
    assert float(way.norm()) == pytest.approx(1.0) and abs(float(way @ camera.R[1])) < 1e-5
    looks = hidden_half.facing(record, frames[0], way)
    verts = record.body(record.poses[frames[0]]).verts_world.detach().reshape(-1, 3)
    pixels, _ = camera.project(verts)
    beside = (verts - verts.mean(0)) @ way
    x, y = pixels.long().unbind(1)
    sides = [looks[y[rows], x[rows]].mean() for rows in (beside > 0.05, beside < -0.05)]
    assert sides[0] - sides[1] > 0.25, "what lies to a side looks there"
    settings = ["loss.lpips=0", "field.prior_slope=0", "train.rays=64", "train.patch=8"]
    avatar = hidden_half.trained(record, settings, 2, 0)
    light = avatar.model.light
    assert light is not None and float(light.eyes.norm()) > 1000
    assert patches.edge_band.__name__ == "edge_band", "put back"
