"""Cameras of COLMAP models, text and binary: read into house cameras, and written from them.

COLMAP's images share cameras; here every image has its own. Pixel centres are at +½ on both sides,
world to camera is R x + t on both sides. Observations and points are not read.
"""

import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch

from monopart.geometry.atomic import write_bytes, write_text
from monopart.geometry.cameras import Camera
from monopart.geometry.errors import InputError
from monopart.geometry.rotations import quat_wxyz_to_rotmat, rotmat_to_quat_wxyz


@dataclass(frozen=True)
class _Model:
    """How one of COLMAP's camera models maps onto ours."""

    number: int
    params: str
    """Names of its parameters in order; `f` is both focal lengths."""
    lens: str = "brown"

    @property
    def names(self) -> list[str]:
        return self.params.split()


_MODELS = {
    "SIMPLE_PINHOLE": _Model(0, "f cx cy"),
    "PINHOLE": _Model(1, "fx fy cx cy"),
    "SIMPLE_RADIAL": _Model(2, "f cx cy k1"),
    "RADIAL": _Model(3, "f cx cy k1 k2"),
    "OPENCV": _Model(4, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": _Model(5, "fx fy cx cy k1 k2 k3 k4", "fisheye"),
    "FULL_OPENCV": _Model(6, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "SIMPLE_RADIAL_FISHEYE": _Model(8, "f cx cy k1", "fisheye"),
    "RADIAL_FISHEYE": _Model(9, "f cx cy k1 k2", "fisheye"),
}
_ORDER = {
    "brown": "k1 k2 p1 p2 k3 k4 k5 k6".split(),
    "fisheye": "k1 k2 k3 k4".split(),
}
_OTHERS = {7: "FOV", 10: "THIN_PRISM_FISHEYE", 11: "RAD_TAN_THIN_PRISM_FISHEYE"}

_Intrinsics = tuple[str, tuple[int, int], tuple[float, ...]]
"""Model, (height, width), parameters."""
_Pose = tuple[str, int, tuple[float, ...], tuple[float, ...]]
"""Name, camera, quaternion with w first, translation."""
T = TypeVar("T")


def read_colmap(folder: str | Path) -> dict[str, Camera]:
    """The cameras of a COLMAP model, one for each image.

    Args:
        folder: holds `cameras.bin` and `images.bin`, or else `cameras.txt` and `images.txt`.

    Returns:
        Name of the image to its camera, float64, in the order of the file; lengths in the units of
        the model.

    Raises:
        InputError: a file that is missing or damaged, or a camera model without counterpart.
    """
    root = Path(folder)
    kind = next((k for k in ("bin", "txt") if (root / f"cameras.{k}").is_file()), None)
    if kind is None:
        raise InputError(
            f"{root}: expected cameras.bin or cameras.txt of COLMAP, found neither; name the "
            f"folder of a sparse model (often sparse/0)"
        )
    intrinsics, images = root / f"cameras.{kind}", root / f"images.{kind}"
    known = dict(_whole(intrinsics, _cameras_bin if kind == "bin" else _cameras_txt))
    poses = _whole(images, _images_bin if kind == "bin" else _images_txt)
    return {pose[0]: _camera(images, known, pose) for pose in poses}


def _whole(path: Path, read: Callable[[Path], Iterator[T]]) -> list[T]:
    """All entries of a file."""
    try:
        return list(read(path))
    except (OSError, ValueError, struct.error, IndexError) as error:
        found = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise InputError(
            f"{path}: expected a COLMAP file, found {found}; export the model again"
        ) from error


def _camera(path: Path, known: Mapping[int, _Intrinsics], pose: _Pose) -> Camera:
    """The camera of one image."""
    name, number, quat, t = pose
    if number not in known:
        raise InputError(
            f"{path}: {name}: expected one of cameras {sorted(known)[:6]}, found {number}; export "
            f"the model again"
        )
    model, size, values = known[number]
    spec = _MODELS[model]
    given = dict(zip(spec.names, values, strict=True))
    fx, fy = given.get("fx", given.get("f", 0.0)), given.get("fy", given.get("f", 0.0))
    exact = torch.float64
    K = torch.tensor([[fx, 0, given["cx"]], [0, fy, given["cy"]], [0, 0, 1]], dtype=exact)
    order = _ORDER[spec.lens]
    lens = [given.get(k, 0.0) for k in order]
    if spec.lens == "brown":
        lens = lens[: 8 if "k3" in given else 4 if "k1" in given else 0]
    q = torch.tensor(quat, dtype=exact)
    try:
        R = quat_wxyz_to_rotmat(q / q.norm())
        return Camera(
            K, R, torch.tensor(t, dtype=exact), size, torch.tensor(lens, dtype=exact), spec.lens
        )
    except InputError as error:
        raise InputError(f"{path}: {name}: {error}") from error


def _known(path: Path, model: str, count: int | None = None) -> _Model:
    """A model by name, checked."""
    if model not in _MODELS:
        raise InputError(
            f"{path}: expected a camera model of {', '.join(_MODELS)}, found {model}; undistort "
            f"the images by COLMAP (image_undistorter) and read that model"
        )
    spec = _MODELS[model]
    if count is not None and count != len(spec.names):
        raise InputError(
            f"{path}: expected {len(spec.names)} parameters of {model}, found {count}; export the "
            f"model again"
        )
    return spec


def _cameras_txt(path: Path) -> Iterator[tuple[int, _Intrinsics]]:
    for line in path.read_text(encoding="utf-8").splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        values = tuple(float(w) for w in words[4:])
        _known(path, words[1], len(values))
        yield int(words[0]), (words[1], (int(words[3]), int(words[2])), values)


def _images_txt(path: Path) -> Iterator[_Pose]:
    lines = [x for x in path.read_text(encoding="utf-8").splitlines() if not x.startswith("#")]
    while lines and not lines[0].strip():
        lines.pop(0)
    for line in lines[::2]:  # every other line lists observations, and may be empty
        if not line.strip():
            continue
        words = line.split(maxsplit=9)
        if len(words) != 10:
            raise ValueError(f"{len(words)} words in the line {line[:40]!r}")
        numbers = tuple(float(w) for w in words[1:8])
        yield words[9].strip(), int(words[8]), numbers[:4], numbers[4:]


def _cameras_bin(path: Path) -> Iterator[tuple[int, _Intrinsics]]:
    data = path.read_bytes()
    (count,), at = struct.unpack_from("<Q", data), 8
    names = {spec.number: name for name, spec in _MODELS.items()} | _OTHERS
    for _ in range(count):
        number, kind, width, height = struct.unpack_from("<iiQQ", data, at)
        spec = _known(path, names.get(kind, f"number {kind}"))
        values = struct.unpack_from(f"<{len(spec.names)}d", data, at + 24)
        at += 24 + 8 * len(spec.names)
        yield number, (names[kind], (height, width), values)


def _images_bin(path: Path) -> Iterator[_Pose]:
    data = path.read_bytes()
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        _, *numbers, camera = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        (points,) = struct.unpack_from("<Q", data, end + 1)
        name = data[at + 64 : end].decode("utf-8")
        at = end + 9 + 24 * points
        if at > len(data):
            raise ValueError(f"{len(data)} bytes, where {at} are announced")
        yield name, camera, tuple(numbers[:4]), tuple(numbers[4:])


def write_colmap(folder: str | Path, cameras: Mapping[str, Camera], binary: bool = True) -> Path:
    """Writes cameras as a COLMAP model without points, for its triangulator or for other programs.

    Args:
        folder: made if needed; `cameras`, `images` and an empty `points3D` are written into it.
        cameras: name of an image to its camera; equal intrinsics become one camera of the model.
        binary: `.bin` files, else `.txt`.

    Returns:
        The folder.

    Raises:
        InputError: no camera, skew, or coefficients that COLMAP has no model for; nothing is
            written.
    """
    root, shared, poses = Path(folder), {}, []
    if not cameras:
        raise InputError("write_colmap: expected at least one camera, found none")
    for name, camera in cameras.items():
        if not name or name.split() != [name]:
            raise InputError(f"image name: expected one word, found {name!r}; rename the image")
        intrinsics = _intrinsics(name, camera)
        number = shared.setdefault(intrinsics, len(shared) + 1)
        quat = rotmat_to_quat_wxyz(camera.R.detach().double())
        poses.append((name, number, quat.tolist(), camera.t.detach().double().tolist()))
    root.mkdir(parents=True, exist_ok=True)
    if binary:
        write_bytes(root / "cameras.bin", _pack_cameras(shared))
        write_bytes(root / "images.bin", _pack_images(poses))
        write_bytes(root / "points3D.bin", struct.pack("<Q", 0))
    else:
        write_text(root / "cameras.txt", _print_cameras(shared))
        write_text(root / "images.txt", _print_images(poses))
        write_text(root / "points3D.txt", "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n")
    return root


def _intrinsics(name: str, camera: Camera) -> _Intrinsics:
    """Model and parameters of a camera."""
    K = camera.K.detach().double().tolist()
    if K[0][1] != 0:
        raise InputError(f"{name}: expected no skew, found {K[0][1]:g} pixels; COLMAP has none")
    lens = camera.distortion.detach().double().tolist()
    focal = [K[0][0], K[1][1], K[0][2], K[1][2]]
    if camera.lens == "fisheye":
        return "OPENCV_FISHEYE", camera.size, (*focal, *(lens or [0.0] * 4))
    if any(lens[8:]):
        raise InputError(
            f"{name}: expected no thin-prism or tilt terms, found {lens[8:]}; COLMAP has no such "
            f"lens: write camera.undistorted()[0] and resample the image"
        )
    if not camera.is_distorted:
        return "PINHOLE", camera.size, tuple(focal)
    lens = (lens + [0.0] * 8)[:8]
    if any(lens[4:]):
        return "FULL_OPENCV", camera.size, (*focal, *lens)
    return "OPENCV", camera.size, (*focal, *lens[:4])


def _pack_cameras(shared: Mapping[_Intrinsics, int]) -> bytes:
    parts = [struct.pack("<Q", len(shared))]
    for (model, (height, width), values), number in shared.items():
        parts.append(struct.pack("<iiQQ", number, _MODELS[model].number, width, height))
        parts.append(struct.pack(f"<{len(values)}d", *values))
    return b"".join(parts)


def _pack_images(poses: list) -> bytes:
    parts = [struct.pack("<Q", len(poses))]
    for i, (name, number, quat, t) in enumerate(poses, start=1):
        parts.append(struct.pack("<i7di", i, *quat, *t, number))
        parts.append(name.encode("utf-8") + b"\0" + struct.pack("<Q", 0))
    return b"".join(parts)


def _print_cameras(shared: Mapping[_Intrinsics, int]) -> str:
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for (model, (height, width), values), number in shared.items():
        lines.append(f"{number} {model} {width} {height} " + " ".join(map(repr, values)))
    return "\n".join(lines) + "\n"


def _print_images(poses: list) -> str:
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then POINTS2D[] (none)"]
    for i, (name, number, quat, t) in enumerate(poses, start=1):
        lines += [" ".join([str(i), *map(repr, [*quat, *t]), str(number), name]), ""]
    return "\n".join(lines) + "\n"
