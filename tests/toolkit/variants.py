"""The same capture stated in another way: moved, scaled, mirrored, renumbered, cropped, enlarged.

Like the miniature, nothing here uses the code under test: files go in, files come out.
"""

import dataclasses
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from miniature import NAMES, read_default_body

Change = Callable[["Stated"], None]
SIDES = ((1, 2), (4, 5), (7, 8), (10, 11), (13, 14), (16, 17), (18, 19), (20, 21), (22, 23))
"""Left and right joints of the default body."""


@dataclass
class Stated:
    """What the files of a capture say; lengths in metres."""

    cams: dict[str, list[np.ndarray]]
    params: dict[int, dict[str, np.ndarray]]
    verts: dict[int, np.ndarray]
    views: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]
    splits: dict[str, Any]
    body: dict[str, np.ndarray]


def restated(source: Path, target: Path, change: Change, ending: str = "jpg") -> Path:
    """Write another statement of a capture of `write_miniature`; images become lossless.

    Args:
        source: the capture.
        target: folder to write.
        change: what to change.
        ending: of the source's images: "png" where it is itself a restated one.
    """
    stated = _read(source, ending)
    change(stated)
    shutil.rmtree(target, ignore_errors=True)
    for folder in ("new_params", "new_vertices", *NAMES, *(f"mask/{n}" for n in NAMES)):
        (target / folder).mkdir(parents=True)
    frames = sorted(stated.params)
    ims = [{"ims": [f"{name}/{frame:06d}.png" for name in NAMES]} for frame in frames]
    cams = {**stated.cams, "T": [1000 * t for t in stated.cams["T"]]}
    _save(target / "annots.npy", {"cams": cams, "ims": ims})
    for frame in frames:
        _save(target / "new_params" / f"{frame}.npy", stated.params[frame])
        np.save(target / "new_vertices" / f"{frame}.npy", stated.verts[frame].astype(np.float32))
    for (camera, frame), (image, mask) in stated.views.items():
        cv2.imwrite(str(target / NAMES[camera] / f"{frame:06d}.png"), image)
        cv2.imwrite(str(target / "mask" / NAMES[camera] / f"{frame:06d}.png"), mask)
    (target / "splits.json").write_text(json.dumps(stated.splits), encoding="utf-8")
    np.savez(target / "body.npz", **stated.body)
    return target


def _read(root: Path, ending: str) -> Stated:
    annots = np.load(root / "annots.npy", allow_pickle=True).item()
    cams = annots["cams"] | {"T": [t / 1000 for t in annots["cams"]["T"]]}
    frames = range(len(annots["ims"]))
    views = {}
    for camera, name in enumerate(NAMES):
        for frame in frames:
            image = cv2.imread(str(root / name / f"{frame:06d}.{ending}"))
            mask = cv2.imread(str(root / "mask" / name / f"{frame:06d}.png"), cv2.IMREAD_UNCHANGED)
            views[camera, frame] = image, mask
    return Stated(
        cams=cams,
        params={
            f: np.load(root / "new_params" / f"{f}.npy", allow_pickle=True).item() for f in frames
        },
        verts={f: np.load(root / "new_vertices" / f"{f}.npy").astype(np.float64) for f in frames},
        views=views,
        splits=json.loads((root / "splits.json").read_text(encoding="utf-8")),
        body=read_default_body(),
    )


def _save(path: Path, value: Any) -> None:
    box = np.zeros((), dtype=object)
    box[()] = value
    np.save(path, box, allow_pickle=True)


def as_it_is(stated: Stated) -> None:
    """Change nothing."""


def moved(axis_angle: tuple[float, ...], shift: tuple[float, ...]) -> Change:
    """The world turned and shifted, cameras and bodies together: x becomes Q x + s."""
    turn, place = cv2.Rodrigues(np.array(axis_angle, float))[0], np.array(shift, float)

    def change(stated: Stated) -> None:
        cams = stated.cams
        cams["R"] = [R @ turn.T for R in cams["R"]]
        cams["T"] = [T - (R @ place)[:, None] for R, T in zip(cams["R"], cams["T"], strict=True)]
        for frame, params in stated.params.items():
            heading = turn @ cv2.Rodrigues(params["Rh"].astype(np.float64).reshape(3))[0]
            params["Rh"] = cv2.Rodrigues(heading)[0].T
            params["Th"] = (turn @ params["Th"].reshape(3) + place)[None]
            stated.verts[frame] = stated.verts[frame] @ turn.T + place

    return change


def scaled(factor: float) -> Change:
    """Every length in another unit: 1000 states the capture in millimetres."""

    def change(stated: Stated) -> None:
        stated.cams["T"] = [factor * t for t in stated.cams["T"]]
        for frame, params in stated.params.items():
            params["Th"] = factor * params["Th"].astype(np.float64)
            stated.verts[frame] = factor * stated.verts[frame]
        for name in ("v_template", "shapedirs", "posedirs"):
            stated.body[name] = (factor * stated.body[name].astype(np.float64)).astype(np.float32)

    return change


def mirrored(stated: Stated) -> None:
    """World, body and pictures seen in a mirror: x becomes -x, left becomes right."""
    flip, swap = np.array([-1.0, 1, 1]), list(range(24))
    for left, right in SIDES:
        swap[left], swap[right] = right, left
    width = stated.views[0, 0][0].shape[1]
    cams = stated.cams
    cams["R"] = [flip[:, None] * R * flip for R in cams["R"]]
    cams["T"] = [flip[:, None] * T for T in cams["T"]]
    for K in cams["K"]:
        K[0, 2] = width - 1 - K[0, 2]  # pixel centres at whole numbers
    turns = np.array([1.0, -1, -1])  # axes are pseudovectors
    for frame, params in stated.params.items():
        poses = params["poses"].reshape(24, 3)[swap] * turns
        params["poses"] = poses.reshape(1, 72)
        params["Rh"], params["Th"] = params["Rh"] * turns, params["Th"] * flip
        stated.verts[frame] = stated.verts[frame] * flip
    body = stated.body
    body["v_template"] = body["v_template"] * flip.astype(np.float32)
    body["shapedirs"] = body["shapedirs"] * flip.astype(np.float32)[:, None]
    body["weights"], body["J_regressor"] = body["weights"][:, swap], body["J_regressor"][swap]
    body["f"], body["ft"] = body["f"][:, [0, 2, 1]], body["ft"][:, [0, 2, 1]]
    if body["posedirs"].any():
        raise ValueError("mirrored: pose blend shapes are not mirrored here")
    stated.views = {
        v: (np.ascontiguousarray(image[:, ::-1]), np.ascontiguousarray(mask[:, ::-1]))
        for v, (image, mask) in stated.views.items()
    }


def renumbered(numbers: tuple[int, ...]) -> Change:
    """Frames with other numbers; the splits list the same frames in the same order."""

    def change(stated: Stated) -> None:
        stated.params = {numbers[f]: p for f, p in stated.params.items()}
        stated.verts = {numbers[f]: v for f, v in stated.verts.items()}
        stated.views = {(c, numbers[f]): view for (c, f), view in stated.views.items()}
        for split in stated.splits.values():
            if isinstance(split, dict):
                split["frames"] = [numbers[f] for f in split["frames"]]

    return change


def cropped(left: int, top: int, right: int, bottom: int) -> Change:
    """Every picture cut (or, where negative, widened by a border), and K with it."""

    def change(stated: Stated) -> None:
        for K in stated.cams["K"]:
            K[0, 2] -= left
            K[1, 2] -= top
        stated.views = {v: tuple(map(cut, view)) for v, view in stated.views.items()}
        stated.splits["image_size"] = list(stated.views[0, 0][0].shape[:2])

    def cut(picture: np.ndarray) -> np.ndarray:
        wide = np.pad(picture, [(9, 9), (9, 9)] + [(0, 0)] * (picture.ndim - 2))
        height, width = picture.shape[:2]
        return np.ascontiguousarray(
            wide[9 + top : 9 + height - bottom, 9 + left : 9 + width - right]
        )

    return change


def enlarged(factor: int) -> Change:
    """Every pixel a square of pixels, and K with it."""

    def change(stated: Stated) -> None:
        for K in stated.cams["K"]:
            K[:2, :2] *= factor
            K[:2, 2] = (K[:2, 2] + 0.5) * factor - 0.5
        stated.views = {
            v: tuple(p.repeat(factor, 0).repeat(factor, 1) for p in view)
            for v, view in stated.views.items()
        }
        stated.splits["image_size"] = list(stated.views[0, 0][0].shape[:2])

    return change


def in_units(config: Any, factor: float) -> Any:
    """The configuration for a capture of `scaled`: lengths times, densities over the factor."""
    geometry, field, loss = config.geometry, config.field, config.loss
    return dataclasses.replace(
        config,
        geometry=dataclasses.replace(
            geometry,
            radius=factor * geometry.radius,
            voxel=factor * geometry.voxel,
            step=factor * geometry.step,
            canonical_margin=factor * geometry.canonical_margin,
        ),
        field=dataclasses.replace(
            field, finest=factor * field.finest, sharpness=field.sharpness / factor
        ),
        deform=dataclasses.replace(config.deform, scale=factor * config.deform.scale),
        loss=dataclasses.replace(
            loss,
            consistency=loss.consistency / factor,
            consistency_threshold=factor * loss.consistency_threshold,
        ),
    )
