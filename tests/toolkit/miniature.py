"""A tiny synthetic capture in ZJU-MoCap layout, with faults on request.

Nothing here uses the code under test: the body is posed by plain float64 numpy loops and drawn
through OpenCV's own ``projectPoints``: a reader that gets a convention wrong cannot agree with it.
"""

import functools
import importlib.resources
import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np

NAMES = ("Camera_B1", "Camera_B2")
FAULTS = {
    "missing_image": "(camera, frame): no such image file",
    "missing_mask": "(camera, frame): no such mask file",
    "mask_size": "(camera, frame): the mask is twice as large",
    "image_size": "(camera, frame): the image is twice as large",
    "empty_mask": "(camera, frame): the mask is all zero",
    "corrupt_image": "(camera, frame): the image file holds text",
    "truncated_image": "(camera, frame): the image file is cut in half",
    "nan_pose": "frame: one angle of the pose is NaN",
    "wrong_joints": "frame: the pose has 23 joints",
    "no_shapes": "frame: the dict lacks 'shapes'",
    "drop_camera": "True: one camera fewer than images per frame",
    "few_vertices": "True: new_vertices hold 100 vertices",
    "vertices_shift": "metres: new_vertices are moved by this much along x",
    "evil_annots": "path: annots.npy creates that file when it is unpickled with code execution",
    "evil_params": "(frame, path): new_params/<frame>.npy does the same",
    "split_camera": "True: splits.json names camera 7",
    "split_frame": "True: splits.json names frame 99",
    "principal_point": "(cx, cy) written for camera 0",
    "rotation": "3x3 array written as R of camera 0",
    "metres": "True: T is written in metres",
}


class _Evil:
    """Unpickling this creates a file: the test looks whether it is there."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return (os.mkdir, (self.path,))


def _rotmat(axis_angle: np.ndarray) -> np.ndarray:
    """Rodrigues, by OpenCV."""
    return cv2.Rodrigues(np.asarray(axis_angle, np.float64))[0]


def read_default_body() -> dict[str, np.ndarray]:
    """The arrays of the body that the package ships."""
    asset = importlib.resources.files("monopart.geometry") / "assets" / "body.npz"
    with np.load(str(asset)) as arrays:
        return {key: arrays[key] for key in arrays.files}


def pose_body(body: dict[str, np.ndarray], params: dict[str, np.ndarray]) -> np.ndarray:
    """World vertices (V, 3) of a body, float64, one joint at a time."""
    rest = body["v_template"].astype(np.float64)
    betas = params["shapes"].reshape(-1).astype(np.float64)
    rest = rest + body["shapedirs"].astype(np.float64)[..., : len(betas)] @ betas
    joints = body["J_regressor"].astype(np.float64) @ rest
    angles = params["poses"].reshape(-1, 3).astype(np.float64)
    parents = body["kintree_table"][0].astype(np.int64)
    rotations: list[np.ndarray] = []
    origins: list[np.ndarray] = []
    for j in range(len(joints)):
        if j == 0:
            rotations.append(_rotmat(angles[0]))
            origins.append(joints[0])
        else:
            p = int(parents[j])
            rotations.append(rotations[p] @ _rotmat(angles[j]))
            origins.append(origins[p] + rotations[p] @ (joints[j] - joints[p]))
    posed = np.zeros_like(rest)
    for j in range(len(joints)):
        moved = (rest - joints[j]) @ rotations[j].T + origins[j]
        posed += body["weights"][:, j : j + 1].astype(np.float64) * moved
    return posed @ _rotmat(params["Rh"].reshape(3)).T + params["Th"].reshape(3)


def _camera(angle: float, size: int) -> dict[str, np.ndarray]:
    """A camera 3 m from the actor, at hip height, seen from ``angle``; T in metres here."""
    center = np.array([3.0 * np.sin(angle), -3.0 * np.cos(angle), 1.0])
    forward = np.array([0.0, 0.0, 0.9]) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    focal, middle = 1.2 * size, (size - 1) / 2
    K = np.array([[focal, 0, middle], [0, focal, middle + 0.5], [0, 0, 1]])
    return {"K": K, "R": R, "T": (-R @ center)[:, None], "D": np.zeros((5, 1))}


def _params(rng: np.random.Generator, frame: int, height: float) -> dict[str, np.ndarray]:
    poses = rng.normal(0, 0.12, (1, 72))
    poses[:, :3] = 0
    heading = _rotmat(np.array([0, 0, 0.3 * frame])) @ _rotmat(np.array([np.pi / 2, 0, 0]))
    return {
        "poses": poses.astype(np.float32),
        "Rh": cv2.Rodrigues(heading)[0].T.astype(np.float32),
        "Th": np.array([[0.02 * frame, 0, height]], np.float32),
        "shapes": np.linspace(-0.5, 0.5, 10, dtype=np.float32)[None],
    }


def _dots(values: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Ten points on every triangle, so that the dots of small images leave no holes."""
    steps = [(i, j, 3 - i - j) for i in range(4) for j in range(4 - i)]
    bary = np.array(steps, np.float64) / 3
    return (bary @ values[faces].astype(np.float64)).reshape(-1, 3)


def _draw(
    verts: np.ndarray, colors: np.ndarray, camera: dict[str, np.ndarray], size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Image (size, size, 3) BGR and mask (size, size) 0/255: one pixel per dot, far ones first."""
    rvec, tvec, K = cv2.Rodrigues(camera["R"])[0], camera["T"], camera["K"]
    pixels = cv2.projectPoints(verts, rvec, tvec, K, camera["D"])[0].reshape(-1, 2)
    depth = (verts @ camera["R"].T + tvec.T)[:, 2]
    order = np.argsort(-depth, kind="stable")
    at = np.rint(pixels[order]).astype(int)
    inside = ((at >= 0) & (at < size)).all(axis=1) & (depth[order] > 0.1)
    at, order = at[inside], order[inside]
    mask = np.zeros((size, size), np.uint8)
    image = np.full((size, size, 3), (96, 80, 64), np.uint8)
    mask[at[:, 1], at[:, 0]] = 255
    image[at[:, 1], at[:, 0]] = colors[order]
    return image, mask


@functools.lru_cache(8)
def _scene(frames: int, size: int, distortion: tuple[float, ...]) -> tuple[list, list, dict]:
    """Cameras, (params, verts) per frame and {(camera, frame): (image, mask)}, read only."""
    rng, body = np.random.default_rng(7), read_default_body()
    template, faces = body["v_template"], body["f"]
    low, high = template.min(axis=0), template.max(axis=0)
    colors = 60 + 190 * (_dots(template, faces) - low) / (high - low)
    cameras = [_camera(angle, size) for angle in (0.0, np.pi / 2)]
    for camera in cameras:
        if distortion:
            camera["D"] = np.array(distortion, np.float64)[:, None]
    bodies, views = [], {}
    for frame in range(frames):
        params = _params(rng, frame, float(-low[1]))
        verts = pose_body(body, params)
        bodies.append((params, verts))
        dots = _dots(verts, faces)
        for c, camera in enumerate(cameras):
            views[c, frame] = _draw(dots, colors, camera, size)
    return cameras, bodies, views


def _write_object(path: Path, value: Any) -> None:
    box = np.zeros((), dtype=object)
    box[()] = value
    np.save(path, box, allow_pickle=True)


def _write_cameras(root: Path, cameras: list[dict[str, np.ndarray]], faults: dict, n: int) -> None:
    kept = cameras[: len(cameras) - int(bool(faults.get("drop_camera")))]
    cams: dict[str, list[np.ndarray]] = {key: [c[key].copy() for c in kept] for key in "KDRT"}
    if not faults.get("metres"):
        cams["T"] = [1000 * t for t in cams["T"]]
    if "principal_point" in faults:
        cams["K"][0][:2, 2] = faults["principal_point"]
    if "rotation" in faults:
        cams["R"][0] = np.asarray(faults["rotation"], np.float64)
    ims = [{"ims": [f"{name}/{frame:06d}.jpg" for name in NAMES]} for frame in range(n)]
    value: Any = {"cams": cams, "ims": ims}
    if "evil_annots" in faults:
        value["cams"]["D"] = _Evil(str(faults["evil_annots"]))
    _write_object(root / "annots.npy", value)


def _write_body(root: Path, frame: int, params: dict, verts: np.ndarray, faults: dict) -> None:
    stored: dict[str, Any] = dict(params)
    if faults.get("nan_pose") == frame:
        stored["poses"] = params["poses"].copy()
        stored["poses"][0, 17] = np.nan
    if faults.get("wrong_joints") == frame:
        stored["poses"] = params["poses"][:, :69]
    if faults.get("no_shapes") == frame:
        del stored["shapes"]
    if "evil_params" in faults and faults["evil_params"][0] == frame:
        stored["Rh"] = _Evil(str(faults["evil_params"][1]))
    _write_object(root / "new_params" / f"{frame}.npy", stored)
    shifted = verts + np.array([faults.get("vertices_shift", 0.0), 0, 0])
    kept = shifted[:100] if faults.get("few_vertices") else shifted
    np.save(root / "new_vertices" / f"{frame}.npy", kept.astype(np.float32))


def _write_view(
    root: Path, view: tuple[int, int], image: np.ndarray, mask: np.ndarray, faults: dict
) -> None:
    camera, frame = view
    image_path = root / NAMES[camera] / f"{frame:06d}.jpg"
    mask_path = root / "mask" / NAMES[camera] / f"{frame:06d}.png"
    if faults.get("mask_size") == view:
        mask = np.kron(mask, np.ones((2, 2), np.uint8))
    if faults.get("image_size") == view:
        image = np.kron(image, np.ones((2, 2, 1), np.uint8))
    if faults.get("empty_mask") == view:
        mask = np.zeros_like(mask)
    if faults.get("missing_image") != view:
        cv2.imwrite(str(image_path), image, [cv2.IMWRITE_JPEG_QUALITY, 95])
    if faults.get("missing_mask") != view:
        cv2.imwrite(str(mask_path), mask)
    if faults.get("corrupt_image") == view:
        image_path.write_text("not an image")
    if faults.get("truncated_image") == view:
        data = image_path.read_bytes()
        image_path.write_bytes(data[: len(data) // 2])


def _write_splits(root: Path, frames: int, size: int, faults: dict) -> None:
    train = list(range(max(1, frames - 1)))
    cameras = [1, 7] if faults.get("split_camera") else [1]
    last = [99] if faults.get("split_frame") else [frames - 1]
    splits = {
        "train": {"cameras": [0], "frames": train},
        "novel_view": {"cameras": cameras, "frames": train[::2]},
        "novel_pose": {"cameras": [0, 1], "frames": last},
        "image_size": [size, size],
        "fps": 6,
    }
    (root / "splits.json").write_text(json.dumps(splits), encoding="utf-8")


def write_miniature(
    path: Path,
    frames: int = 4,
    size: int = 32,
    distortion: tuple[float, ...] = (),
    splits: bool = True,
    **faults: Any,
) -> Path:
    """Write a capture of the default body: two cameras 90 degrees apart, a few frames.

    Camera 0 trains on all frames but the last; ``novel_view`` is camera 1, ``novel_pose`` the last
    frame.

    Args:
        path: folder to write, made if needed.
        frames: number of frames.
        size: height and width of the images.
        distortion: OpenCV coefficients of both cameras; the images are drawn with them.
        splits: write ``splits.json``.
        **faults: see ``FAULTS``.

    Returns:
        ``path``.
    """
    unknown = set(faults) - set(FAULTS)
    if unknown:
        raise ValueError(f"unknown faults {unknown}; known: {sorted(FAULTS)}")
    root = Path(path)
    for folder in ("new_params", "new_vertices", *NAMES, *(f"mask/{n}" for n in NAMES)):
        (root / folder).mkdir(parents=True, exist_ok=True)
    cameras, bodies, views = _scene(frames, size, distortion)
    _write_cameras(root, cameras, faults, frames)
    for frame, (params, verts) in enumerate(bodies):
        _write_body(root, frame, params, verts, faults)
    for view, (image, mask) in views.items():
        _write_view(root, view, image, mask, faults)
    if splits:
        _write_splits(root, frames, size, faults)
    return root
