"""Cameras of EasyMocap: `intri.yml` and `extri.yml` in OpenCV's FileStorage format.

EasyMocap puts pixel centres at whole numbers and lengths in metres; world to camera is R x + T.
Files are text, read by OpenCV; nothing in them is executed.
"""

import re
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import torch

from monopart.geometry.atomic import replacing
from monopart.geometry.cameras import Camera
from monopart.geometry.errors import InputError

Sizes = tuple[int, int] | Mapping[str, tuple[int, int]] | None
"""(height, width) of all cameras, or by name; None where the file says it."""

_NAME = re.compile(r"[A-Za-z0-9_-]+")


def read_easymocap(folder: str | Path, sizes: Sizes = None) -> dict[str, Camera]:
    """The cameras of `intri.yml` and `extri.yml`.

    Args:
        folder: holds both files.
        sizes: (height, width) of the images in pixels, of all cameras or by name; None takes
            `H_NAME` and `W_NAME` of intri.yml, which older files lack.

    Returns:
        Name to camera, float64, in the order of `names`; metres, pixel centres at +½.

    Raises:
        InputError: a file that is missing or damaged, an entry that is missing or of another shape,
            or no size.
    """
    root = Path(folder)
    inner, outer = _Storage(root / "intri.yml"), _Storage(root / "extri.yml")
    names = inner.names()
    missing = sorted(set(names) ^ set(outer.names()))
    if missing:
        raise InputError(
            f"{outer.path}: expected the cameras of intri.yml, found a difference in "
            f"{missing[0]!r}; write both files again"
        )
    return {name: _camera(inner, outer, name, sizes) for name in names}


def _camera(inner: "_Storage", outer: "_Storage", name: str, sizes: Sizes) -> Camera:
    K = inner.matrix(f"K_{name}", (3, 3))
    lens = inner.lens(f"dist_{name}")
    if f"Rot_{name}" in outer:
        R = outer.matrix(f"Rot_{name}", (3, 3))
    else:
        R = cv2.Rodrigues(outer.matrix(f"R_{name}", (3, 1)))[0]
    T = outer.matrix(f"T_{name}", (3, 1))
    size = sizes.get(name) if isinstance(sizes, Mapping) else sizes
    if size is None:
        size = inner.number(f"H_{name}"), inner.number(f"W_{name}")
    to_tensor = torch.from_numpy
    try:
        return Camera.from_legacy_pixels(
            to_tensor(K), to_tensor(R), to_tensor(T.reshape(3)), size, to_tensor(lens)
        )
    except InputError as error:
        raise InputError(f"{inner.path}: camera {name}: {error}") from error


class _Storage:
    """One file, read whole."""

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.is_file():
            raise InputError(f"{path}: expected a file of EasyMocap, found none; name its folder")
        try:
            self.file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
            if not self.file.isOpened() or not self.file.root().isMap():
                raise ValueError("another format")
        except (cv2.error, SystemError, ValueError) as error:
            found = " ".join(str(error).split())[-100:]
            raise InputError(
                f"{path}: expected YAML of OpenCV's FileStorage, found {found}; write it again"
            ) from error

    def __contains__(self, key: str) -> bool:
        return not self.file.getNode(key).empty()

    def names(self) -> list[str]:
        """The list `names`."""
        node = self.file.getNode("names")
        names = [node.at(i).string() for i in range(node.size())] if node.isSeq() else []
        if not names or "" in names:
            raise self._error("names", "a list of camera names", "none")
        return names

    def matrix(self, key: str, shape: tuple[int, int]) -> np.ndarray:
        """A matrix of a shape, float64; a vector may lie or stand."""
        found = self._matrix(key)
        if 1 in shape and found.size == max(shape):
            found = found.reshape(shape)
        if found.shape != shape:
            raise self._error(key, f"a matrix {shape[0]} x {shape[1]}", f"{found.shape}")
        return found

    def lens(self, key: str) -> np.ndarray:
        """Distortion coefficients; none where the file has none."""
        return self._matrix(key).reshape(-1) if key in self else np.zeros(0)

    def number(self, key: str) -> int:
        """A positive whole number."""
        node = self.file.getNode(key)
        value = node.real() if node.isInt() or node.isReal() else 0
        if value != int(value) or value <= 0:
            raise self._error(key, "the size of the images", "none")
        return int(value)

    def _matrix(self, key: str) -> np.ndarray:
        found = self.file.getNode(key).mat() if key in self else None
        if found is None:
            raise self._error(key, "a matrix", "none")
        return found.astype(np.float64)

    def _error(self, key: str, expected: str, found: str) -> InputError:
        hint = "give sizes" if key[:2] in ("H_", "W_") else "write the file again"
        return InputError(f"{self.path}: expected {expected} in {key}, found {found}; {hint}")


def write_easymocap(folder: str | Path, cameras: Mapping[str, Camera]) -> Path:
    """Writes `intri.yml` and `extri.yml`, with the sizes of the images.

    Args:
        folder: made if needed.
        cameras: name to camera; lengths in metres.

    Returns:
        The folder.

    Raises:
        InputError: no camera, a name that OpenCV cannot use as a key, or a fisheye, for which the
            format has no entry; nothing is written.
    """
    root = Path(folder)
    if not cameras:
        raise InputError("write_easymocap: expected at least one camera, found none")
    for name, camera in cameras.items():
        if not _NAME.fullmatch(name):
            raise InputError(
                f"camera name: expected letters, digits, - and _, found {name!r}; rename it"
            )
        if camera.lens != "brown":
            raise InputError(
                f"{name}: expected a lens of radial and tangential terms, found a {camera.lens}; "
                f"write camera.undistorted()[0] and resample the image"
            )
    root.mkdir(parents=True, exist_ok=True)
    with replacing(root / "intri.yml") as inner, replacing(root / "extri.yml") as outer:
        _write_inner(inner, cameras)
        _write_outer(outer, cameras)
    return root


def _open(path: Path, cameras: Mapping[str, Camera]) -> cv2.FileStorage:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.startWriteStruct("names", cv2.FileNode_SEQ)
    for name in cameras:
        file.write("", name)
    file.endWriteStruct()
    return file


def _write_inner(path: Path, cameras: Mapping[str, Camera]) -> None:
    file = _open(path, cameras)
    for name, camera in cameras.items():
        K = camera.K.detach().double().cpu().numpy().copy()
        K[:2, 2] -= 0.5
        lens = camera.distortion.detach().double().cpu().numpy()
        file.write(f"K_{name}", K)
        file.write(f"dist_{name}", (lens if lens.size else np.zeros(5))[None])
        file.write(f"H_{name}", int(camera.size[0]))
        file.write(f"W_{name}", int(camera.size[1]))
    file.release()


def _write_outer(path: Path, cameras: Mapping[str, Camera]) -> None:
    file = _open(path, cameras)
    for name, camera in cameras.items():
        R = camera.R.detach().double().cpu().numpy()
        file.write(f"R_{name}", cv2.Rodrigues(R)[0])
        file.write(f"Rot_{name}", R)
        file.write(f"T_{name}", camera.t.detach().double().cpu().numpy()[:, None])
    file.release()
