"""Depth maps that a synthetic capture may carry: what geometry is compared with."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from monopart.geometry.errors import InputError

from .images import describe_size, read_depth
from .records import CaptureRecord

FOLDER = "depth"
"""Folder of the depth maps inside a capture, with the paths of the images."""


def depth_path(record: CaptureRecord, camera: int, frame: int) -> Path:
    """Where the depth map of a picture would lie.

    Args:
        record: the capture.
        camera: position of the camera.
        frame: frame number.

    Raises:
        InputError: the capture lists no such picture.
    """
    image = record.frame(camera, frame).image_path.relative_to(record.root)
    parts = image.parts[1:] if image.parts[0] == "images" else image.parts
    return record.root.joinpath(FOLDER, *parts).with_suffix(".png")


def true_depth(record: CaptureRecord, camera: int, frame: int) -> Float[Tensor, "h w"] | None:
    """True depth at the pixel centres of a picture; None where the capture has no such map.

    A map of another size than the pictures is sampled at their pixel centres, without blending.
    Maps of a distorted camera are not used, for the pictures are undistorted and the maps are not.

    Args:
        record: the capture.
        camera: position of the camera.
        frame: frame number.

    Returns:
        Metres along the optical axis, float32, height width; 0 where nothing is.

    Raises:
        InputError: a map that cannot be read, or of other proportions than the picture.
    """
    path = depth_path(record, camera, frame)
    if record.raw_cameras[camera].is_distorted or not path.is_file():
        return None
    stored = read_depth(path)
    height, width = record.image_size
    if stored.shape[0] * width != stored.shape[1] * height:
        raise InputError(
            f"{path}: expected the proportions of {describe_size(record.image_size)}, found "
            f"{describe_size(stored.shape)}; draw it for the camera of the image"
        )
    if stored.shape != (height, width):
        rows = ((np.arange(height) + 0.5) * stored.shape[0] / height).astype(int)
        columns = ((np.arange(width) + 0.5) * stored.shape[1] / width).astype(int)
        stored = stored[rows][:, columns]
    return torch.from_numpy(stored.astype(np.float32) / 1000)
