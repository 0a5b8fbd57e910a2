"""Checks of a capture beyond what reading it shows, and its plain facts."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from monopart.geometry.errors import InputError

from .frames import Split
from .images import describe_size
from .records import CaptureRecord, Progress, check_not_empty, run_all

MAX_VERTEX_ERROR = 5e-3
"""Metres between stored and posed vertices from which on conventions must differ."""
MIN_ON_MASK = 0.2
"""Share of the body's vertices that must fall on the mask; a sound track has 0.9 and more."""


@dataclass(frozen=True)
class CaptureCheck:
    """What `check_capture` looked at and measured; None where it did not measure."""

    images: int
    """Images and masks opened."""
    files: int
    """Images and masks whose files are there."""
    vertex_error: float | None = None
    """Largest distance of stored to posed vertices of the first frame, metres."""
    on_mask: float | None = None
    """Share of the first frame's vertices that fall on its mask."""
    coverage: float | None = None
    """Mean share of the training images that is mask."""


def check_capture(
    record: CaptureRecord,
    deep: bool = False,
    progress: Progress | None = None,
    masks: Bool[Tensor, "n h w"] | None = None,
) -> CaptureCheck:
    """Look for what would spoil a training run.

    Args:
        record: the capture.
        deep: also open every training image and mask (readable, of one size, mask not empty), and
            compare the first frame's body with the stored vertices and the mask.
        progress: called with (done, total) after each image.
        masks: masks of the training images where a caller has read them already; no image is then
            opened again.

    Returns:
        What was looked at and measured.

    Raises:
        InputError: the first fault found, in one line that names the file and the fix.
    """
    files = 0
    for split in record.splits.values():
        for pair in split.pairs():
            _check_files(record, pair)
            files += 1
    if not deep:
        return CaptureCheck(images=0, files=files)
    pairs = record.split("train").pairs()
    covered = [0.0] * len(pairs)

    def mask_of(i: int) -> Tensor:
        return record.mask(*pairs[i]) if masks is None else masks[i]

    def look(i: int) -> None:
        covered[i] = _coverage(record, pairs[i], mask_of(i))

    run_all(look, len(pairs), progress)
    return CaptureCheck(
        images=len(pairs),
        files=files,
        vertex_error=_vertex_error(record),
        on_mask=_on_mask(record, pairs[0], mask_of(0)),
        coverage=sum(covered) / len(covered),
    )


def describe(record: CaptureRecord) -> dict[str, Any]:
    """Plain facts of a capture, ready for JSON or a table; opens no image.

    Args:
        record: the capture.

    Returns:
        Name, folder, counts, sizes, splits, body, distortion, range of the poses.
    """
    body = record.body
    return {
        "name": record.name,
        "folder": str(record.root),
        "frames": len({f for _, f in record.frames}),
        "cameras": list(record.camera_names),
        "subject": record.subject,
        "image_size": list(record.image_size),
        "stored_size": list(record.stored_size),
        "test_size": list(record.for_test().image_size),
        "fps": record.fps,
        "splits": {name: _split_facts(split) for name, split in record.splits.items()},
        "body": {
            "vertices": body.num_verts,
            "faces": int(body.faces.shape[0]),
            "joints": body.num_joints,
            "betas": body.num_betas,
            "uv": body.uv is not None,
        },
        "params": record.params,
        "stored_vertices": len(record.vertex_paths),
        "distortion": {
            name: float(camera.distortion.abs().max()) if camera.is_distorted else 0.0
            for name, camera in zip(record.camera_names, record.raw_cameras, strict=True)
        },
        "poses": _pose_facts(record),
    }


def _split_facts(split: Split) -> dict[str, Any]:
    return {
        "cameras": list(split.cameras),
        "frames": len(split.frames),
        "first_frame": min(split.frames, default=None),
        "last_frame": max(split.frames, default=None),
        "images": len(split.pairs()),
    }


def _pose_facts(record: CaptureRecord) -> dict[str, Any]:
    """Range of joint angles, way of the body and turn of its heading, over all frames in order."""
    track = [record.poses[n] for n in sorted(record.poses)]
    angles = torch.stack([p.pose for p in track]).norm(dim=-1)
    places = torch.stack([p.translation for p in track])
    spread = places.amax(dim=0) - places.amin(dim=0)
    return {
        "frames": len(track),
        "mean_joint_angle_deg": math.degrees(float(angles.mean())),
        "max_joint_angle_deg": math.degrees(float(angles.max())),
        "translation_extent_m": float(spread.norm()),
    }


def _check_files(record: CaptureRecord, pair: tuple[int, int]) -> None:
    frame = record.frame(*pair)
    for path in (frame.image_path, frame.mask_path):
        if not path.is_file():
            raise InputError(
                f"{path}: expected the file of camera {pair[0]}, frame {pair[1]}, found none; "
                f"restore it or take it out of splits.json"
            )


def _coverage(record: CaptureRecord, pair: tuple[int, int], on: Tensor) -> float:
    """Share of one training image that is mask; refuses none."""
    check_not_empty(record, pair, on)
    return float(on.to(torch.float32).mean())


def _vertex_error(record: CaptureRecord) -> float | None:
    """Largest distance of stored to posed vertices, metres, at the first training frame."""
    frame = record.split("train").frames[0]
    if frame not in record.vertex_paths:
        return None
    stored, posed = record.vertices(frame), _verts_world(record, frame)
    if stored.shape != posed.shape:
        raise InputError(
            f"{record.vertex_paths[frame]}: expected {posed.shape[0]} vertices as the body has, "
            f"found {stored.shape[0]}; give the body file that made them (body.npz)"
        )
    error = float((stored - posed).norm(dim=-1).max())
    if not error <= MAX_VERTEX_ERROR:
        raise InputError(
            f"{record.vertex_paths[frame]}: expected the vertices of {record.params}/{frame}.npy "
            f"within {1000 * MAX_VERTEX_ERROR:g} mm, found {1000 * error:.0f} mm; use the body of "
            f"the fit, Rh and Th about the model origin (not the pelvis), metres, world axes"
        )
    return error


def _on_mask(record: CaptureRecord, pair: tuple[int, int], on: Tensor) -> float:
    """Share of the body's vertices that fall on the mask."""
    share, seen = share_on_mask(record, pair, on)
    if share < MIN_ON_MASK:
        inside = 100 * len(seen) / record.body.num_verts
        raise InputError(
            f"{record.root / 'annots.npy'}: expected the body of frame {pair[1]} on the mask of "
            f"camera {pair[0]}, found {100 * share:.0f} % of it there ({inside:.0f} % in the "
            f"image); check that T is in millimetres, R is world to camera, K is for "
            f"{describe_size(record.image_size)}"
        )
    return share


def share_on_mask(
    record: CaptureRecord, pair: tuple[int, int], on: Bool[Tensor, "h w"]
) -> tuple[float, Float[Tensor, "n 2"]]:
    """Share of the body's vertices that fall on a mask, and the pixels of those in the image.

    Args:
        record: the capture.
        pair: camera and frame.
        on: the mask.
    """
    camera, verts = record.cameras[pair[0]], _verts_world(record, pair[1])
    pixels = camera.project(verts)[0][camera.visible(verts)].cpu()
    column, row = pixels.floor().long().unbind(-1)
    return float(on[row, column].sum()) / len(verts), pixels


def _verts_world(record: CaptureRecord, frame: int) -> Float[Tensor, "v 3"]:
    return record.body(record.poses[frame]).verts_world
