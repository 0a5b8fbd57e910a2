"""Stress of cameras that look at points, and of those that move."""

import dataclasses
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.camera_paths import NEAR_X, blend_cameras, orbit_cameras, ring_of_cameras
from monopart.geometry.cameras import Camera
from monopart.geometry.errors import InputError
from monopart.geometry.rotations import axis_angle_to_rotmat

from .stability_cases import DOUBLE, Family, Inputs, Stress, Way
from .stability_lenses import camera
from .stability_rotations import Make, axes, exact_rotmat

_FOV = 0.8
_ROW = "1, and 1 + the largest coordinate for the translation"


def _row(camera: Camera, reach: Tensor) -> Tensor:
    """Rotation, and translation over the size of the scene."""
    return torch.cat((camera.R.flatten(), camera.t / (1 + reach.abs().max())))


def _exact_row(R: Any, t: Any, reach: Any) -> np.ndarray:
    return np.concatenate((R.ravel(), t / (1 + np.abs(reach).max())))


# --- looking at a point ------------------------------------------------------------------------


def _views(size: float, away: float, up: float = 1.0, sine: float | None = None) -> Make:
    """Eyes, targets at a distance from them, and directions of a length upwards."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        eye = away * axes(generator, count).roll(1, 0) + size
        view, other = axes(generator, count), axes(generator, count).roll(1, 1)
        upwards = other if sine is None else view + sine * other
        return eye, eye + size * view, up * upwards

    return make


def exact_view(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Rotation of one view: forward, right, down by cross products of unit vectors."""
    z = (target - eye) / np.abs(target - eye).max()
    z = z / np.linalg.norm(z)
    x = np.cross(z, up / np.abs(up).max())
    x = x / np.linalg.norm(x)
    return np.stack((x, np.cross(z, x), z))


def _sine(view: np.ndarray, up: np.ndarray) -> np.ndarray:
    view, up = (v / np.abs(v).max(1, keepdims=True) for v in (view, up))
    cross = np.linalg.norm(np.cross(view, up), axis=1)
    return cross / np.linalg.norm(view, axis=1) / np.linalg.norm(up, axis=1)


def _look_at() -> Stress:
    def run(extra: None, eye: Tensor, target: Tensor, up: Tensor) -> tuple[Tensor, Tensor]:
        rows, valid = [], []
        for e, x, u in zip(eye, target, up, strict=True):
            try:
                rows.append(_row(Camera.look_at(e, x, u, (8, 8), fov=_FOV), e))
                valid.append(True)
            except InputError:
                rows.append(e.new_zeros(12) + 0 * (e.sum() + x.sum() + u.sum()))
                valid.append(False)
        return torch.stack(rows), torch.tensor(valid)

    def exact(extra: None, eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
        out = np.zeros((len(eye), 12))
        for i, (e, x, u) in enumerate(zip(eye, target, up, strict=True)):
            with np.errstate(all="ignore"):
                R = exact_view(e, x, u)
            out[i] = _exact_row(R, -R @ e, e)
        return np.nan_to_num(out)

    shapes = (
        *(("3 m", _views(3.0, 1.0)), ("1 mm", _views(1e-3, 0.0)), ("1 km", _views(1e3, 1e3))),
        *(("up 1e-25", _views(3.0, 1.0, 1e-25)), ("up 1e25", _views(3.0, 1.0, 1e25))),
        ("100 km away", _views(3.0, 1e5)),
        ("up 0.1° off the view", _views(3.0, 1.0, sine=2e-3)),
        ("up along the view", _views(3.0, 1.0, sine=1e-9)),
        ("target 1e-25 m off", _views(1e-25, 0.0)),
    )
    # an entry of up is moved by the step of the differences: as large as up itself where that is
    families = [
        Family(n, m, step=1e-7 if "m off" not in n else 1e-32, smooth="1e" not in n)
        for n, m in shapes
    ]
    return Stress(
        name="look_at",
        title="cameras that look at a point",
        domain="any finite eye, target and up, of any length; a target at the eye, or up within "
        "1e-6 rad of the view, is an error (masked here)",
        error="1 over the sine between up and the view",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=exact,
        scale=lambda extra, found, eye, target, up: 1 / np.maximum(_sine(target - eye, up), 1e-6),
        wrt=(0, 1, 2),
        cases=64,
    )


# --- moving cameras ----------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Path:
    """One camera of a path, by its number."""

    count: int
    index: int
    distance: float = 3.0
    elevation: float = 0.3


def _around(away: float, length: float = 1.0) -> Make:
    """Points of an axis, and its directions of a length."""
    return lambda g, n: (away * axes(g, n).roll(1, 0), length * axes(g, n))


def _unit(vector: np.ndarray) -> np.ndarray:
    scaled = vector / np.abs(vector).max()
    return scaled / np.linalg.norm(scaled)


def _orbited(path: _Path, R: Any, t: Any, middle: Any, up: Any) -> tuple[Any, Any]:
    """Turn a camera about an axis through a point: with 50 digits."""
    angle = 2 * math.pi * path.index / path.count
    turn = exact_rotmat(None, (angle * _unit(up))[None])[0]
    turned = R @ turn.T
    return turned, t + (R - turned) @ middle


def _orbit() -> Stress:
    def run(path: _Path, center: Tensor, up: Tensor) -> Tensor:
        first = camera().to(center)
        return torch.stack(
            [
                _row(orbit_cameras(first, c, u, path.count)[path.index], c)
                for c, u in zip(center, up, strict=True)
            ]
        )

    def exact(path: _Path, center: np.ndarray, up: np.ndarray) -> np.ndarray:
        R, t = camera().R.numpy(), camera().t.numpy()
        pairs = zip(center, up, strict=True)
        return np.stack([_exact_row(*_orbited(path, R, t, c, u), reach=c) for c, u in pairs])

    third = _Path(3, 1)
    shapes = (
        *(("a third", third, _around(2.0)), ("the first", _Path(5, 0), _around(2.0))),
        *(("half a turn", _Path(2, 1), _around(2.0)), ("a 50th", _Path(50, 1), _around(2.0))),
        *(("axis 1e-25", third, _around(2.0, 1e-25)), ("axis 1e25", third, _around(2.0, 1e25))),
        *(("100 km away", third, _around(1e5)), ("axis through 0", third, _around(0.0))),
    )
    families = [Family(n, m, extra=p, step=1e-7, smooth="1e" not in n) for n, p, m in shapes]
    return Stress(
        name="orbit_cameras",
        title="cameras on a turntable",
        domain="any finite point and direction of any length; a direction of zero is an error",
        error=_ROW,
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=exact,
        wrt=(0, 1),
        cases=24,
    )


def _ring() -> Stress:
    def run(path: _Path, target: Tensor, up: Tensor) -> Tensor:
        given = (path.distance, path.elevation, path.count, (8, 8), _FOV)
        return torch.stack(
            [
                _row(ring_of_cameras(x, u, *given)[path.index], x.abs().max() + path.distance)
                for x, u in zip(target, up, strict=True)
            ]
        )

    def exact(path: _Path, target: np.ndarray, up: np.ndarray) -> np.ndarray:
        out = []
        for x, u in zip(target, up, strict=True):
            axis = _unit(u)
            across = _unit(np.cross(axis, np.eye(3)[int(abs(axis[0]) > NEAR_X)]))
            arm = math.cos(path.elevation) * across + math.sin(path.elevation) * axis
            R = exact_view(path.distance * arm, np.zeros(3), axis)
            R, t = _orbited(path, R, -R @ (x + path.distance * arm), x, u)
            out.append(_exact_row(R, t, np.abs(x).max() + path.distance))
        return np.stack(out)

    usual = _Path(3, 1)
    shapes = (
        *(("3 m", usual, _around(2.0)), ("1 mm", _Path(3, 2, 1e-3), _around(0.0))),
        *(("1 km", _Path(3, 0, 1e3), _around(2.0)), ("target 1 km off", usual, _around(1e3))),
        *(("axis 1e-25", usual, _around(2.0, 1e-25)), ("axis 1e25", usual, _around(2.0, 1e25))),
        ("0.1° from the pole", _Path(3, 1, 3.0, math.pi / 2 - 2e-3), _around(2.0)),
        ("below", _Path(3, 1, 3.0, -1.2), _around(2.0)),
    )
    families = [Family(n, m, extra=p, step=1e-7, smooth="1e" not in n) for n, p, m in shapes]
    return Stress(
        name="ring_of_cameras",
        title="cameras around a point",
        domain="any finite point, axis of any length and elevation short of a pole; a view loses "
        "the digits of the target over the distance to it",
        error="1 + target over distance",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=exact,
        scale=lambda path, found, target, up: 1 + np.abs(target).max(1) / path.distance,
        wrt=(0, 1),
        cases=24,
    )


def _between(angle: float, away: float) -> Make:
    """First orientations, turns from them, and centres."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        centres = torch.randn(2, count, 3, generator=generator, dtype=DOUBLE) + away
        return axes(generator, count), angle * axes(generator, count).roll(1, 1), *centres

    return make


def _blend() -> Stress:
    path = _Path(4, 1)

    def run(extra: None, first: Tensor, turn: Tensor, a: Tensor, b: Tensor) -> Tensor:
        K, rows = camera().K.to(first), []
        for v, w, p, q in zip(first, turn, a, b, strict=True):
            R = axis_angle_to_rotmat(v)
            there = axis_angle_to_rotmat(w) @ R
            start, end = (Camera(K, r, -(r @ c), (8, 8)) for r, c in ((R, p), (there, q)))
            rows.append(_row(blend_cameras(start, end, path.count)[path.index], p))
        return torch.stack(rows)

    def exact(extra: None, first: np.ndarray, turn: np.ndarray, *ends: np.ndarray) -> np.ndarray:
        share = path.index / (path.count - 1)
        R = exact_rotmat(None, share * turn) @ exact_rotmat(None, first)
        middle = (1 - share) * ends[0] + share * ends[1]
        rows = zip(R, middle, ends[0], strict=True)
        return np.stack([_exact_row(r, -r @ c, a) for r, c, a in rows])

    shapes = (("no turn", 0.0), ("1e-8", 1e-8), ("1 rad", 1.0), ("π-1e-2", math.pi - 1e-2))
    families = [Family(n, _between(a, 1.0), step=1e-6) for n, a in shapes]
    families.append(Family("100 km away", _between(1.0, 1e5), step=1e-6))
    families.append(Family("π", _between(math.pi, 1.0), smooth=False, inside=False))
    return Stress(
        name="blend_cameras",
        title="cameras between two",
        domain="turns below π; at π either way round may be taken",
        error=_ROW,
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=exact,
        wrt=(0, 1, 2, 3),
        cases=8,
    )


def stresses() -> list[Stress]:
    """Operations that make cameras."""
    return [_look_at(), _orbit(), _ring(), _blend()]
