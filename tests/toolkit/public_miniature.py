"""Tiny synthetic captures with the layouts and quirks of ZJU-MoCap (refined) and MonoCap.

All cameras and frames of a subject's protocol are there, in images of a few pixels: translations in
millimetres, frames numbered by file stems that are not their places in the list (`annots.npy` lists
every fifth frame, two subjects start at 1), colour-coded masks under `schp/` for the training
camera and labels under `mask_cihp/` for the others, and a second, wrong body track beside the right
one. As in `miniature`, nothing here uses the code under test.
"""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from miniature import _camera, _params, _write_object, pose_body, read_default_body

SIZE = (30, 36)
"""(height, width) of the stored images."""
PALETTE = np.array([[0, 0, 128], [0, 128, 0], [128, 128, 0], [0, 0, 64]], np.uint8)
"""Colours (BGR) of parts on a colour-coded mask; the background is black."""


def _ring(count: int) -> list[dict[str, np.ndarray]]:
    """Cameras on a circle around the actor, each with its own focal length and lens."""
    cameras = []
    for i in range(count):
        camera = _camera(2 * np.pi * i / count, SIZE[0])
        camera["K"][0, 2] += (SIZE[1] - SIZE[0]) / 2
        camera["K"][:2] *= np.array([[1 + 0.001 * i], [1 + 0.002 * i], [1]])[:2]
        camera["D"] = np.array([-0.05, 0.01, 0.001, -0.001, 0.0], np.float64)[:, None]
        cameras.append(camera)
    return cameras


def draw(
    verts: np.ndarray, camera: dict[str, np.ndarray], shades: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Image (BGR) of SIZE and the mask of its vertices, 0/255, far ones first."""
    rvec, tvec = cv2.Rodrigues(camera["R"])[0], camera["T"]
    pixels = cv2.projectPoints(verts, rvec, tvec, camera["K"], camera["D"])[0].reshape(-1, 2)
    order = np.argsort(-(verts @ camera["R"].T + tvec.T)[:, 2], kind="stable")
    at = np.rint(pixels[order]).astype(int)
    inside = ((at >= 0) & (at < SIZE[::-1])).all(axis=1)
    at, order = at[inside], order[inside]
    image, mask = np.full((*SIZE, 3), 40, np.uint8), np.zeros(SIZE, np.uint8)
    image[at[:, 1], at[:, 0]] = shades[order]
    mask[at[:, 1], at[:, 0]] = 255
    return image, cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))


def _write_mask(root: Path, name: str, mask: np.ndarray, colored: bool) -> None:
    """A mask in colours per part, or in labels with 0 as background."""
    place = Path(name).with_suffix(".png")
    path = root / "mask_cihp" / place
    stored = mask // 255 * 7
    if colored:
        path = root / "schp" / place.relative_to("images")
        part = np.arange(mask.shape[0])[:, None] * len(PALETTE) // mask.shape[0]
        stored = np.where(mask[..., None] > 0, PALETTE[part], np.uint8(0))
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), stored)


def _write_track(root: Path, name: str, frame: int, params: dict, verts: np.ndarray) -> None:
    for folder in (root / name, root / name.replace("params", "vertices")):
        folder.mkdir(exist_ok=True)
    _write_object(root / name / f"{frame}.npy", params)
    vertices = root / name.replace("params", "vertices")
    np.save(vertices / f"{frame}.npy", verts.astype(np.float32))


def write_subject(
    root: Path,
    protocol: dict[str, Any],
    later: int = 2,
    lens: bool = True,
    shades: int = 6,
) -> Path:
    """Write a subject of a public data set.

    Args:
        root: folder to write; its name is how a reader recognises it.
        protocol: `cameras` (their number), `train` (camera), `test` (cameras), `first` (frame),
            `track` (right body track), `decoy` (another one).
        later: number of frames after the hundred that train.
        lens: cameras have distortion.
        shades: different poses; frames repeat them.

    Returns:
        `root`.
    """
    root.mkdir(parents=True)
    body, rng = read_default_body(), np.random.default_rng(3)
    low = float(body["v_template"][:, 1].min())
    poses = [_params(rng, i, -low) for i in range(shades)]
    bodies = [pose_body(body, p) for p in poses]
    tint = (60 + 190 * (np.arange(len(bodies[0])) % 7) / 6).astype(np.uint8)[:, None]
    cameras = _ring(protocol["cameras"])
    if not lens:
        for camera in cameras:
            camera["D"] *= 0
    frames = [protocol["first"] + 5 * k for k in range(100 + later)]
    compared = set(frames[:100:6]) | set(frames[100:])
    ims = []
    for frame in frames:
        ims.append({"ims": [f"images/{c:02d}/{frame:06d}.jpg" for c in range(len(cameras))]})
        params, verts = poses[frame % shades], bodies[frame % shades]
        _write_track(root, protocol["track"], frame, params, verts)
        wrong = {**params, "Th": params["Th"] + np.float32(0.5)}
        _write_track(root, protocol["decoy"], frame, wrong, verts + 0.5)
        seen = set(protocol["test"]) if frame in compared else set()
        for c in sorted({protocol["train"], *seen}):
            image, mask = draw(verts, cameras[c], tint)
            path = root / ims[-1]["ims"][c]
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 98])
            _write_mask(root, ims[-1]["ims"][c], mask, colored=c == protocol["train"])
    cams = {key: [c[key] for c in cameras] for key in "KDR"}
    cams["D"] = [d.reshape(-1) for d in cams["D"]]
    cams["T"] = [1000 * c["T"] for c in cameras]
    _write_object(root / "annots.npy", {"cams": cams, "ims": ims})
    return root


ZJU = {
    "cameras": 23,
    "train": 4,
    "test": [c for c in range(23) if c != 4],
    "first": 0,
    "track": "smpl_params",
    "decoy": "params",
}
"""A subject of the refined ZJU-MoCap."""
VLAD = {
    "cameras": 101,
    "train": 66,
    "test": list(range(0, 101, 10)),
    "first": 1,
    "track": "params",
    "decoy": "smpl_params",
}
"""The subject `vlad` of MonoCap."""


def state(root: Path, **entries: Any) -> Path:
    """Write a capture.json."""
    (root / "capture.json").write_text(json.dumps(entries), encoding="utf-8")
    return root
