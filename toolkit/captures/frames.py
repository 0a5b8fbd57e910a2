"""Which pictures there are: the files of one, and the cameras and frames of a split."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from monopart.geometry.errors import InputError

from .images import describe_size

T = TypeVar("T")


@dataclass(frozen=True)
class Frame:
    """One picture: a frame number, a camera, and where image and mask lie."""

    index: int
    """Frame number: the stem of the image file."""
    camera: int
    """Position of the camera in the record."""
    image_path: Path
    """8 bit colour image."""
    mask_path: Path
    """Mask of the same size."""


@dataclass(frozen=True)
class Split:
    """Cameras and frames that belong together; every camera is used at every frame."""

    cameras: tuple[int, ...]
    """Positions of cameras."""
    frames: tuple[int, ...]
    """Frame numbers."""

    def pairs(self) -> list[tuple[int, int]]:
        """All (camera, frame) of the split, camera by camera.

        Returns:
            The pairs, in the order in which `CaptureRecord.stack` returns images.

        >>> Split((0, 2), (5, 6)).pairs()
        [(0, 5), (0, 6), (2, 5), (2, 6)]
        """
        return [(c, f) for c in self.cameras for f in self.frames]


def check_sizes(entry: Frame, rgb: np.ndarray, on: np.ndarray, size: tuple[int, int]) -> None:
    """Refuses an image that is not of the capture's size, and a mask not of the image's.

    Args:
        entry: the files, for the message.
        rgb: the image, height width 3.
        on: the mask, height width.
        size: (height, width) of the capture's images.

    Raises:
        InputError: another size.
    """
    if rgb.shape[:2] != size:
        raise InputError(
            f"{entry.image_path}: expected {describe_size(size)} as the other images, found "
            f"{describe_size(rgb.shape)}; K belongs to one size, so resize the image"
        )
    if on.shape != size:
        raise InputError(
            f"{entry.mask_path}: expected {describe_size(size)} as its image, found "
            f"{describe_size(on.shape)}; resize the mask (nearest neighbour)"
        )


def spread(items: Sequence[T], count: int) -> list[T]:
    """At most ``count`` evenly spaced elements.

    Args:
        items: all of them.
        count: how many at most.

    >>> spread([(0, 0), (0, 1), (1, 0), (1, 1)], 2)
    [(0, 0), (1, 0)]
    """
    count = min(count, len(items))
    return [items[i * len(items) // count] for i in range(count)]
