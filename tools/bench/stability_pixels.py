"""Stress of pixels of resized, cropped and undistorted images, of masks, placements and boxes."""

import dataclasses
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.body import PosedBody, convert_smplx_translation
from monopart.geometry.boxes import box_mask, box_of, in_box
from monopart.geometry.cameras import MIN_DEPTH, Camera, Rays
from monopart.geometry.rotations import axis_angle_to_rotmat

from .stability_cameras import ahead, exact_directions, exact_pixels, pixel_scale
from .stability_cases import DOUBLE, Family, Inputs, Stress, Way
from .stability_lenses import LENSES, camera, exact_lens
from .stability_rotations import Make, axes, exact_rotmat

# --- other sizes of an image -------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Edit:
    """What is done to the image of a camera."""

    kind: str
    given: Any = None

    def camera(self) -> Camera:
        """The camera of the edited image."""
        first = camera()
        if self.kind == "legacy":
            return Camera.from_legacy_pixels(first.K, first.R, first.t, first.size)
        return getattr(first, self.kind)(self.given)

    def pixels(self, pixels: np.ndarray) -> np.ndarray:
        """Where pixels of the whole image come to lie."""
        if self.kind == "legacy":
            return pixels + 0.5
        if self.kind == "cropped":
            return pixels - np.array(self.given[:2], np.float64)
        height, width = self.camera().size
        return pixels * np.array([width, height], np.float64) / 512


def _edits() -> Stress:
    edits = (
        *(_Edit("resized", s) for s in (1 / 3, 1e-2, (1, 1), (7, 60000), 100.0)),
        *(_Edit("cropped", b) for b in ((3, 5, 4, 6), (-9000, -9000, 99999, 99999))),
        _Edit("legacy"),
    )

    def exact(edit: _Edit, points: np.ndarray) -> np.ndarray:
        return edit.pixels(exact_pixels(camera(), points))

    def scale(edit: _Edit, exact: np.ndarray, points: np.ndarray) -> np.ndarray:
        return np.maximum(pixel_scale(edit.camera(), exact, points), np.abs(exact).max(1))

    make = ahead(camera(), (2.0, 4.0), 0.3)
    families = [
        Family(f"{e.kind} {e.given or '½'}".replace(".3333333333333333", ".33"), make, extra=e)
        for e in edits
    ]
    return Stress(
        name="resized_cropped",
        title="cameras of resized and cropped images (pixels of points)",
        domain="sizes of at least one pixel, boxes that hold one",
        error="as projection",
        families=tuple(dataclasses.replace(f, step=1e-6) for f in families),
        ways=(Way("monopart", lambda edit, p: edit.camera().project(p)[0], True),),
        exact=exact,
        scale=scale,
        cases=64,
    )


def _undistorted() -> Stress:
    """The map of every pixel of a small image, as a function of its focal length."""

    def of(lens: str, focal: Tensor) -> Camera:
        usual = camera(lens, 24.0, 8.0).to(focal)
        K = torch.diag(torch.cat((focal.view(1), focal.view(1), focal.new_ones(1))))
        return dataclasses.replace(usual, K=K + usual.K.triu(1), size=(16, 16))

    def run(lens: str, focal: Tensor) -> Tensor:
        return of(lens, focal).undistorted()[1].flatten(0, 1) + 0 * focal  # no lens, no gradient

    def exact(lens: str, focal: np.ndarray) -> np.ndarray:
        own = of(lens, torch.from_numpy(focal))
        y, x = np.mgrid[:16, :16] + 0.5
        plane = (np.stack((x, y), -1).reshape(-1, 2) - 8.0) / focal[0]
        return exact_lens(own, plane) * focal[0] + 8.0

    families = [
        Family(lens, lambda g, n: (torch.tensor([24.0]).double(),), extra=lens, smooth=False)
        for lens in LENSES
    ]
    return Stress(
        name="undistorted",
        title="maps of undistortion",
        domain="any lens; beyond its fold the map goes on outwards",
        error="the pixel, at least 16, the edge of the image",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=exact,
        scale=lambda lens, exact, focal: np.maximum(np.abs(exact).max(1), 16.0),
        rows_apart=False,
        cases=8,
    )


# --- masks: 1 and 0, not compared where rounding decides ---------------------------------------

_EDGE = 1e-3  # metres, pixels: nearer to a border than this nothing is compared


def _visible() -> Stress:
    """Seen points, and whether the pixels of points inside of the fold have a ray."""

    def run(camera: Camera, points: Tensor) -> Tensor:
        seen = camera.visible(points)
        there = camera.valid_pixels(camera.project(points)[0])
        return torch.stack((seen, there), 1).to(points)

    def exact(camera: Camera, points: np.ndarray) -> np.ndarray:
        local = points @ camera.R.numpy().T + camera.t.numpy()
        pixels, fold = exact_pixels(camera, points), camera.fold_radius
        edge = np.minimum(np.abs(pixels), np.abs(pixels - 512.0)).min(1) < 0.1
        radius = np.linalg.norm(local[:, :2], axis=1) / np.maximum(local[:, 2], 1e-9)
        near_fold = np.abs(radius - fold) < 1e-3 * (fold if math.isfinite(fold) else 1.0)
        unsure = edge | near_fold | (np.abs(local[:, 2]) < _EDGE)
        inside = ((pixels >= 0) & (pixels < 512.0)).all(1)
        seen = inside & (local[:, 2] > MIN_DEPTH) & (radius < fold)
        sure = (local[:, 2] > _EDGE) & (radius < 0.999 * min(fold, 1e3))
        out = np.stack((np.where(unsure, np.nan, seen), np.where(sure, 1.0, np.nan)), 1)
        return out

    def off(found: np.ndarray, exact: np.ndarray) -> np.ndarray:
        return np.where(np.isnan(exact), 0.0, np.abs(found - exact)).max(1)

    families = []
    for lens in ("pinhole", "usual lens", "strong barrel", "tilted", "fisheye that folds"):
        one = camera(lens)
        for name, depth, spread in (
            ("ahead", (2.0, 4.0), 0.4),
            ("aside", (2.0, 4.0), 20.0),
            ("behind", (-4.0, -2.0), 0.4),
        ):
            families.append(Family(f"{lens}, {name}", ahead(one, depth, spread), extra=one))
    nowhere = ahead(camera(), (2.0, 4.0), 0.4)
    families.append(Family("NaN", lambda g, n: (nowhere(g, n)[0] * torch.nan,), extra=camera()))
    return Stress(
        name="visible",
        title="points in the image, pixels with a ray",
        domain="any points; NaN is not visible; where rounding decides nothing is compared",
        error="right or wrong",
        families=tuple(families),
        ways=(Way("monopart", run, True, differentiable=False),),
        exact=exact,
        off=off,
        wrt=(),
        cases=64,
    )


def _in_boxes() -> Stress:
    """Membership, and the mask of pixels whose central ray meets the unit cube."""

    def run(extra: None, points: Tensor) -> Tensor:
        lo, hi = torch.zeros(3).to(points), torch.ones(3).to(points)
        return in_box(points, lo, hi)[:, None].to(points)

    def exact(extra: None, points: np.ndarray) -> np.ndarray:
        inside = [all(0 <= x <= 1 for x in p) for p in points.tolist()]
        return np.array(inside, np.float64)[:, None]

    def place(kind: str) -> Make:
        def make(generator: torch.Generator, count: int) -> Inputs:
            points = 2 * torch.rand(count, 3, generator=generator, dtype=DOUBLE) - 0.5
            if kind == "on faces":
                points[torch.arange(count), torch.arange(count) % 3] = 1.0
            if kind == "corners":
                points = points.round()
            special = {"infinite": torch.inf, "NaN": torch.nan, "one place off": None}
            if kind == "one place off":
                points[:, 0] = -torch.finfo(torch.float32).tiny
            elif kind in special:
                points[:, 0] = special[kind]
            return (points,)

        return make

    kinds = ("around", "on faces", "corners", "one place off", "infinite", "NaN")
    return Stress(
        name="in_box",
        title="points in boxes",
        domain="any points; faces belong to the box, NaN lies in none",
        error="right or wrong",
        families=tuple(Family(k, place(k)) for k in kinds),
        ways=(Way("monopart", run, True, differentiable=False),),
        exact=exact,
        wrt=(),
        cases=128,
    )


def _masked_box(camera: Camera, lo: np.ndarray) -> np.ndarray:
    """Pixels that see the box of edge 1 by slabs in float64; NaN where it is a close call."""
    y, x = np.mgrid[: camera.size[0], : camera.size[1]] + 0.5
    directions = exact_directions(camera, np.stack((x, y), -1).reshape(-1, 2))
    near, far = np.full(len(directions), -np.inf), np.full(len(directions), np.inf)
    origin = -camera.R.numpy().T @ camera.t.numpy()
    for a in range(3):
        with np.errstate(divide="ignore"):
            one, two = (
                (lo[a] - origin[a]) / directions[:, a],
                (lo[a] + 1 - origin[a]) / directions[:, a],
            )
        near, far = np.maximum(near, np.minimum(one, two)), np.minimum(far, np.maximum(one, two))
    hit = (far >= near) & (far >= 0)
    return np.where(np.abs(far - np.maximum(near, 0)) < 1e-2, np.nan, hit)[:, None]


def _box_masks() -> Stress:
    small = dataclasses.replace(camera(focal=24.0, centre=8.0), size=(16, 16))

    def run(camera: Camera, lo: Tensor) -> Tensor:
        return box_mask(camera, lo, lo + 1).reshape(-1, 1).to(lo)

    def place(depth: float) -> Make:
        local = torch.tensor([0.0, 0.0, depth]).double()
        return lambda g, n: ((local - small.t) @ small.R - 0.5,)

    def off(found: np.ndarray, exact: np.ndarray) -> np.ndarray:
        return np.where(np.isnan(exact), 0.0, np.abs(found - exact)).max(1)

    shapes = (("3 m ahead", 3.0), ("around the eye", 0.0), ("behind", -3.0), ("1 km ahead", 1e3))
    return Stress(
        name="box_mask",
        title="pixels that see a box",
        domain="any camera and box; where rounding decides nothing is compared",
        error="right or wrong",
        families=tuple(Family(n, place(d), extra=small) for n, d in shapes),
        ways=(Way("monopart", run, True, differentiable=False),),
        exact=_masked_box,
        off=off,
        wrt=(),
        cases=8,
    )


def _box_of() -> Stress:
    def run(margin: float, points: Tensor) -> Tensor:
        return torch.stack(box_of(points, margin))

    def exact(margin: float, points: np.ndarray) -> np.ndarray:
        low = [min(p[a] for p in points.tolist()) for a in range(3)]
        high = [max(p[a] for p in points.tolist()) for a in range(3)]
        return np.array([low, high]) + np.array([[-margin], [margin]])

    def cloud(size: float, away: float, one: bool = False) -> Make:
        def make(generator: torch.Generator, count: int) -> Inputs:
            number = 1 if one else count
            return (away + size * torch.randn(number, 3, generator=generator, dtype=DOUBLE),)

        return make

    shapes = (("1 m", 1.0, 0.0), ("1e-30 m", 1e-30, 0.0), ("1e30 m", 1e30, 0.0))
    families = [Family(n, cloud(s, a), extra=0.5, step=1e-7) for n, s, a in shapes]
    families = [dataclasses.replace(f, smooth=f.name == "1 m") for f in families]
    families.append(Family("one point", cloud(1.0, 0.0, True), extra=0.0))
    families.append(Family("equal points", cloud(0.0, 1.0), extra=0.5, smooth=False))
    families.append(Family("100 km away", cloud(1.0, 1e5), extra=0.5, step=1e-6))
    return Stress(
        name="box_of",
        title="boxes of points",
        domain="at least one point; where several reach farthest they share the gradient",
        error="largest coordinate",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=exact,
        scale=lambda margin, exact, points: np.abs(points).max() + margin + 1e-30,
        rows_apart=False,
        cases=64,
    )


# --- from one frame to another -----------------------------------------------------------------


def _placed(rotation: Tensor, translation: Tensor) -> PosedBody:
    still = translation.new_zeros(1, 3)
    maps = torch.eye(4).to(still)[None]
    return PosedBody(still, still, maps, rotation, translation)


def _turned_points(angle: float, size: float, away: float) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        turn = angle * axes(generator, 4)[3:]
        shift = away * torch.randn(1, 3, generator=generator, dtype=DOUBLE)
        return size * torch.randn(count, 3, generator=generator, dtype=DOUBLE), turn, shift

    return make


def _world(extra: None, points: Tensor, turn: Tensor, shift: Tensor) -> Tensor:
    return _placed(axis_angle_to_rotmat(turn[0]), shift[0]).to_world(points)


def _local(extra: None, points: Tensor, turn: Tensor, shift: Tensor) -> Tensor:
    return _placed(axis_angle_to_rotmat(turn[0]), shift[0]).to_local(points)


def _seen(extra: None, points: Tensor, turn: Tensor, shift: Tensor) -> Tensor:
    R = axis_angle_to_rotmat(turn[0])
    return Camera(torch.eye(3).to(points), R, shift[0], (8, 8)).to_camera(points)


def _smplx(extra: None, points: Tensor, turn: Tensor, shift: Tensor) -> Tensor:
    return convert_smplx_translation(turn.expand_as(points), points, shift.expand_as(points))


def _smplx_back(extra: None, points: Tensor, turn: Tensor, shift: Tensor) -> Tensor:
    turn, shift = turn.expand_as(points), shift.expand_as(points)
    return convert_smplx_translation(turn, points, shift, inverse=True)


def _along(extra: None, points: Tensor, turn: Tensor, shift: Tensor) -> Tensor:
    return Rays(points, turn.expand_as(points)).at(shift[:, 0].expand(len(points)))


def _turned(points: np.ndarray, turn: np.ndarray) -> np.ndarray:
    return points @ exact_rotmat(None, turn)[0].T


def _moved(turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    return shift - _turned(shift, turn)


def _frames() -> list[Stress]:
    """Points of a camera, of the world and of a body, along rays; translations of smplx."""
    families = (
        Family("1 m", _turned_points(1.0, 1.0, 1.0), step=1e-6),
        *(
            Family("no turn", _turned_points(0.0, 1.0, 1.0)),
            Family("π", _turned_points(math.pi, 1.0, 1.0), step=1e-6),
        ),
        *(
            Family("1e-3 m", _turned_points(1.0, 1e-3, 1e-3)),
            Family("100 km away", _turned_points(1.0, 1e5, 1e5)),
        ),
        Family("1 m, placed 100 km away", _turned_points(1.0, 1.0, 1e5)),
    )
    families = tuple(
        dataclasses.replace(f, smooth=f.name in ("1 m", "no turn", "π", "100 km away"))
        for f in families
    )
    stress = Stress(
        name="to_world",
        title="points of a body in the world",
        domain="any finite points and placement",
        error="largest coordinate",
        families=families,
        ways=(Way("monopart", _world, True),),
        exact=lambda extra, p, turn, shift: _turned(p, turn) + shift,
        scale=lambda extra, exact, p, turn, shift: np.abs(p).max(1) + np.abs(shift).max() + 1e-30,
        wrt=(0, 1, 2),
        rows_apart=False,
        cases=64,
    )
    others = (
        ("to_local", "world points of a body", _local, lambda p, r, s: _turned(p - s, -r)),
        ("to_camera", "points of a camera", _seen, lambda p, r, s: _turned(p, r) + s),
        ("rays_at", "points along rays", _along, lambda p, r, s: p + s[0, 0] * r),
        ("smplx_translation", "translations of smplx", _smplx, lambda p, r, s: p + _moved(r, s)),
        ("smplx_back", "translations to smplx", _smplx_back, lambda p, r, s: p - _moved(r, s)),
    )
    made = [stress]
    for name, title, run, truth in others:
        exact = _without_extra(truth)
        ways = (Way("monopart", run, True),)
        made.append(dataclasses.replace(stress, name=name, title=title, ways=ways, exact=exact))
    return made


def _without_extra(truth: Any) -> Any:
    return lambda extra, *inputs: truth(*inputs)


def stresses() -> list[Stress]:
    """Operations on pixels, frames and boxes."""
    own = [_edits(), _undistorted(), _visible(), _in_boxes(), _box_masks(), _box_of()]
    return [*own, *_frames()]
