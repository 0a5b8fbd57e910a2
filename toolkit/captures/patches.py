"""Training batches: random pixels near the person over all frames, and square patches."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from monopart.geometry.errors import InputError

Box = tuple[int, int, int, int]  # top, bottom, left, right; ends excluded


@dataclass(frozen=True)
class PixelBatch:
    """Pixels of training images.

    Attributes:
        image: [N] int64 row of the training image.
        pixels: [N, 2] pixel centres (x, y).
        color: [N, 3] sRGB in [0, 1], black where the mask is off.
        mask: [N] whether the person covers the pixel.
        counted: [N] False in a band at the edge of the mask that no loss sees; None: all count.
    """

    image: Int[Tensor, "n"]
    pixels: Float[Tensor, "n 2"]
    color: Float[Tensor, "n 3"]
    mask: Bool[Tensor, "n"]
    counted: Bool[Tensor, "n"] | None = None


class PixelSampler:
    """Draws pixels from the masks grown by a band, each equally likely over all images."""

    def __init__(
        self,
        images: UInt8[Tensor, "n h w 3"],
        masks: Bool[Tensor, "n h w"],
        band: int,
        ignore: int = 0,
    ) -> None:
        """Index the pixels.

        Args:
            images: training images.
            masks: their masks.
            band: pixels by which a mask is grown.
            ignore: pixels on either side of the edge of a mask that are not drawn, and that do not
                count in a patch.
        """
        self.images, self.masks = images, masks
        self.height, self.width = masks.shape[1:]
        self.boxes = [mask_box(m) for m in masks]
        self.ignored = None if not ignore else torch.stack([edge_band(m, ignore) for m in masks])
        grown = [_grown(m.numpy(), box, band) for m, box in zip(masks, self.boxes, strict=True)]
        if self.ignored is not None:
            flat = self.ignored.flatten(1).numpy()
            grown = [g[~f[g]] for g, f in zip(grown, flat, strict=True)]
        self._index(grown)

    def _index(self, chosen: Sequence[np.ndarray]) -> None:
        self.pixel = torch.from_numpy(np.concatenate(chosen))
        self.end = torch.tensor([len(c) for c in chosen]).cumsum(0)
        if not len(self.pixel):
            raise InputError(
                "masks: expected a pixel to train on, found none; lower train.ignore_band, or "
                "choose frames on which the person is seen"
            )

    def within(self, boxes: Sequence[Box]) -> "PixelSampler":
        """The same images with pixels and patches drawn from a box of each.

        Args:
            boxes: one per image; without any pixel in them the whole masks stay.
        """
        ends = [0, *self.end.tolist()]
        chosen = []
        for i, (top, bottom, left, right) in enumerate(boxes):
            flat = self.pixel[ends[i] : ends[i + 1]].numpy()
            y, x = flat // self.width, flat % self.width
            chosen.append(flat[(y >= top) & (y < bottom) & (x >= left) & (x < right)])
        if not any(len(c) for c in chosen):
            return self
        other = copy.copy(self)
        other.boxes = list(boxes)
        other._index(chosen)
        return other

    def random(
        self, count: int, generator: torch.Generator, images: int | None = None
    ) -> PixelBatch:
        """Uniformly random pixels, in order: neighbours share the body's memory.

        Args:
            count: number of pixels.
            generator: where they are drawn from.
            images: number of random images from which they come; None is all.
        """
        if images is None or images >= len(self.end):
            pick = torch.randint(int(self.end[-1]), (count,), generator=generator)
        else:
            some = torch.randperm(len(self.end), generator=generator)[:images].sort().values
            first = torch.cat([self.end.new_zeros(1), self.end])[some]
            ends = (self.end[some] - first).cumsum(0)
            pick = torch.randint(int(ends[-1]), (count,), generator=generator)
            row = torch.searchsorted(ends, pick, right=True)
            pick = pick + (self.end[some] - ends)[row]
        pick = pick.sort().values
        image = torch.searchsorted(self.end, pick, right=True)
        return self._batch(image, self.pixel[pick].long())

    def patch(self, size: int, generator: torch.Generator) -> PixelBatch:
        """A square of one image centred in the box of its mask, row by row.

        A patch larger than the image is cut to the image.
        """
        image = int(torch.randint(len(self.images), (1,), generator=generator))
        height, width = min(size, self.height), min(size, self.width)
        y0, y1, x0, x1 = self.boxes[image]
        u, v = torch.rand(2, generator=generator).tolist()
        # Centres anywhere in the box of the mask: its borders are seen as often as its middle.
        top = min(max(int(y0 + u * (y1 - y0)) - height // 2, 0), self.height - height)
        left = min(max(int(x0 + v * (x1 - x0)) - width // 2, 0), self.width - width)
        ys = torch.arange(top, top + height)[:, None]
        xs = torch.arange(left, left + width)[None]
        flat = (ys * self.width + xs).reshape(-1)
        return self._batch(torch.full_like(flat, image), flat)

    def _batch(self, image: Tensor, flat: Tensor) -> PixelBatch:
        y, x = flat // self.width, flat % self.width
        mask = self.masks[image, y, x]
        color = self.images[image, y, x].float() / 255.0 * mask[:, None]
        counted = None if self.ignored is None else ~self.ignored[image, y, x]
        return PixelBatch(image, torch.stack([x, y], -1).float() + 0.5, color, mask, counted)


def edge_band(mask: Bool[Tensor, "h w"], width: int) -> Bool[Tensor, "h w"]:
    """Pixels nearer than a width to the edge of a mask, on both sides of it.

    Args:
        mask: the mask; the border of the image is no edge.
        width: pixels.

    Returns:
        The band.

    >>> edge_band(torch.tensor([[False, False, True, True]]), 1)
    tensor([[False,  True,  True, False]])
    """
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * width + 1, 2 * width + 1))
    grey = mask.numpy().astype(np.uint8)
    # OpenCV reads the outside as what changes nothing, in both operations.
    return torch.from_numpy(cv2.dilate(grey, kernel) != cv2.erode(grey, kernel))


def joined(a: PixelBatch, b: PixelBatch) -> PixelBatch:
    """Two batches as one, in order.

    Args:
        a: the first rows.
        b: the last rows.

    Returns:
        The batch.
    """
    counted = None
    if a.counted is not None and b.counted is not None:
        counted = torch.cat([a.counted, b.counted])
    return PixelBatch(
        torch.cat([a.image, b.image]),
        torch.cat([a.pixels, b.pixels]),
        torch.cat([a.color, b.color]),
        torch.cat([a.mask, b.mask]),
        counted,
    )


def mask_box(mask: Bool[Tensor, "h w"]) -> tuple[int, int, int, int]:
    """Top, bottom, left and right of the box around a mask, ends excluded.

    Args:
        mask: the mask.

    Returns:
        Rows and columns; zeros where the mask is empty.
    """
    rows, columns = (np.flatnonzero(mask.numpy().any(axis=a)) for a in (1, 0))
    if not len(rows):
        return 0, 0, 0, 0
    return int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1


def _grown(mask: np.ndarray, box: tuple[int, int, int, int], band: int) -> np.ndarray:
    """Flat indices of a mask grown by a band, ascending, int32; looks only where the mask is."""
    top, left = max(box[0] - band, 0), max(box[2] - band, 0)
    near = mask[top : box[1] + band, left : box[3] + band].astype(np.uint8)
    if not near.size:
        return np.zeros(0, np.int32)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band + 1, 2 * band + 1))
    inside = np.flatnonzero(cv2.dilate(near, kernel).view(bool))
    skipped = (inside // near.shape[1]) * (mask.shape[1] - near.shape[1])
    return (inside + skipped + top * mask.shape[1] + left).astype(np.int32)
