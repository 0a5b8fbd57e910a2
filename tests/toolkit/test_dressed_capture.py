"""The pictures of the capture that presets are chosen on."""

import dataclasses
from pathlib import Path

import numpy as np
from dressed_capture import Dressed

from monopart.geometry.parts import PartMap
from monopart.toolkit.captures import read_capture
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
