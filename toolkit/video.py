"""Videos, contact strips and PNG files, each read back before it takes its name."""

import contextlib
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8
from torch import Tensor

from monopart.geometry.errors import BackendError, InputError

from .atomic import replacing

Image = Shaped[np.ndarray, "_h _w 3"] | Shaped[Tensor, "_h _w 3"]
"""An RGB image: float in [0, 1] or uint8; the sizes of two images need not agree."""


@dataclass(frozen=True)
class VideoInfo:
    """What `write_video` wrote, as read back from the file."""

    path: Path
    """The file."""
    codec: str
    """FourCC in use: "avc1" (H.264, plays in browsers) or "mp4v" (MPEG-4 part 2, players only)."""
    frames: int
    """Number of frames."""
    size: tuple[int, int]
    """Height and width in pixels; even, odd frames are padded by their last row or column."""
    fps: float
    """Frames per second."""


def to_uint8(image: Image, name: str = "image") -> UInt8[np.ndarray, "_h _w 3"]:
    """Convert an RGB image to bytes, rounding to the nearest level.

    Args:
        image: H W 3, uint8 or float; floats are clipped to [0, 1].
        name: How an error calls the image.

    Returns:
        H W 3 uint8.

    Raises:
        InputError: The image is empty, holds NaN or infinity, or is neither float nor uint8.

    >>> to_uint8(np.full((1, 1, 3), 0.5)).tolist()
    [[[128, 128, 128]]]
    """
    array = image.detach().cpu().numpy() if isinstance(image, Tensor) else image
    if array.ndim != 3 or array.shape[-1] != 3 or array.size == 0:
        raise InputError(f"{name}: expected height, width, 3 channels, found shape {array.shape}")
    if array.dtype == np.uint8:
        return np.ascontiguousarray(array)
    if not np.issubdtype(array.dtype, np.floating):
        raise InputError(f"{name}: expected float in [0, 1] or uint8, found {array.dtype}")
    if not np.isfinite(array).all():
        bad = int((~np.isfinite(array)).any(-1).sum())
        raise InputError(
            f"{name}: expected finite colours, found {bad} pixels with NaN or infinity"
        )
    return (np.clip(array, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def _check_extension(path: str | os.PathLike[str], extension: str) -> Path:
    """Refuse a file name of another kind than what is written."""
    target = Path(path)
    if target.suffix.lower() != extension:
        raise InputError(
            f"{target}: expected a name that ends in {extension}, "
            f"found {target.suffix or 'no extension'!r}; rename it to {target.stem}{extension}"
        )
    return target


def save_png(path: str | os.PathLike[str], image: Image) -> Path:
    """Write an RGB image as PNG, atomically, and check that it reads back pixel for pixel.

    Args:
        path: File name that ends in .png, in an existing folder.
        image: H W 3, float in [0, 1] or uint8.

    Returns:
        `path` as a `Path`.

    Raises:
        InputError: Another extension, a bad image, a missing folder, or a failed read back.
    """
    target = _check_extension(path, ".png")
    pixels = to_uint8(image, target.name)
    with replacing(target) as temporary:
        _, data = cv2.imencode(".png", pixels[..., ::-1])
        temporary.write_bytes(data.tobytes())
        back = cv2.imdecode(np.fromfile(temporary, np.uint8), cv2.IMREAD_COLOR)
        if back is None or not np.array_equal(back[..., ::-1], pixels):
            raise InputError(f"{target}: the PNG did not read back as written; check the disk")
    return target


def contact_strip(
    images: Sequence[Image], *, height: int | None = None, columns: int | None = None, gap: int = 0
) -> UInt8[np.ndarray, "_h _w 3"]:
    """Lay images out in rows of one picture.

    Args:
        images: RGB images; all are scaled to the height of the first one, or to `height`.
        height: Height of a row in pixels.
        columns: Images per row; all in one row by default.
        gap: Black pixels between images.

    Returns:
        H W 3 uint8; an incomplete last row is black at its end.

    Raises:
        InputError: No images, a bad image, or a size that is not positive.

    >>> contact_strip([np.zeros((4, 3, 3)), np.ones((8, 6, 3))], gap=1).shape
    (4, 7, 3)
    """
    if not images:
        raise InputError("images: expected at least one image, found none")
    pixels = [to_uint8(image, f"images[{i}]") for i, image in enumerate(images)]
    rows, per_row = height or pixels[0].shape[0], columns or len(pixels)
    if rows < 1 or per_row < 1 or gap < 0:
        raise InputError(f"height, columns, gap: expected ≥ 1, 1, 0, found {rows, per_row, gap}")
    tiles = [
        p
        if p.shape[0] == rows
        else cv2.resize(
            p, (max(1, round(p.shape[1] * rows / p.shape[0])), rows), interpolation=cv2.INTER_AREA
        )
        for p in pixels
    ]
    lines = [tiles[i : i + per_row] for i in range(0, len(tiles), per_row)]
    widths = [sum(t.shape[1] for t in line) + gap * (len(line) - 1) for line in lines]
    sheet = np.zeros((len(lines) * (rows + gap) - gap, max(widths), 3), np.uint8)
    for i, line in enumerate(lines):
        left = 0
        for tile in line:
            top = i * (rows + gap)
            sheet[top : top + rows, left : left + tile.shape[1]] = tile
            left += tile.shape[1] + gap
    return sheet


@contextlib.contextmanager
def _quiet_opencv() -> Iterator[None]:
    """Keep FFmpeg from printing that an encoder is missing: the caller reports it instead."""
    old_level, old_env = cv2.utils.logging.getLogLevel(), os.environ.get("OPENCV_FFMPEG_LOGLEVEL")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    os.environ["OPENCV_FFMPEG_LOGLEVEL"] = "-8"
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(old_level)
        if old_env is None:
            del os.environ["OPENCV_FFMPEG_LOGLEVEL"]
        else:
            os.environ["OPENCV_FFMPEG_LOGLEVEL"] = old_env


def _open_writer(
    path: Path, codecs: Sequence[str], fps: float | int, size: tuple[int, int]
) -> tuple[cv2.VideoWriter, str]:
    """Open the first codec of `codecs` that this OpenCV can write."""
    for codec in codecs:
        with _quiet_opencv():
            fourcc = cv2.VideoWriter.fourcc(*codec)
            writer = cv2.VideoWriter(
                str(path), cv2.CAP_FFMPEG, fourcc, float(fps), (size[1], size[0])
            )
        if writer.isOpened():
            return writer, codec
        writer.release()
        path.unlink(missing_ok=True)
    raise BackendError(
        f"codec {' or '.join(codecs)}: OpenCV cannot encode it here; choose codec mp4v, or install "
        "an OpenCV built with this encoder"
    )


def read_video_size(path: str | os.PathLike[str]) -> tuple[int, tuple[int, int], float]:
    """Decode a whole video and count.

    Args:
        path: Video file.

    Returns:
        Number of frames, (height, width) in pixels, frames per second.

    Raises:
        InputError: The file cannot be opened or holds no frame.
    """
    capture = cv2.VideoCapture(str(path))
    try:
        frames, size = 0, (0, 0)
        while True:
            good, frame = capture.read()
            if not good:
                break
            frames, size = frames + 1, (int(frame.shape[0]), int(frame.shape[1]))
        if not frames:
            raise InputError(f"{path}: expected a readable video, found no frame in it")
        return frames, size, float(capture.get(cv2.CAP_PROP_FPS))
    finally:
        capture.release()


def write_video(
    path: str | os.PathLike[str],
    frames: Iterable[Image],
    fps: float | int = 24,
    *,
    codec: Literal["auto", "avc1", "mp4v"] = "auto",
) -> VideoInfo:
    """Write an MP4 video, atomically, and check frame count and size by decoding it again.

    Args:
        path: File name that ends in .mp4, in an existing folder.
        frames: RGB frames of one size, float in [0, 1] or uint8; an iterator is consumed once.
        fps: Frames per second.
        codec: "auto" takes H.264 (avc1) where OpenCV has an encoder, else mp4v; the result names
            the one in use. A codec asked for by name is used or raises.

    Returns:
        What was written; print its `codec`, for mp4v does not play in browsers.

    Raises:
        InputError: Another extension, no frames, frames of different sizes, a bad frame rate, or
            a video that does not read back.
        BackendError: The codec asked for cannot be encoded here.
    """
    target = _check_extension(path, ".mp4")
    if not (np.isfinite(fps) and 0 < fps <= 1000):
        raise InputError(f"fps: expected a frame rate above 0 and at most 1000, found {fps}")
    codecs = ("avc1", "mp4v") if codec == "auto" else (codec,)
    with replacing(target) as temporary:
        count, size, used = _encode(temporary, frames, fps, codecs)
        found, found_size, found_fps = read_video_size(temporary)
        if (found, found_size) != (count, size):
            raise InputError(
                f"{target}: expected {count} frames of {size} to read back, "
                f"found {found} of {found_size}; try another codec than {used}"
            )
    return VideoInfo(target, used, found, found_size, found_fps)


def _encode(
    path: Path, frames: Iterable[Image], fps: float | int, codecs: Sequence[str]
) -> tuple[int, tuple[int, int], str]:
    """Encode all frames; returns their number, the padded size and the codec."""
    writer, used, first, count, size = None, "", (0, 0), 0, (0, 0)
    try:
        for count, frame in enumerate(frames, start=1):
            pixels = to_uint8(frame, f"frames[{count - 1}]")
            shape = (pixels.shape[0], pixels.shape[1])
            if writer is None:
                first, size = shape, (shape[0] + shape[0] % 2, shape[1] + shape[1] % 2)
                writer, used = _open_writer(path, codecs, fps, size)
            if shape != first:
                raise InputError(f"frames[{count - 1}]: expected size {first}, found {shape}")
            pad = ((0, size[0] - shape[0]), (0, size[1] - shape[1]), (0, 0))
            padded = np.pad(pixels, pad, mode="edge")
            writer.write(np.ascontiguousarray(padded[..., ::-1]))
    finally:
        if writer is not None:
            writer.release()
    if not count:
        raise InputError("frames: expected at least one frame, found none")
    return count, size, used
