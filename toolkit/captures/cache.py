"""Training images as they are used: undistorted, black off the mask; through the user's cache."""

import sys
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from monopart.geometry.errors import InputError
from monopart.toolkit.cache import NO_CACHE, Cache, Tensors

from . import images as images_code
from . import records as records_code
from . import scaling as scaling_code
from .patches import mask_box
from .records import CaptureRecord, Progress, run_all


@dataclass(frozen=True)
class Pictures:
    """Images and masks of a split.

    Attributes:
        images: [N, H, W, 3] sRGB, 0..255, undistorted, black where the mask is off.
        masks: [N, H, W] True on the person.
    """

    images: UInt8[Tensor, "n h w 3"]
    masks: Bool[Tensor, "n h w"]


def read_pictures(
    record: CaptureRecord,
    split: str,
    cache: Cache = NO_CACHE,
    progress: Progress | None = None,
) -> Pictures:
    """All images and masks of a split; decoded once, then read from the cache.

    Args:
        record: the capture.
        split: name of the split.
        cache: where they are kept, as bits of the masks and pixels of the boxes around them.
        progress: called with (done, total) as images are read.

    Returns:
        The pictures, in the order of `Split.pairs`.

    Raises:
        InputError: as `CaptureRecord.stack`.
    """
    pairs = record.split(split).pairs()
    frames = [record.frame(*pair) for pair in pairs]
    lenses = [record.raw_cameras[c] for c in record.split(split).cameras]
    inputs = (
        [path for frame in frames for path in (frame.image_path, frame.mask_path)],
        [*record.image_size, *record.stored_size, record.legacy_pixels, record.resize_masks],
        [[lens.K, lens.distortion] for lens in lenses if lens.is_distorted],
        [cv2.__version__, np.__version__, split == "train"],
        [images_code, records_code, scaling_code, sys.modules[__name__]],
    )

    def unpack(tensors: Tensors) -> Pictures:
        pictures = _unpacked(tensors, (len(pairs), *record.image_size))
        if progress is not None:
            progress(len(pairs), len(pairs))
        return pictures

    def build() -> Pictures:
        return _decoded(record, split, progress)

    try:
        return cache.fetch("pictures", inputs, build, _packed, unpack)
    except OSError:  # a file of the capture that cannot be read: reading it says which, and why
        return build()


def _decoded(record: CaptureRecord, split: str, progress: Progress | None) -> Pictures:
    images, masks = record.stack(split, progress)
    rgb, on = images.numpy(), masks.numpy().view(np.uint8)

    def blacken(i: int) -> None:
        cv2.bitwise_and(rgb[i], rgb[i], dst=(out := np.zeros_like(rgb[i])), mask=on[i])
        rgb[i] = out

    run_all(blacken, len(rgb))
    return Pictures(images, masks)


def _packed(pictures: Pictures) -> Tensors:
    """Bits of the masks, and pixels of the box of each mask: all else is black."""
    crops = [
        image[_slices(mask)].reshape(-1)
        for image, mask in zip(pictures.images, pictures.masks, strict=True)
    ]
    bits = np.packbits(pictures.masks.numpy(), axis=-1)
    return {"bits": torch.from_numpy(bits), "pixels": torch.cat(crops)}


def _unpacked(tensors: Tensors, shape: tuple[int, int, int]) -> Pictures:
    bits, pixels = tensors["bits"], tensors["pixels"]
    wide = (shape[2] + 7) // 8
    if (bits.dtype, pixels.dtype) != (torch.uint8, torch.uint8) or bits.shape != (*shape[:2], wide):
        raise InputError(f"bits: expected {shape} pixels, found {bits.dtype} {tuple(bits.shape)}")
    on = np.unpackbits(bits.numpy(), axis=-1, count=shape[2]).view(bool)
    masks, images = torch.from_numpy(on), torch.zeros(*shape, 3, dtype=torch.uint8)
    start = 0
    for image, mask in zip(images, masks, strict=True):
        crop = image[_slices(mask)]
        end = start + crop.numel()
        crop.copy_(pixels[start:end].reshape(crop.shape))
        start = end
    if start != len(pixels):
        raise InputError(f"pixels: expected {start} of the boxes, found {len(pixels)}")
    return Pictures(images, masks)


def _slices(mask: Tensor) -> tuple[slice, slice]:
    """Rows and columns of the box of a mask; empty where the mask is."""
    top, bottom, left, right = mask_box(mask)
    return slice(top, bottom), slice(left, right)
