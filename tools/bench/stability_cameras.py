"""Stress of cameras, lenses, rays and boxes."""

import dataclasses
from typing import Any

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.boxes import ray_box
from monopart.geometry.cameras import MIN_DEPTH, Camera, Rays
from monopart.geometry.lenses import lens_distort

from .registry import load
from .stability_cases import DOUBLE, Family, Inputs, Stress, Way
from .stability_lenses import LENSES, camera, exact_lens
from .stability_rotations import Make, axes


def ahead(camera: Camera, depth: tuple[float, float], spread: float) -> Make:
    """World points at depths, and at a spread of x/z and y/z."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        share = torch.rand(count, 1, generator=generator, dtype=DOUBLE)
        z = depth[0] + share * (depth[1] - depth[0])
        plane = spread * (2 * torch.rand(count, 2, generator=generator, dtype=DOUBLE) - 1)
        local = torch.cat((plane * z, z), 1)
        return ((local - camera.t) @ camera.R,)

    return make


# --- oracles -----------------------------------------------------------------------------------


def _local(camera: Camera, points: np.ndarray) -> np.ndarray:
    """World points in camera axes, one after the other."""
    return np.stack([camera.R.numpy() @ p + camera.t.numpy() for p in points])


def exact_pixels(camera: Camera, points: np.ndarray) -> np.ndarray:
    """World to pixels; behind the camera the pixel of no answer."""
    K, local = camera.K.numpy(), _local(camera, points)
    front = local[:, 2:] > MIN_DEPTH
    plane = np.where(front, local[:, :2], 0.0) / np.where(front, local[:, 2:], 1.0)
    pixels = exact_lens(camera, plane) @ K[:2, :2].T + K[:2, 2]
    return np.where(front, pixels, -512.0)


def pixel_scale(camera: Camera, exact: np.ndarray, points: np.ndarray) -> np.ndarray:
    """What an error as large as the largest coordinate would do to a pixel, to first order."""
    R, t = camera.R.numpy(), camera.t.numpy()
    local = points @ R.T + t
    largest = np.maximum(np.abs(points).max(1), np.abs(t).max())
    z = np.maximum(local[:, 2], MIN_DEPTH)
    slope = np.linalg.norm(local[:, :2], axis=1) / z
    bent = np.linalg.norm(exact - camera.K.numpy()[:2, 2], axis=1) / float(camera.K[0, 0])
    carried = float(camera.K[0, 0]) * largest / z * (1 + np.maximum(slope, bent))
    if camera.distortion.numel() == 14:  # the horizon of a tilt stretches without bound
        moved = [exact_pixels(camera, points + 1e-7 * axis) - exact for axis in np.eye(3)]
        carried = np.maximum(carried, largest * np.linalg.norm(moved, axis=(0, 2)) / 1e-7)
    return np.maximum(np.maximum(carried, np.abs(exact).max(1)), 512.0)


# --- projection --------------------------------------------------------------------------------


def _kornia(camera: Camera, points: Tensor) -> Tensor:
    like = camera.to(points)
    local = points @ like.R.mT + like.t
    return load("kornia.geometry").project_points(local, like.K.expand(len(points), -1, -1))


def _opencv(camera: Camera, points: Tensor) -> Tensor:
    cv2, like = load("cv2"), camera.to(points)
    lens = like.distortion.double().numpy() if like.is_distorted else None
    local = (points @ like.R.mT + like.t).numpy()[:, None]  # its rotation vectors would round R
    still = np.zeros(3)
    if like.lens == "fisheye":
        project = cv2.fisheye.projectPoints
        found = project(local.astype(np.float64), still, still, like.K.double().numpy(), lens)[0]
        return torch.from_numpy(found.reshape(-1, 2))
    found = cv2.projectPoints(local, still, still, like.K.double().numpy(), lens)[0]
    return torch.from_numpy(found[:, 0])


def _project_families() -> tuple[Family, ...]:
    plain, far = camera(), camera(away=1e5)
    grazing = ahead(plain, (0.1, 0.2), 500.0)
    out = [
        Family("3 m", ahead(plain, (2.0, 4.0), 0.3), extra=plain, step=1e-6),
        Family("depth 1e-2", ahead(plain, (1e-2, 2e-2), 0.3), extra=plain, step=1e-8),
        Family("depth 1e-5", ahead(plain, (1e-5, 2e-5), 0.3), extra=plain, step=1e-11),
        Family("depth 0", ahead(plain, (0.0, 0.0), 0.3), extra=plain, smooth=False),
        Family("behind", ahead(plain, (-4.0, -1e-3), 0.3), extra=plain),
        Family("1 km", ahead(plain, (900.0, 1100.0), 0.3), extra=plain, step=1e-3),
        Family("89.9° off axis", grazing, extra=plain, step=1e-6),
        Family("100 km away", ahead(far, (2.0, 4.0), 0.3), extra=far, step=1e-4),
    ]
    for name, one in (
        *(("focal 1", camera(focal=1.0)), ("focal 1e6", camera(focal=1e6))),
        ("principal point outside", camera(centre=-5000.0)),
    ):
        out.append(Family(name, ahead(one, (2.0, 4.0), 0.3), extra=one, step=1e-6))
    for lens in list(LENSES)[1:]:
        one = camera(lens)
        out.append(Family(lens, ahead(one, (2.0, 4.0), 0.4), extra=one, step=1e-6))
        beyond = ahead(one, (0.2, 0.4), 20.0)
        out.append(Family(f"{lens}, beyond", beyond, extra=one, step=1e-7, smooth=False))
    for lens in ("usual lens", "fisheye"):
        still = camera(lens)  # at the origin: a turn would round depths away
        one = dataclasses.replace(still, R=torch.eye(3).double(), t=torch.zeros(3).double())
        beside = ahead(one, (1e-5, 2e-5), 1e20)
        out.append(Family(f"{lens}, 1e15 m beside", beside, extra=one, smooth=False))
    return tuple(out)


def _project() -> Stress:
    return Stress(
        name="project",
        title="projection",
        domain="any point; nearer than 1 µm or behind: the pixel (-width, -height), no gradient; "
        "beyond the fold of a lens: continued outwards",
        error="f·S/z·(1 + r): an error of S, the largest coordinate, carried into the image",
        families=_project_families(),
        ways=(
            Way("monopart", lambda cam, p: cam.project(p)[0], True),
            Way("kornia", _kornia, modules=("kornia",), serves=lambda f: not f.extra.is_distorted),
            Way("OpenCV", _opencv, modules=("cv2",), differentiable=False),
        ),
        exact=exact_pixels,
        scale=pixel_scale,
    )


def _slopes() -> Stress:
    """Slopes of the projection of a pinhole."""

    def exact(camera: Camera, points: np.ndarray) -> np.ndarray:
        out = []
        for x, y, depth in _local(camera, points):
            z = max(depth, MIN_DEPTH)
            plane = np.array([[1.0, 0.0, -x / z], [0.0, 1.0, -y / z]]) / z
            out.append(camera.K.numpy()[:2, :2] @ plane @ camera.R.numpy())
        return np.stack(out).reshape(-1, 6)

    def scale(camera: Camera, exact: np.ndarray, points: np.ndarray) -> np.ndarray:
        z = np.maximum(_local(camera, points)[:, 2], MIN_DEPTH)
        largest = np.maximum(np.abs(points).max(1), np.abs(camera.t.numpy()).max())
        return np.abs(exact).max(1) * np.maximum(largest / z, 1.0)

    return Stress(
        name="pixel_slopes",
        title="slopes of the projection",
        domain="any point; nearer than 1 µm or behind: as at 1 µm",
        error="f·S/z²·(1 + r): an error of S, the largest coordinate, in the depth",
        families=tuple(f for f in _project_families() if not f.extra.is_distorted),
        ways=(Way("monopart", lambda cam, p: cam.pixel_slopes(p).flatten(1), True),),
        exact=exact,
        scale=scale,
    )


# --- rays --------------------------------------------------------------------------------------


def _image(camera: Camera, reach: float, special: bool = False) -> Make:
    """Pixels around the principal point, reaching so many focal lengths from it."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        place = reach * (2 * torch.rand(count, 2, generator=generator, dtype=DOUBLE) - 1)
        if special:
            place[: count // 2] = 0  # along the optical axis
            place[count // 2 :, 0] = 0
        return (place * float(camera.K[0, 0]) + camera.K[:2, 2],)

    return make


def exact_directions(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Unit directions of a pinhole."""
    K, R = camera.K.numpy(), camera.R.numpy()
    plane = (pixels - K[:2, 2]) / K[0, 0]
    # not of unit length before it is turned: float32 has no exact rotations
    turned = np.concatenate((plane, np.ones((len(plane), 1))), 1) @ R
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)


def _rays() -> Stress:
    families = []
    for name, one, reach, special in (
        *(("usual", camera(), 0.3, False), ("along axes", camera(), 0.3, True)),
        *(("89.9° off axis", camera(), 500.0, False), ("focal 1", camera(focal=1.0), 256.0, False)),
        ("focal 1e6", camera(focal=1e6), 3e-4, False),
        ("principal point outside", camera(centre=-5000.0), 5.0, False),
    ):
        step = 1e-6 * float(one.K[0, 0])
        families.append(Family(name, _image(one, reach, special), extra=one, step=step))
    return Stress(
        name="rays",
        title="rays of a pinhole",
        domain="any finite pixel",
        error="1 rad",
        families=tuple(families),
        ways=(Way("monopart", lambda cam, px: cam.rays(px).directions, True),),
        exact=exact_directions,
    )


def _back(camera: Camera, plane: Tensor) -> Tensor:
    """Ideal points to pixels in float64."""
    bent = lens_distort(camera.lens, plane.double(), camera.distortion, camera.fold_radius)
    return bent @ camera.K[:2, :2].mT + camera.K[:2, 2]


def _our_undistort(camera: Camera, pixels: Tensor) -> tuple[Tensor, Tensor]:
    rays, valid = camera.rays_with_mask(pixels)
    local = rays.directions.double() @ torch.linalg.inv(camera.R)
    return _back(camera, local[:, :2] / local[:, 2:]), valid


def _kornia_undistort(camera: Camera, pixels: Tensor) -> Tensor:
    like, undistort = camera.to(pixels), load("kornia.geometry.calibration").undistort_points
    unit = torch.eye(3).to(pixels)[None]
    return _back(camera, undistort(pixels[None], like.K[None], like.distortion[None], unit, 20)[0])


def _opencv_undistort(camera: Camera, pixels: Tensor) -> Tensor:
    cv2 = load("cv2")
    stop = (cv2.TERM_CRITERIA_COUNT, 20, 0.0)
    K, lens = camera.K.numpy(), camera.distortion.numpy()
    if camera.lens == "fisheye":
        undistort = cv2.fisheye.undistortPoints
        found = undistort(pixels.double().numpy()[:, None], K, lens, criteria=stop)
        return _back(camera, torch.from_numpy(np.asarray(found)[:, 0]))
    found = cv2.undistortPoints(pixels.numpy()[:, None], K, lens, R=None, P=None, criteria=stop)
    return _back(camera, torch.from_numpy(np.asarray(found)[:, 0]))


def _ray_scale(camera: Camera, exact: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    focal = float(camera.K[0, 0])
    r = np.linalg.norm(pixels - camera.K.numpy()[:2, 2], axis=1) / focal
    return np.maximum(focal * (1 + r * r), np.abs(pixels).max(1))


def _undistort() -> Stress:
    families = []
    for lens in list(LENSES)[1:]:
        one = camera(lens)
        for name, reach in ((lens, 0.3), (f"{lens}, edge", 0.6), (f"{lens}, beyond", 30.0)):
            make = _image(one, reach)
            families.append(Family(name, make, extra=one, step=1e-3, smooth="beyond" not in name))
    return Stress(
        name="undistort",
        title="rays through a lens (pixel they come back to)",
        domain="pixels that the lens can see; others, beyond its fold, are masked",
        error="f·(1 + r²), in pixels: the last place of a direction",
        families=tuple(families),
        ways=(
            Way("monopart", _our_undistort, True),
            Way(
                "kornia, 20 steps",
                _kornia_undistort,
                modules=("kornia",),
                serves=lambda family: family.extra.lens == "brown",
            ),
            Way("OpenCV, 20 steps", _opencv_undistort, modules=("cv2",), differentiable=False),
        ),
        exact=lambda cam, pixels: pixels,
        scale=_ray_scale,
    )


# --- rays and boxes ----------------------------------------------------------------------------


def _lines(kind: str) -> Make:
    """Rays against the unit cube; coordinates of special ones are exact in every precision."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        origins = 3 * torch.randn(count, 3, generator=generator, dtype=DOUBLE)
        directions = axes(generator, count)
        if kind == "inside":
            origins = torch.rand(count, 3, generator=generator, dtype=DOUBLE)
        elif kind != "any":
            rows, axis = torch.arange(count), torch.arange(count) % 3
            directions = torch.eye(3, dtype=DOUBLE)[axis]
            origins = torch.rand(count, 3, generator=generator, dtype=DOUBLE)
            if kind == "in a face":
                origins[rows, (axis + 1) % 3] = 1.0
            origins[rows, axis] = -2.0
        if kind == "nearly parallel":
            directions = directions + 1e-20
        return origins, directions

    return make


def exact_box(extra: Any, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Near and far by slabs, one axis after the other; 0 and 0 where missed."""
    out = np.zeros((len(origins), 2))
    for i, (o, d) in enumerate(zip(origins, directions, strict=True)):
        near, far, hit = -np.inf, np.inf, True
        for a in range(3):
            if abs(d[a]) < 1e-15:
                hit = hit and 0 <= o[a] <= 1
            else:
                one, two = -o[a] / d[a], (1 - o[a]) / d[a]
                near, far = max(near, min(one, two)), min(far, max(one, two))
        if hit and far >= max(near, 0):
            out[i] = max(near, 0), far
    return out


def _box_scale(
    extra: None, exact: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> np.ndarray:
    return 1 + np.abs(origins).max(1) + np.abs(exact).max(1)


def _boxes() -> Stress:
    def run(extra: None, origins: Tensor, directions: Tensor) -> Tensor:
        lo, hi = torch.zeros(3).to(origins), torch.ones(3).to(origins)
        near, far, _ = ray_box(Rays(origins, directions), lo, hi)
        return torch.stack((near, far), 1)

    kinds = ("any", "inside", "along axes", "in a face", "nearly parallel")
    families = [Family(k, _lines(k), smooth=k in ("any", "inside"), step=1e-8) for k in kinds]
    return Stress(
        name="ray_box",
        title="rays and boxes",
        domain="any rays; along an axis and in a face too, without a division",
        error="1 + largest coordinate + distance along the ray",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=exact_box,
        scale=_box_scale,
        wrt=(0, 1),
    )


def stresses() -> list[Stress]:
    """Operations on cameras and rays."""
    from . import stability_paths, stability_pixels, stability_programs

    more = (stability_paths, stability_programs, stability_pixels)
    own = [_project(), _slopes(), _rays(), _undistort(), _boxes()]
    return [*own, *(stress for room in more for stress in room.stresses())]
