"""`annots.npy` of the ZJU-MoCap layout: cameras, and which image belongs to camera and frame."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from monopart.geometry.body_io import read_npy_object
from monopart.geometry.cameras import Camera
from monopart.geometry.errors import InputError

from .splits import Pictures


def read_annots(path: Path) -> tuple[dict[str, list[np.ndarray]], list[Any]]:
    """Cameras and list of images of `annots.npy`."""
    annots = read_npy_object(path)
    fix = "restore annots.npy of the data set"
    if not isinstance(annots, dict) or not {"cams", "ims"} <= set(annots):
        raise InputError(f"{path}: expected a dict with 'cams' and 'ims', found another; {fix}")
    cams, ims = annots["cams"], annots["ims"]
    if not isinstance(cams, dict) or not set("KDRT") <= set(cams):
        raise InputError(f"{path}: expected cams with K, D, R and T, found another; {fix}")
    if not isinstance(ims, list | tuple | np.ndarray) or len(ims) == 0:
        raise InputError(f"{path}: expected ims to list frames, found none; {fix}")
    numbers = {key: [_numbers(path, key, x) for x in cams[key]] for key in "KDRT"}
    counts = {key: len(values) for key, values in numbers.items()}
    if len(set(counts.values())) != 1 or counts["K"] == 0:
        raise InputError(
            f"{path}: expected as many K, D, R and T, found {counts}; give every camera all four"
        )
    return numbers, list(ims)


def _numbers(path: Path, key: str, value: Any) -> np.ndarray:
    """One entry of cams as float64."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{path}: expected numbers in cams[{key!r}], found {type(value).__name__}; restore it"
        ) from error
    if not np.isfinite(array).all():
        raise InputError(
            f"{path}: expected finite numbers in cams[{key!r}], found NaN or infinity; restore it"
        )
    return array


def pictures_of(annots: Path, ims: list[Any], cameras: int) -> Pictures:
    """Relative path of the image of every (camera, frame)."""
    pictures: Pictures = {}
    for position, entry in enumerate(ims):
        names = entry.get("ims") if isinstance(entry, dict) else None
        if names is None or isinstance(names, str):
            raise InputError(
                f"{annots}: expected ims[{position}] to hold a list 'ims', found another; "
                f"restore annots.npy of the data set"
            )
        if len(names) > cameras:
            raise InputError(
                f"{annots}: expected a camera for each of the {len(names)} images of "
                f"ims[{position}], found {cameras} cameras; add the missing K, D, R, T"
            )
        for camera, name in enumerate(names):
            key = camera, _frame_number(annots, str(name))
            if key in pictures:
                raise InputError(
                    f"{annots}: expected one image for camera {key[0]}, frame {key[1]}, found "
                    f"{pictures[key]} and {name}; the file name must be the frame number"
                )
            pictures[key] = str(name)
    return pictures


def _frame_number(annots: Path, name: str) -> int:
    """Number of a frame from the stem of its image."""
    relative = Path(name)
    if relative.is_absolute() or ".." in relative.parts:
        raise InputError(
            f"{annots}: expected image paths inside the capture, found {name}; make it relative"
        )
    if not (relative.stem.isascii() and relative.stem.isdigit()):
        raise InputError(
            f"{annots}: expected images named by their frame number (000012.jpg), found {name}; "
            f"rename the files and their entries"
        )
    return int(relative.stem)


def cameras_of(
    annots: Path, cams: dict[str, list[np.ndarray]], size: tuple[int, int]
) -> list[Camera]:
    """Cameras in house convention, float32, with their distortion."""
    cameras = []
    for i, (K, D, R, T) in enumerate(zip(cams["K"], cams["D"], cams["R"], cams["T"], strict=True)):
        to_tensor = torch.from_numpy
        t, coefficients = to_tensor(T.reshape(-1) / 1000), to_tensor(D.reshape(-1))
        try:
            exact = Camera.from_legacy_pixels(to_tensor(K), to_tensor(R), t, size, coefficients)
        except InputError as error:
            raise InputError(f"{annots}: camera {i}: {error}") from error
        camera = exact.to(torch.zeros(()))
        if not camera.is_distorted:
            camera = replace(camera, distortion=torch.zeros(0))
        cx, cy = float(camera.K[0, 2]), float(camera.K[1, 2])
        if not (0 <= cx <= size[1] and 0 <= cy <= size[0]):
            raise InputError(
                f"{annots}: camera {i}: expected a principal point inside the {size[1]} x "
                f"{size[0]} image, found ({cx:g}, {cy:g}); scale K to the stored images"
            )
        cameras.append(camera)
    return cameras


def camera_names_of(pictures: Pictures, count: int) -> list[str]:
    """Folder of the images of each camera; its number where that is not unique."""
    names = {camera: Path(name).parent.name for (camera, _), name in pictures.items()}
    listed = [names.get(i) or str(i) for i in range(count)]
    return listed if len(set(listed)) == count else [str(i) for i in range(count)]
