"""Reader of the ZJU-MoCap folder layout: `annots.npy`, images, masks, body parameters."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.body_io import read_npy_object
from monopart.geometry.cameras import Camera
from monopart.geometry.errors import InputError

from .images import describe_size, read_image, read_vertices
from .records import CaptureRecord, Frame, Split
from .splits import Pictures, read_splits

PARAMS = ("new_params", "params", "smpl_params")
MASKS = ("mask", "mask_cihp", "schp")


def read_zju_mocap(
    path: str | Path, params: str | None = None, body: str | Path | None = None
) -> CaptureRecord:
    """Read a capture in the layout of ZJU-MoCap; images and masks are read later, on demand.

    Intrinsics in `annots.npy` put pixel centres at whole numbers and lengths in millimetres: half a
    pixel is added to cx and cy, and T is divided by 1000. The stem of an image file numbers its
    frame. The first three angles of `poses` are the local rotation of the root joint, before Rh.

    Without `splits.json` the splits are those of the data set: training with camera 4 (camera 0
    where there are fewer) on every fifth of the first 500 frames, `novel_view` on the other cameras
    at every sixth training frame, `novel_pose` on them at every fifth later frame.

    Args:
        path: folder of the capture.
        params: folder of the body track inside it; the first of `new_params`, `params`,
            `smpl_params` where left out.
        body: body file that the poses belong to; `body.npz` in the capture, else the body that
            ships with the package, where left out.

    Returns:
        The record; of every split all image and mask files are known to exist.

    Raises:
        InputError: anything missing, damaged or contradictory, in one line that names the file.
    """
    root = Path(path)
    annots = root / "annots.npy"
    cams, ims = _read_annots(annots)
    pictures = _pictures(annots, ims, len(cams["K"]))
    numbers = sorted({frame for _, frame in pictures})
    model = _body(root, body)
    track = _track_folder(root, params)
    poses = _poses(track, numbers, model)
    splits, fps, stored_size = read_splits(root, pictures, set(poses))
    frames = _frames(root, pictures, splits)
    size = _image_size(frames, splits["train"], root, stored_size)
    raw = _cameras(annots, cams, size)
    record = CaptureRecord(
        root=root,
        name=root.resolve().name,
        cameras=[c.undistorted()[0] if c.is_distorted else c for c in raw],
        camera_names=_camera_names(pictures, len(raw)),
        poses=poses,
        body=model,
        splits=splits,
        fps=fps,
        image_size=size,
        frames=frames,
        raw_cameras=raw,
        params=track.name,
        vertex_paths=_vertex_paths(root, track.name, poses),
    )
    _check_vertices(record)
    return record


def _read_annots(path: Path) -> tuple[dict[str, list[np.ndarray]], list[Any]]:
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


def _pictures(annots: Path, ims: list[Any], cameras: int) -> Pictures:
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


def _cameras(
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


def _camera_names(pictures: Pictures, count: int) -> list[str]:
    """Folder of the images of each camera; its number where that is not unique."""
    names = {camera: Path(name).parent.name for (camera, _), name in pictures.items()}
    listed = [names.get(i) or str(i) for i in range(count)]
    return listed if len(set(listed)) == count else [str(i) for i in range(count)]


def _body(root: Path, body: str | Path | None) -> BodyModel:
    """The body named, the capture's own, or the one that ships with the package."""
    own = root / "body.npz"
    if body is not None:
        return BodyModel.load(body)
    return BodyModel.load(own) if own.is_file() else BodyModel.default()


def _track_folder(root: Path, params: str | None) -> Path:
    """Folder of the body parameters."""
    for name in PARAMS if params is None else (params,):
        if (root / name).is_dir():
            return root / name
    wanted = " or ".join(PARAMS) if params is None else params
    raise InputError(
        f"{root}: expected body parameters in {wanted}, found no such folder; "
        f"add it or name the folder that holds them"
    )


def _poses(track: Path, numbers: list[int], body: BodyModel) -> dict[int, BodyPose]:
    """Pose of each frame that has a file."""
    files = {int(p.stem): p for p in track.glob("*.npy") if p.stem.isdecimal()}
    return {n: _pose(files[n], body) for n in numbers if n in files}


def _pose(path: Path, body: BodyModel) -> BodyPose:
    """Body of one frame, checked."""
    stored = read_npy_object(path)
    missing = {"poses", "Rh", "Th", "shapes"} - set(stored if isinstance(stored, dict) else ())
    if missing:
        raise InputError(
            f"{path}: expected a dict with poses, Rh, Th and shapes, found no "
            f"{', '.join(sorted(missing))}; export the frame again"
        )
    poses, Rh, Th, betas = (
        _finite(path, key, stored[key]) for key in ("poses", "Rh", "Th", "shapes")
    )
    if poses.numel() != 3 * body.num_joints:
        raise InputError(
            f"{path}: expected poses of {3 * body.num_joints} numbers ({body.num_joints} joints of "
            f"the body), found {poses.numel()}; use the body that the poses were fitted with"
        )
    if Rh.numel() != 3 or Th.numel() != 3:
        raise InputError(
            f"{path}: expected 3 numbers in Rh (axis-angle) and Th, found {Rh.numel()} and "
            f"{Th.numel()}; export the frame again"
        )
    if betas.numel() > body.num_betas:
        raise InputError(
            f"{path}: expected at most {body.num_betas} shapes (the body's), found "
            f"{betas.numel()}; use the body that the shapes were fitted with"
        )
    return BodyPose(poses.reshape(-1, 3), betas, Rh, Th)


def _finite(path: Path, key: str, value: Any) -> torch.Tensor:
    """One entry of a frame's dict, flat, float32."""
    try:
        array = np.asarray(value, dtype=np.float32).reshape(-1)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{path}: expected numbers in {key}, found {type(value).__name__}; export it again"
        ) from error
    if not np.isfinite(array).all():
        raise InputError(
            f"{path}: expected finite numbers in {key}, found NaN or infinity; export the frame "
            f"again or take it out of annots.npy and splits.json"
        )
    return torch.from_numpy(array.copy())


def _frames(root: Path, pictures: Pictures, splits: dict[str, Split]) -> dict[Any, Frame]:
    """Files of every picture; those that a split names must exist."""
    folders = [root / name for name in MASKS if (root / name).is_dir()]
    if not folders:
        raise InputError(
            f"{root}: expected masks in {', '.join(MASKS)}, found no such folder; add the masks"
        )
    if "train" not in splits:
        raise InputError(
            f"{root}: expected images with body parameters to train on, found none; add the "
            f"parameters, named by frame number"
        )
    relative = _mask_layout(folders[0], pictures[splits["train"].pairs()[0]])
    frames = {
        (c, f): Frame(f, c, root / name, folders[0] / relative(name))
        for (c, f), name in pictures.items()
    }
    for name, split in splits.items():
        for pair in split.pairs():
            _check_exists(frames[pair], name)
    return frames


def _mask_layout(folder: Path, example: str) -> Any:
    """How the path of a mask follows from that of its image, seen on one example."""

    def same(name: str) -> Path:
        return Path(name).with_suffix(".png")

    def without_images(name: str) -> Path:
        path = same(name)
        return Path(*path.parts[1:]) if path.parts[0] == "images" else path

    return same if (folder / same(example)).is_file() else without_images


def _check_exists(frame: Frame, split: str) -> None:
    """Refuses a picture whose files are not there."""
    for kind, path in (("image", frame.image_path), ("mask", frame.mask_path)):
        if not path.is_file():
            raise InputError(
                f"{path}: expected the {kind} of camera {frame.camera}, frame {frame.index} "
                f"({split}), found no file; add it or take it out of splits.json"
            )


def _image_size(
    frames: dict[Any, Frame], train: Split, root: Path, stored: tuple[int, ...] | None
) -> tuple[int, int]:
    """(height, width) of the first training image; what `splits.json` states must agree."""
    first = frames[train.pairs()[0]].image_path
    height, width = read_image(first).shape[:2]
    if stored is not None and sorted(stored) != sorted((height, width)):
        raise InputError(
            f"{root / 'splits.json'}: expected image_size as the images have it "
            f"({describe_size((height, width))}, {first.name}), found {list(stored)}; correct it, "
            f"and K with it, to the stored images"
        )
    return height, width


def _vertex_paths(root: Path, track: str, poses: dict[int, BodyPose]) -> dict[int, Path]:
    """Stored vertices that belong to the track: new_params → new_vertices and so on."""
    folder = root / track.replace("params", "vertices")
    if folder.name == track or not folder.is_dir():
        return {}
    files = {int(p.stem): p for p in folder.glob("*.npy") if p.stem.isdecimal()}
    return {n: files[n] for n in poses if n in files}


def _check_vertices(record: CaptureRecord) -> None:
    """Refuses a body that is not the one of the stored vertices."""
    for frame in record.splits["train"].frames:
        if frame in record.vertex_paths:
            count = read_vertices(record.vertex_paths[frame]).shape[0]
            if count != record.body.num_verts:
                raise InputError(
                    f"{record.vertex_paths[frame]}: expected {record.body.num_verts} vertices as "
                    f"the body has, found {count}; give the body file that made them (body.npz)"
                )
            return
