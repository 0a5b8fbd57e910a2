"""Images of a report: checks that say what is wrong with a render, error maps, data URIs."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from monopart.geometry.errors import InputError

from .video import Image, to_uint8

_MAGENTA = (255, 0, 255)
_MAX_SIDE = 1024
_PNG_LIMIT = 300_000  # bytes; above it JPEG keeps the page small


@dataclass(frozen=True)
class Picture:
    """An encoded image."""

    uri: str
    """data: URI, PNG or JPEG."""
    size: tuple[int, int]
    """Height and width in pixels."""


def as_float(image: Image) -> Float[np.ndarray, "_h _w 3"]:
    """The image as float64 in [0, 1], NaN and infinity kept.

    >>> float(as_float(np.full((1, 1, 3), 255, np.uint8)).max())
    1.0
    """
    array = image.detach().cpu().numpy() if isinstance(image, Tensor) else image
    scale = 255.0 if array.dtype == np.uint8 else 1.0
    return array.astype(np.float64) / scale


def shown(image: Image) -> UInt8[np.ndarray, "_h _w 3"]:
    """Bytes to look at: pixels with NaN or infinity are magenta, so that they are seen."""
    values = as_float(image)
    bad = np.logical_not(np.isfinite(values).all(-1))
    pixels = to_uint8(np.where(bad[..., None], 0.0, values))
    pixels[bad] = _MAGENTA
    return pixels


def render_issue(rendered: Image, truth: Image | None = None) -> str | None:
    """Say in words what is plainly wrong with a render.

    Args:
        rendered: The render.
        truth: The photograph of it; a render may be black where the photograph is.

    Returns:
        One sentence with the likely cause and the next step, or None.

    >>> render_issue(np.zeros((2, 2, 3)))[:29]
    'The render is entirely black.'
    """
    values = as_float(rendered)
    bad = int((~np.isfinite(values).all(-1)).sum())
    total = values.shape[0] * values.shape[1]
    if bad:
        return (
            f"{bad} of {total} pixels are NaN or infinite (shown in magenta). The training "
            "diverged or a weight is broken: look for the first jump in the loss curve, then train "
            "again with a lower learning rate."
        )
    if truth is not None and as_float(truth).max() < 2 / 255:
        return None
    if values.max() < 2 / 255:
        return (
            "The render is entirely black. Either no density formed (see the loss curve; train "
            "longer), or the camera does not see the body, or body and camera disagree on a "
            "convention: check units (metres) and the world-to-camera direction."
        )
    if float(values.reshape(-1, 3).std(0).max()) < 1 / 255:
        return (
            "The render is one flat colour, so density fills the view or the colours collapsed: "
            "check the masks of the capture and the loss curve."
        )
    return None


def error_map(rendered: Image, truth: Image, gain: float | int = 4) -> UInt8[np.ndarray, "_h _w 3"]:
    """Colour the absolute difference, averaged over the channels.

    Args:
        rendered: H W 3.
        truth: H W 3, the same size.
        gain: The brightest colour is reached at a difference of 1 / gain.

    Returns:
        H W 3 uint8 (the inferno colour map); magenta where the difference is not finite.

    Raises:
        InputError: The sizes differ.
    """
    first, second = as_float(rendered), as_float(truth)
    if first.shape != second.shape:
        raise InputError(
            f"rendered: expected the size of truth {second.shape}, found {first.shape}"
        )
    difference = np.abs(first - second).mean(-1)
    bad = ~np.isfinite(difference)
    level = np.clip(np.where(bad, 0.0, difference) * gain, 0.0, 1.0)
    coloured = _coloured((level * 255 + 0.5).astype(np.uint8))
    coloured[bad] = _MAGENTA
    return coloured


def _coloured(levels: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Look up the inferno colour map."""
    return np.ascontiguousarray(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)[..., ::-1])


def legend_gradient() -> str:
    """CSS gradient of the colour map of `error_map`, from no difference to the brightest."""
    stops = _coloured(np.linspace(0, 255, 9).astype(np.uint8)[None])[0]
    return "linear-gradient(90deg," + ",".join(f"rgb({r},{g},{b})" for r, g, b in stops) + ")"


def ground_colour(image: Image) -> tuple[int, int, int]:
    """Median colour of the four corners, taken as the colour of the ground."""
    pixels = shown(image)
    corners = np.stack([pixels[i, j] for i in (0, -1) for j in (0, -1)])
    r, g, b = (int(v) for v in np.median(corners, axis=0))
    return r, g, b


def content_box(
    images: Sequence[Image], margin: float = 0.06, aspect: float = 0.0
) -> tuple[int, int, int, int]:
    """Box around everything that differs from the ground colour in any of the images.

    Args:
        images: Images of one size.
        margin: Added on each side, as a share of the larger side of the box.
        aspect: Smallest width over height; a narrower box grows sideways as far as the image goes.

    Returns:
        Top, bottom, left, right in pixels (half open); the whole image where nothing differs or
        the sizes differ.

    >>> picture = np.zeros((100, 80, 3)); picture[40:60, 30:40] = 1
    >>> content_box([picture], margin=0.1)
    (38, 62, 28, 42)
    """
    height, width = images[0].shape[0], images[0].shape[1]
    if any(tuple(i.shape) != tuple(images[0].shape) for i in images):
        return 0, height, 0, width
    used = np.zeros((height, width), bool)
    for image in images:
        difference = np.abs(shown(image).astype(int) - np.array(ground_colour(image)))
        used |= difference.max(-1) > 8
    rows, columns = np.flatnonzero(used.any(1)), np.flatnonzero(used.any(0))
    if not len(rows):
        return 0, height, 0, width
    top, bottom = int(rows[0]), int(rows[-1]) + 1
    left, right = int(columns[0]), int(columns[-1]) + 1
    pad = round(margin * max(bottom - top, right - left))
    top, bottom, left, right = top - pad, bottom + pad, left - pad, right + pad
    missing = max(0, round(aspect * (bottom - top)) - (right - left))
    left, right = left - missing // 2, right + (missing + 1) // 2
    return max(0, top), min(height, bottom), max(0, left), min(width, right)


def picture(pixels: UInt8[np.ndarray, "h w 3"]) -> Picture:
    """Encode for the page: PNG, or JPEG of quality 92 where the PNG is large.

    Args:
        pixels: RGB; sides above 1024 pixels are scaled down.

    Returns:
        The data URI and the size it has.
    """
    scale = _MAX_SIDE / max(pixels.shape[:2])
    if scale < 1:
        size = (max(1, round(pixels.shape[1] * scale)), max(1, round(pixels.shape[0] * scale)))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    swapped = np.ascontiguousarray(pixels[..., ::-1])
    kind, data = "png", cv2.imencode(".png", swapped)[1].tobytes()
    if len(data) > _PNG_LIMIT:
        quality = [cv2.IMWRITE_JPEG_QUALITY, 92]
        kind, data = "jpeg", cv2.imencode(".jpg", swapped, quality)[1].tobytes()
    uri = f"data:image/{kind};base64," + base64.b64encode(data).decode("ascii")
    return Picture(uri, (int(pixels.shape[0]), int(pixels.shape[1])))
