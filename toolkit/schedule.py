"""What the training looks at, and when: resolutions in stretches of the run, focus on the head."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from monopart.geometry.body import BodyModel
from monopart.geometry.cameras import Camera
from monopart.geometry.errors import InputError
from monopart.geometry.parts import PartMap

from .captures.cache import Pictures
from .captures.patches import Box, PixelBatch, PixelSampler, joined
from .config import TrainConfig

HEAD_MARGIN = 0.15  # of the size of the head's box, on each side: hair and chin


@dataclass(frozen=True)
class Look:
    """Images of one resolution.

    Attributes:
        sampler: draws their pixels.
        cameras: their cameras.
        head: draws pixels at the head, or None.
    """

    sampler: PixelSampler
    cameras: list[Camera]
    head: PixelSampler | None

    def random(
        self, count: int, at_head: int, generator: torch.Generator, images: int | None = None
    ) -> PixelBatch:
        """Random pixels.

        Args:
            count: how many.
            at_head: how many of them at the head.
            generator: source of the choice.
            images: number of random images from which those come that may lie anywhere; None: all.
        """
        if self.head is None or not at_head:
            return self.sampler.random(count, generator, images)
        few = self.head.random(at_head, generator)
        return joined(self.sampler.random(count - at_head, generator, images), few)


class Looks:
    """The images of a training at the resolutions of its schedule."""

    def __init__(
        self,
        pictures: Pictures,
        cameras: list[Camera],
        heads: list[Box] | None,
        spec: TrainConfig,
    ) -> None:
        """Remember the images; those of other resolutions are made when they are asked for.

        Args:
            pictures: images and masks in full size.
            cameras: the training cameras, for the full size.
            heads: box of the head in each image, pixels of the full size, or None.
            spec: scales, bands and focus.

        Raises:
            InputError: a scale that is not in (0, 1].
        """
        if any(not 0.0 < scale <= 1.0 for scale in spec.scales):
            raise InputError(f"train.scales: expected numbers in (0, 1], found {spec.scales}")
        self.pictures, self.cameras, self.heads, self.spec = pictures, cameras, heads, spec
        self._made: tuple[float, Look] | None = None

    def scale(self, done: float) -> float:
        """Scale of the images at a finished part of the run."""
        scales = self.spec.scales or (1.0,)
        return scales[min(int(done * len(scales)), len(scales) - 1)]

    def focus(self, done: float) -> float:
        """Part of pixels and patches at the head: in the middle third only."""
        return self.spec.head_focus if 1 / 3 <= done < 2 / 3 else 0.0

    def at(self, done: float) -> Look:
        """The images at a finished part of the run; only one resolution is kept."""
        scale = self.scale(done)
        if self._made is None or self._made[0] != scale:
            self._made = scale, self._make(scale)
        return self._made[1]

    def _make(self, scale: float) -> Look:
        seen = resized(self.pictures, scale)
        size = seen.masks.shape[1], seen.masks.shape[2]
        sampler = PixelSampler(seen.images, seen.masks, self.spec.band, self.spec.ignore_band)
        cameras = self.cameras if scale == 1.0 else [c.resized(size) for c in self.cameras]
        head = None
        if self.heads is not None and self.spec.head_focus:
            head = sampler.within([_scaled(box, scale) for box in self.heads])
        return Look(sampler, cameras, head)


def _scaled(box: Box, scale: float) -> Box:
    top, bottom, left, right = (round(side * scale) for side in box)
    return top, bottom, left, right


def resized(pictures: Pictures, scale: float) -> Pictures:
    """Smaller images: areas averaged, colours of the person alone, masks where half is covered.

    Args:
        pictures: images that are black off their masks.
        scale: factor in (0, 1]; sizes are rounded to whole pixels.

    Returns:
        Images that are black off their masks; the same ones at scale 1.
    """
    if scale == 1.0:
        return pictures
    height, width = pictures.masks.shape[1:]
    size = round(width * scale), round(height * scale)
    images, masks = [], []
    for image, mask in zip(pictures.images.numpy(), pictures.masks.numpy(), strict=True):
        cover = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        light = cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        on = cover >= 0.5
        own = light / np.maximum(cover, 0.5)[..., None] * on[..., None]
        images.append(torch.from_numpy(own.round().clip(0, 255).astype(np.uint8)))
        masks.append(torch.from_numpy(on))
    return Pictures(torch.stack(images), torch.stack(masks))


def head_box(
    verts: Float[Tensor, "v 3"], body: BodyModel, camera: Camera, names: PartMap | None = None
) -> Box:
    """Box of the head in an image: its vertices with a margin, cut to the image.

    Args:
        verts: world vertices, metres.
        body: the body they belong to.
        camera: the camera.
        names: a table with a part named head; None for the table of five parts.

    Returns:
        Top, bottom, left and right in pixels; zeros where the head is not in front of the camera.
    """
    table = names or PartMap.preset("five", body.num_joints)
    pixels, depth = camera.project(verts[head_verts(body, table)])
    if not bool((depth > 0).all()):
        return 0, 0, 0, 0
    low, high = pixels.amin(0), pixels.amax(0)
    margin = HEAD_MARGIN * (high - low)
    (left, top), (right, bottom) = (low - margin).tolist(), (high + margin).tolist()
    height, width = camera.size
    rows = min(max(int(top), 0), height), min(max(int(bottom) + 1, 0), height)
    columns = min(max(int(left), 0), width), min(max(int(right) + 1, 0), width)
    return *rows, *columns


def head_verts(body: BodyModel, table: PartMap) -> Tensor:
    """Rows of the vertices of the head.

    Args:
        body: the body.
        table: parts, one of them named head.

    Returns:
        The rows; all of them where the table has no head.
    """
    if "head" not in table.names:
        return torch.arange(body.num_verts, device=body.weights.device)
    return torch.nonzero(table.vertex_parts(body.weights) == table.names.index("head")).squeeze(-1)
