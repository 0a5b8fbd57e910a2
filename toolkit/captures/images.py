"""Files of a capture: images, masks and vertices, read whole or refused with one line."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16

from monopart.geometry.errors import InputError

_ENDINGS = {b"\xff\xd8": b"\xff\xd9", b"\x89P": b"IEND"}  # first bytes → mark that ends the file
_TAIL = 4096  # bytes in which that mark must lie: some writers pad their files


def read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Reads an 8 bit image.

    Args:
        path: JPEG or PNG.

    Returns:
        sRGB, 0..255, height width 3.

    Raises:
        InputError: no such file, or one that is not a complete image.
    """
    bgr = _decode(path, cv2.IMREAD_COLOR)
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def read_mask(path: Path) -> Bool[np.ndarray, "h w"]:
    """Reads a mask: 0/255, 0/1, labels with 0 as background, or a colour per label on black.

    Args:
        path: PNG. Where the largest value of a one-channel mask is above 127 the person is what
            lies above 127; in labels (0/1, or a number per part) and colours it is what is not 0.

    Returns:
        True on the person, height width.

    Raises:
        InputError: no such file, or one that is not a complete 8 bit image.
    """
    mask = _decode(path, cv2.IMREAD_UNCHANGED)
    if mask.dtype != np.uint8:
        raise InputError(f"{path}: expected an 8 bit mask, found {mask.dtype}; save it as 8 bit")
    if mask.ndim == 3:
        colors = mask[..., :3]
        if not (colors == colors[..., :1]).all():
            return np.asarray(colors.any(axis=2))
        mask = colors[..., 0]
    return np.asarray(mask > 127 if mask.max(initial=0) > 127 else mask != 0)


def read_depth(path: Path) -> UInt16[np.ndarray, "h w"]:
    """Reads a depth map.

    Args:
        path: PNG of one channel with 16 bits.

    Returns:
        Millimetres along the optical axis, height width; 0 where nothing is.

    Raises:
        InputError: no such file, or one that is not a complete 16 bit image of one channel.
    """
    depth = _decode(path, cv2.IMREAD_UNCHANGED)
    if depth.dtype != np.uint16 or depth.ndim != 2:
        raise InputError(
            f"{path}: expected 16 bit depths of one channel, found {depth.dtype} "
            f"{tuple(depth.shape)}; save millimetres as a 16 bit PNG"
        )
    return depth


def read_vertices(path: Path) -> Float[np.ndarray, "v 3"]:
    """Reads stored body vertices, without copying them where the file allows it.

    Args:
        path: `.npy` array of floats.

    Returns:
        World metres, V 3.

    Raises:
        InputError: no such file, or one that is not an array of (vertices, 3) floats.
    """
    try:
        verts = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(
            f"{path}: expected an array of vertices, found {_one_line(error)}; restore the file"
        ) from error
    if verts.ndim != 2 or verts.shape[1] != 3 or verts.dtype.kind != "f":
        raise InputError(
            f"{path}: expected floats of shape (vertices, 3), found {verts.dtype} "
            f"{tuple(verts.shape)}; restore the file"
        )
    return np.asarray(verts)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _decode(path: Path, flags: int) -> np.ndarray:
    """An image file as stored, refused where it is missing, not an image or cut short."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"{path}: expected an image, found {error.strerror or error}; restore the file or "
            f"take its frame out of splits.json"
        ) from error
    ending = _ENDINGS.get(data[:2])
    # cv2 fills what is missing of a file that is cut short with grey and says nothing
    whole = ending is None or ending in data[-_TAIL:]
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data and whole else None
    if pixels is None:
        found = "a file that is cut short" if data and not whole else f"{len(data)} other bytes"
        raise InputError(
            f"{path}: expected a readable image, found {found}; restore the file or take its "
            f"frame out of splits.json"
        )
    return pixels


def describe_size(shape: tuple[int, ...]) -> str:
    """Width x height of an array of pixels, as people write it.

    Args:
        shape: (height, width, …).

    Returns:
        Text.

    >>> describe_size((480, 640, 3))
    '640 x 480'
    """
    return f"{shape[1]} x {shape[0]}"
