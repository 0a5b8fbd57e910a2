"""Lenses and cameras of the stress, with the oracle of what each lens does."""

import math

import numpy as np
import torch

from monopart.geometry.cameras import Camera
from monopart.geometry.rotations import axis_angle_to_rotmat
from monopart.geometry.tilt import HORIZON

LENSES = {
    "pinhole": (),
    "usual lens": (-0.25, 0.11, 0.001, -0.0005, -0.02),
    "strong barrel": (-0.5, 0.1, 0.0, 0.0, 0.0),
    "strong pincushion": (0.6, 0.5, 0.0, 0.0, 0.0),
    "rational, prism": (0.1, 0.02, 1e-3, 1e-3, 0.01, 0.2, 0.05, 0.01, 1e-3, 1e-4, 1e-3, 1e-4),
    "tilted": (-0.25, 0.11, 0.001, -0.0005, -0.02, *[0.0] * 7, 0.2, -0.3),
    "tilted by 1e-8": (*[0.0] * 12, 1e-8, 1e-8),
    "fisheye": (-0.02, 0.01, -0.004, 0.0005),
    "fisheye, equidistant": (0.0, 0.0, 0.0, 0.0),
    "fisheye that folds": (-0.6, 0.1, 0.0, 0.0),
}


def camera(
    lens: str = "pinhole", focal: float = 1000.0, centre: float = 256.0, away: float = 0.0
) -> Camera:
    """A turned camera of 512² pixels, at a distance from the origin; float32 can hold its numbers.

    Args:
        lens: one of `LENSES`.
        focal: pixels.
        centre: both coordinates of the principal point, pixels.
        away: metres along the diagonal.
    """
    K = torch.tensor([[focal, 0.0, centre], [0.0, focal, centre], [0.0, 0.0, 1.0]])
    R = axis_angle_to_rotmat(torch.tensor([0.3, -0.7, 0.2]))
    t = torch.tensor([0.1, -0.2, 0.5]) - R @ torch.full((3,), away)
    coefficients = torch.tensor(LENSES[lens])
    kind = "fisheye" if lens.startswith("fisheye") else "brown"
    return Camera(K.double(), R.double(), t.double(), (512, 512), coefficients.double(), kind)


def exact_lens(camera: Camera, plane: np.ndarray) -> np.ndarray:
    """OpenCV's lens up to the fold, in proportion beyond it, then its tilt.

    Args:
        camera: gives the lens.
        plane: ideal points on the plane z = 1.
    """
    limit = min(camera.fold_radius, 1e3) if camera.is_distorted else math.inf
    stretch = np.maximum(np.linalg.norm(plane, axis=1) / limit, 1.0)[:, None]
    k = [*camera.distortion.tolist(), *[0.0] * 14][:14]
    if camera.lens == "fisheye":
        return _fisheye(plane / stretch, k) * stretch
    return _tilted(_brown(plane / stretch, k) * stretch, k[12], k[13])


def _brown(plane: np.ndarray, k: list[float]) -> np.ndarray:
    x, y = plane.T
    r = x * x + y * y
    radial = (1 + k[0] * r + k[1] * r**2 + k[4] * r**3) / (1 + k[5] * r + k[6] * r**2 + k[7] * r**3)
    u = x * radial + 2 * k[2] * x * y + k[3] * (r + 2 * x * x) + k[8] * r + k[9] * r**2
    v = y * radial + k[2] * (r + 2 * y * y) + 2 * k[3] * x * y + k[10] * r + k[11] * r**2
    return np.stack((u, v), 1)


def _fisheye(plane: np.ndarray, k: list[float]) -> np.ndarray:
    out = np.zeros_like(plane)
    for i, (x, y) in enumerate(plane):
        radius = math.hypot(x, y)
        theta = math.atan(radius)
        bent = theta * (1 + sum(c * theta ** (2 * n + 2) for n, c in enumerate(k[:4])))
        out[i] = np.array((x, y)) * (bent / radius if radius > 0 else 1.0)
    return out


def _tilted(plane: np.ndarray, about_x: float, about_y: float) -> np.ndarray:
    """The tilted sensor; at its horizon and beyond the denominator stays at a smallest one."""
    cx, sx, cy, sy = math.cos(about_x), math.sin(about_x), math.cos(about_y), math.sin(about_y)
    turn = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ [[1, 0, 0], [0, cx, sx], [0, -sx, cx]]
    lift = np.array([[turn[2, 2], 0, -turn[0, 2]], [0, turn[2, 2], -turn[1, 2]], [0, 0, 1]])
    mapped = np.concatenate((plane, np.ones((len(plane), 1))), 1) @ (lift @ turn).T
    return mapped[:, :2] / np.maximum(mapped[:, 2:], HORIZON)
