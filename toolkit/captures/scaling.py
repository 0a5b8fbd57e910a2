"""Images, masks and cameras of another size than the stored one."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from monopart.geometry.cameras import Camera
from monopart.geometry.errors import InputError


def scale_image(
    image: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """A smaller image: each pixel is the mean over its area.

    Args:
        image: 8 bit colours.
        size: (height, width) of the result.

    Returns:
        8 bit colours.
    """
    return np.asarray(cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA))


def scale_mask(
    mask: Bool[np.ndarray, "h w"], size: tuple[int, int], nearest: bool = False
) -> Bool[np.ndarray, "h2 w2"]:
    """A mask of another size: on where at least half of a pixel's area is.

    Args:
        mask: True on the person.
        size: (height, width) of the result.
        nearest: take the nearest pixel instead, as the authors of the data sets do.

    Returns:
        True on the person.

    >>> scale_mask(np.array([[True, True, False, True]]), (1, 2)).tolist()
    [[True, True]]
    """
    how = cv2.INTER_NEAREST if nearest else cv2.INTER_AREA
    return np.asarray(cv2.resize(mask.astype(np.uint8) * 255, size[::-1], interpolation=how) > 127)


def camera_at(raw: Camera, scale: float, legacy_pixels: bool = False) -> Camera:
    """Camera of the undistorted and scaled images of a camera.

    Args:
        raw: camera of the stored images.
        scale: of the stored size, above 0 and at most 1.
        legacy_pixels: multiply K for whole-number pixel centres by the factor, as the authors of
            ZJU-MoCap do; their image is moved by ½(1 − scale) pixels against the exact one.

    Returns:
        The camera, without distortion.

    Raises:
        InputError: a factor that is not above 0 and at most 1.
    """
    ideal = raw.without_lens()
    size = scaled_size(raw.size, scale, legacy_pixels)
    if scale == 1:
        return ideal
    if not legacy_pixels:
        return ideal.resized(size)
    half = ideal.K.new_tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    factors = ideal.K.new_tensor([[scale], [scale], [1.0]])
    return replace(ideal, K=factors * (ideal.K - half) + half, size=size)


def scaled_size(
    size: tuple[int, int], scale: float, legacy_pixels: bool = False
) -> tuple[int, int]:
    """Size of scaled images.

    Args:
        size: (height, width) of the stored images.
        scale: of the stored size, above 0 and at most 1.
        legacy_pixels: cut fractions of a pixel off instead of rounding.

    Returns:
        (height, width), pixels.

    Raises:
        InputError: a factor that is not above 0 and at most 1, or nothing left.

    >>> scaled_size((941, 1285), 0.5), scaled_size((941, 1285), 0.3, legacy_pixels=True)
    ((470, 642), (282, 385))
    """
    if not 0 < scale <= 1:
        raise InputError(
            f"scale: expected a factor above 0 and at most 1, found {scale}; give e.g. 0.5"
        )
    cut = int if legacy_pixels else round
    height, width = (cut(n * scale) for n in size)
    if min(height, width) < 1:
        raise InputError(f"scale: expected a pixel to be left of {size}, found {scale}; raise it")
    return height, width
