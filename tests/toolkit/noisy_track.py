"""A capture with a second body track that errs like that of `actor_a`, to choose what refines it.

    python tests/toolkit/noisy_track.py CAPTURE OUT --seed 7

The files of the capture are linked; `new_params_noisy` is its exact track with a slow drift and
independent noise on joint angles, Rh and Th, in the sizes that the README of `actor_a` states.
"""

from pathlib import Path

import numpy as np
import torch
import tyro
from tyro.conf import Positional

from monopart.geometry.body_io import read_npy_object
from monopart.geometry.rotations import axis_angle_to_rotmat, rotmat_to_axis_angle
from monopart.toolkit.corrections import error_covariance

TRACK, NOISY = "new_params", "new_params_noisy"
JOINTS, ROOT, SHIFT = 0.0204, 0.0185, 0.0073  # rad, rad, m: standard deviations of a coordinate
FPS, DRIFT, JITTER = 12.0, 0.5, 0.25


def turned(turn: np.ndarray, given: np.ndarray) -> np.ndarray:
    """Axis-angle of R(turn) R(given), [N, 3]."""
    both = (axis_angle_to_rotmat(torch.from_numpy(a.astype(np.float64))) for a in (turn, given))
    first, second = both
    return rotmat_to_axis_angle(first @ second).numpy()


def main(capture: Positional[Path], out: Positional[Path], seed: int = 7) -> None:
    """Write the capture.

    Args:
        capture: a capture in ZJU-MoCap layout with an exact track.
        out: new folder.
        seed: of the noise.
    """
    out.mkdir(parents=True)
    for path in capture.iterdir():
        if path.name != NOISY:
            (out / path.name).symlink_to(path.resolve())
    (out / NOISY).mkdir()
    names = sorted((capture / TRACK).glob("*.npy"), key=lambda p: int(p.stem))
    times = torch.tensor([int(p.stem) for p in names]) / FPS
    covariance = error_covariance(times, DRIFT, JITTER).numpy()
    root = np.linalg.cholesky(covariance + 1e-9 * np.eye(len(names)))
    noise = root @ np.random.default_rng(seed).standard_normal((len(names), 78))
    for path, row in zip(names, noise, strict=True):
        exact = read_npy_object(path)
        joints = exact["poses"].reshape(-1, 3).copy()
        joints[1:] = turned(JOINTS * row[: joints.size].reshape(-1, 3)[1:], joints[1:])
        wrong = {
            **exact,
            "poses": joints.reshape(1, -1).astype(np.float32),
            "Rh": turned(ROOT * row[None, 72:75], exact["Rh"]).astype(np.float32),
            "Th": (exact["Th"] + SHIFT * row[75:]).astype(np.float32),
        }
        np.save(out / NOISY / path.name, np.array(wrong, dtype=object), allow_pickle=True)


if __name__ == "__main__":
    tyro.cli(main)
