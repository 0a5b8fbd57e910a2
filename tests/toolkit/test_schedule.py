"""Resolutions, focus on the head, and the band of pixels that no loss sees."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from training import TINY

from monopart.geometry.errors import InputError
from monopart.geometry.parts import PartMap
from monopart.toolkit.avatar import Avatar
from monopart.toolkit.captures import read_capture
from monopart.toolkit.captures.cache import Pictures
from monopart.toolkit.captures.patches import PixelSampler, edge_band, joined
from monopart.toolkit.overrides import overridden
from monopart.toolkit.presets import preset
from monopart.toolkit.schedule import head_box, head_verts, resized
from monopart.toolkit.train import Trainer


def make(capture: Path, *settings: str) -> Trainer:
    torch.manual_seed(0)
    config = overridden(preset("tiny"), (*TINY, "loss.lpips=0", *settings))
    return Trainer(Avatar.create(read_capture(capture), config))


def disc() -> tuple[torch.Tensor, torch.Tensor]:
    """One image of a grey disc on black, and its mask."""
    mask = np.zeros((60, 80), np.uint8)
    cv2.circle(mask, (40, 30), 17, 1, -1)
    image = np.repeat(mask[..., None] * 120, 3, -1)
    return torch.from_numpy(image)[None], torch.from_numpy(mask.astype(bool))[None]


@pytest.mark.parametrize("width", [1, 2])
def test_the_band_lies_on_both_sides_of_the_edge(width: int) -> None:
    mask = disc()[1][0]
    band = edge_band(mask, width)
    for y, x in torch.nonzero(torch.ones_like(mask))[::7].tolist():
        other = torch.nonzero(mask != mask[y, x])
        near = float((other - torch.tensor([y, x])).square().sum(-1).min()) ** 0.5
        if near <= width:
            assert bool(band[y, x])
        if near > width + 0.5:
            assert not bool(band[y, x])
    assert bool((band & mask).any()) and bool((band & ~mask).any())
    assert not bool(edge_band(torch.ones(5, 5, dtype=torch.bool), width).any()), "no edge inside"


def test_the_band_is_not_drawn_and_does_not_count_in_patches() -> None:
    sampler = PixelSampler(*disc(), band=4, ignore=2)
    band = edge_band(disc()[1][0], 2)
    batch = sampler.random(3000, torch.Generator().manual_seed(0))
    x, y = (batch.pixels - 0.5).long().unbind(-1)
    assert batch.counted is not None and bool(batch.counted.all()) and not bool(band[y, x].any())
    assert bool((~batch.mask).any()), "the outside still counts"
    patch = sampler.patch(50, torch.Generator().manual_seed(0))
    x, y = (patch.pixels - 0.5).long().unbind(-1)
    assert patch.counted is not None and torch.equal(patch.counted, ~band[y, x])
    both = joined(batch, patch)
    assert both.counted is not None and len(both.counted) == len(both.image) == 3000 + 50 * 50
    assert joined(batch, PixelSampler(*disc(), band=4).patch(9, torch.Generator())).counted is None


def test_a_band_that_leaves_nothing_says_so() -> None:
    image, mask = disc()
    with pytest.raises(InputError, match="ignore_band"):
        PixelSampler(image, torch.zeros_like(mask), band=0, ignore=1)


def test_an_ignored_pixel_changes_no_term(small_capture: Path) -> None:
    settings = ("train.ignore_band=1", "train.rays=0", "train.patch=48", "loss.consistency=0")
    found = []
    for wrong in (False, True):
        trainer = make(small_capture, *settings, "train.random_background=false")
        if wrong:
            band = torch.stack([edge_band(m, 1) for m in trainer.sampler.masks])
            trainer.sampler.images[band] = 255
        found.append(float(trainer.losses(1, 0.0)[0]["mse"].detach()))
    assert found[0] == found[1] > 0


def test_smaller_images_keep_the_colours_of_the_person() -> None:
    small = resized(Pictures(*disc()), 0.3)
    assert small.masks.shape == (1, 18, 24) and small.images.dtype == torch.uint8
    on = small.masks[0]
    assert bool((small.images[0][on] == 120).all()), "no black of the outside mixes in"
    assert not bool(small.images[0][~on].any())
    assert int(on.sum()) == pytest.approx(0.09 * int(disc()[1].sum()), rel=0.1)
    same = Pictures(*disc())
    assert resized(same, 1.0) is same


def test_scales_follow_each_other_and_rays_stay_where_they_are(small_capture: Path) -> None:
    trainer = make(small_capture, "train.scales=0.25,0.5,0.5")
    looks = trainer.looks
    assert [looks.scale(d) for d in (0.0, 0.32, 0.34, 0.99, 1.0)] == [0.25, 0.25, 0.5, 0.5, 0.5]
    assert make(small_capture).looks.scale(0.7) == 1.0
    quarter, whole = looks.at(0.0), looks.at(0.5)
    assert (quarter.sampler.width, whole.sampler.width) == (12, 24)
    a, b = quarter.cameras[0], whole.cameras[0]
    # the centre of a coarse pixel is the corner of four fine ones
    one, two = a.rays(torch.tensor([[3.5, 4.5]])), b.rays(torch.tensor([[7.0, 9.0]]))
    torch.testing.assert_close(one.directions, two.directions)
    for step, done in enumerate((0.0, 0.4, 0.9)):
        assert np.isfinite(trainer.step(step, done)["mse"])
        assert trainer.sampler.width == (12 if done == 0.0 else 24)


@pytest.mark.parametrize("scales", ["0,1", "2"])
def test_scales_lie_in_0_to_1(small_capture: Path, scales: str) -> None:
    with pytest.raises(InputError, match=r"train\.scales"):
        make(small_capture, f"train.scales={scales}")


def test_the_head_is_looked_at_in_the_middle_third(small_capture: Path) -> None:
    trainer = make(small_capture, "train.head_focus=0.5", "train.rays=400")
    record = trainer.avatar.record
    posed = record.body(record.poses[0])
    table = PartMap.preset("five", record.body.num_joints)
    top, bottom, left, right = head_box(posed.verts_world, record.body, record.cameras[0])
    pixels, _ = record.cameras[0].project(posed.verts_world[head_verts(record.body, table)])
    x, y = pixels.unbind(-1)
    assert bool(((x >= left) & (x <= right) & (y >= top) & (y <= bottom)).all())
    assert (bottom - top) * (right - left) < 0.2 * 48 * 48
    assert [trainer.looks.focus(d) for d in (0.0, 0.4, 0.7)] == [0.0, 0.5, 0.0]
    shares = []
    for done in (0.1, 0.5):
        trainer.generator.manual_seed(0)
        batch, _ = trainer.draw(1, done)
        x, y = batch.pixels[batch.image == 0].unbind(-1)
        inside = (x > left) & (x < right) & (y > top) & (y < bottom)
        shares.append(float(inside.float().mean()))
        assert len(batch.image) == 400
    assert shares[1] > 0.5 > shares[0]


def test_a_head_behind_the_camera_and_a_body_without_a_head(small_capture: Path) -> None:
    record = read_capture(small_capture)
    verts = record.body(record.poses[0]).verts_world
    camera = record.cameras[0]
    behind = verts - 20.0 * camera.R[2]
    assert head_box(behind, record.body, camera) == (0, 0, 0, 0)
    headless = PartMap.preset("single", record.body.num_joints)
    assert len(head_verts(record.body, headless)) == record.body.num_verts
    sampler = PixelSampler(*disc(), band=0)
    assert sampler.within([(0, 0, 0, 0)]) is sampler
    part = sampler.within([(20, 30, 35, 45)])
    assert int(part.end[-1]) == 100 and int(sampler.end[-1]) > 800


def test_a_step_of_patches_alone(small_capture: Path) -> None:
    trainer = make(small_capture, "train.rays=0", "train.lpips_start=0.9")
    batch, shape = trainer.draw(1, 0.0)
    assert shape == (16, 16) and len(batch.image) == 256
    assert len(batch.image.unique()) == 1
    assert np.isfinite(trainer.step(1, 0.0)["mse"])
