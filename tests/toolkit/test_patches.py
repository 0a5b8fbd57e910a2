"""Training batches against the images they come from."""

import cv2
import numpy as np
import pytest
import torch

from monopart.toolkit.captures.patches import PixelSampler


@pytest.fixture
def sampler() -> PixelSampler:
    torch.manual_seed(0)
    images = torch.randint(0, 256, (3, 40, 50, 3), dtype=torch.uint8)
    masks = torch.zeros(3, 40, 50, dtype=torch.bool)
    masks[0, 10:20, 12:18] = True
    masks[1, 0:4, 46:50] = True  # in a corner
    masks[2, 30:31, 5:6] = True  # one pixel
    return PixelSampler(images, masks, band=3)


def test_random_pixels_lie_near_the_masks_and_carry_their_colours(sampler: PixelSampler) -> None:
    batch = sampler.random(2000, torch.Generator().manual_seed(1))
    x, y = (batch.pixels - 0.5).long().unbind(-1)
    assert torch.equal(batch.mask, sampler.masks[batch.image, y, x])
    expected = sampler.images[batch.image, y, x].float() / 255 * batch.mask[:, None]
    assert torch.equal(batch.color, expected)
    for image, px, py in zip(batch.image.tolist(), x.tolist(), y.tolist(), strict=True):
        rows, columns = torch.nonzero(sampler.masks[image], as_tuple=True)
        nearest = ((rows - py) ** 2 + (columns - px) ** 2).min()
        assert float(nearest) <= 3**2 + 1
    assert set(batch.image.tolist()) == {0, 1, 2}
    assert 0 < int(batch.mask.sum()) < 2000


def test_random_pixels_reach_every_pixel_of_a_mask(sampler: PixelSampler) -> None:
    batch = sampler.random(5000, torch.Generator().manual_seed(2))
    seen = batch.pixels[(batch.image == 0) & batch.mask].unique(dim=0)
    assert len(seen) == int(sampler.masks[0].sum())


@pytest.mark.parametrize("size", [8, 40, 64, 500])
def test_patches_are_square_blocks_inside_the_image(sampler: PixelSampler, size: int) -> None:
    for seed in range(20):
        batch = sampler.patch(size, torch.Generator().manual_seed(seed))
        height, width = min(size, 40), min(size, 50)
        assert len(batch.image) == height * width
        assert len(batch.image.unique()) == 1
        block = batch.pixels.reshape(height, width, 2)
        assert torch.equal(block[0, :, 0].diff(), torch.ones(width - 1))
        assert torch.equal(block[:, 0, 1].diff(), torch.ones(height - 1))
        assert float(block.min()) >= 0.5
        assert float(block[..., 0].max()) <= 49.5
        assert float(block[..., 1].max()) <= 39.5


def test_the_same_generator_gives_the_same_batch(sampler: PixelSampler) -> None:
    a = sampler.random(50, torch.Generator().manual_seed(3))
    b = sampler.random(50, torch.Generator().manual_seed(3))
    assert torch.equal(a.pixels, b.pixels)


@pytest.mark.parametrize("band", [0, 1, 3, 14, 60])
def test_the_grown_masks_are_those_of_the_whole_images(sampler: PixelSampler, band: int) -> None:
    found = PixelSampler(sampler.images, sampler.masks, band)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band + 1, 2 * band + 1))
    whole = [np.flatnonzero(cv2.dilate(m.numpy().astype(np.uint8), kernel)) for m in sampler.masks]
    assert found.pixel.tolist() == np.concatenate(whole).tolist()
    assert found.end.tolist() == np.cumsum([len(w) for w in whole]).tolist()
    assert found.pixel.dtype == torch.int32


def test_an_empty_mask_has_no_pixels(sampler: PixelSampler) -> None:
    masks = sampler.masks.clone()
    masks[1] = False
    found = PixelSampler(sampler.images, masks, 3)
    assert int(found.end[1]) == int(found.end[0])
    assert set(found.random(500, torch.Generator().manual_seed(0)).image.tolist()) == {0, 2}
