"""The body track of the ZJU-MoCap layout: body, pose and stored vertices of every frame."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.body_io import read_npy_object
from monopart.geometry.errors import InputError

from .images import read_vertices
from .records import CaptureRecord
from .subjects import Subject

PARAMS = ("new_params", "params", "smpl_params")
"""Folders of body parameters, the first that exists is read."""


def read_body(root: Path, body: str | Path | None) -> BodyModel:
    """The body named, the capture's own, or the one that ships with the package."""
    own = root / "body.npz"
    if body is not None:
        return BodyModel.load(body)
    return BodyModel.load(own) if own.is_file() else BodyModel.default()


def track_folder(root: Path, params: str | None, person: Subject | None = None) -> Path:
    """Folder of the body parameters: the one named, else the first of the subject's or usual ones.

    Args:
        root: folder of the capture.
        params: name of the folder.
        person: the subject, where the capture is one.

    Raises:
        InputError: no such folder.
    """
    names = PARAMS if person is None else person.params
    names = names if params is None else (params,)
    for name in names:
        if (root / name).is_dir():
            return root / name
    wanted = " or ".join(names)
    raise InputError(
        f"{root}: expected body parameters in {wanted}, found no such folder; "
        f"add it or name the folder that holds them"
    )


def read_poses(track: Path, numbers: list[int], body: BodyModel) -> dict[int, BodyPose]:
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


def vertex_paths_of(root: Path, track: str, poses: dict[int, BodyPose]) -> dict[int, Path]:
    """Stored vertices that belong to the track: new_params → new_vertices and so on."""
    folder = root / track.replace("params", "vertices")
    if folder.name == track or not folder.is_dir():
        return {}
    files = {int(p.stem): p for p in folder.glob("*.npy") if p.stem.isdecimal()}
    return {n: files[n] for n in poses if n in files}


def check_vertices(record: CaptureRecord) -> None:
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
