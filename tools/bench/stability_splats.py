"""Stress of 3D Gaussians as a camera sees them, and of their pictures."""

import numpy as np
import torch
from torch import Tensor

from monopart.fields.splats import (
    BLUR,
    DENSE,
    FAINT,
    NEAREST,
    SPENT,
    Gaussians,
    project_gaussians,
    render_gaussians,
)
from monopart.geometry.cameras import Camera

from .stability_cases import DOUBLE, Backend, Family, Inputs, Stress, Way, kinds_of
from .stability_rotations import Make, axes, exact_rotmat

_FOCAL, _SIDE = 24.0, 12
_NONE = (0.0, 0.0, 0.0)
_EXACT = np.longdouble


def _camera(like: Tensor) -> Camera:
    K = torch.tensor([[_FOCAL, 0, _SIDE / 2], [0, _FOCAL, _SIDE / 2], [0, 0, 1]], dtype=DOUBLE)
    eye = torch.eye(3, dtype=DOUBLE)
    return Camera(K, eye, torch.zeros(3, dtype=DOUBLE), (_SIDE, _SIDE)).to(like)


def _cloud(
    depth: float, sizes: tuple[float, float, float], aside: float = 0.2, dense: float | None = None
) -> Make:
    """Gaussians at a depth, of three sizes, turned anyhow, aside by a share of the depth."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        count = max(count, 3)
        way = torch.randn(count, 3, generator=generator, dtype=DOUBLE)
        points = depth * torch.cat((aside * way[:, :2], 1 + 0.3 * way[:, 2:].tanh()), 1)
        turn = torch.from_numpy(exact_rotmat(None, axes(generator, count).numpy()))
        share = torch.rand(4, count, generator=generator, dtype=DOUBLE)
        opacity = share[0] if dense is None else torch.full_like(share[0], dense)
        return points, turn * torch.tensor(sizes, dtype=DOUBLE), opacity, share[1:].mT.contiguous()

    return make


def _shapes(cloud: Make) -> Make:
    return lambda generator, count: cloud(generator, count)[:2]


def _rows(means: Tensor, entries: Tensor, size: Tensor, depth: Tensor) -> Tensor:
    """Places over the focal length, covariances over their square size, depths below 1."""
    return torch.cat((means / _FOCAL, entries / size[:, None], (depth / (1 + depth))[:, None]), 1)


def _project(extra: None, points: Tensor, factors: Tensor) -> Tensor:
    faint, black = points.new_ones(len(points)), torch.zeros_like(points)
    seen = project_gaussians(Gaussians(points, factors, faint, black), _camera(points))
    r = points[:, :2].square().sum(-1) / points[:, 2].square()
    size = factors.square().sum((1, 2)) * _FOCAL**2 * (1 + r) / points[:, 2].square() + BLUR
    return _rows(seen.means, seen.covariances, size, seen.depth)


def exact_project(extra: None, points: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """One Gaussian at a time, in extended precision, by the derivative of the projection."""
    out = []
    for point, factor in zip(points.astype(_EXACT), factors.astype(_EXACT), strict=True):
        x, y, z = point
        slope = _FOCAL * np.array([[1 / z, 0, -x / z**2], [0, 1 / z, -y / z**2]])
        covariance = slope @ factor @ factor.T @ slope.T + _EXACT(BLUR) * np.eye(2)
        r = (x * x + y * y) / z**2
        size = (factor * factor).sum() * _FOCAL**2 * (1 + r) / z**2 + _EXACT(BLUR)
        place = [x / z + _SIDE / 2 / _FOCAL, y / z + _SIDE / 2 / _FOCAL]
        entries = [covariance[0, 0] / size, covariance[0, 1] / size, covariance[1, 1] / size]
        out.append([*place, *entries, z / (1 + z)])
    return np.array(out, dtype=np.float64)


def _projection() -> Stress:
    small, flat = (0.01, 0.02, 0.03), (0.02, 0.02, 0.0)
    shapes = (
        *(
            ("usual", 2.0, small, 0.2),
            ("flat", 2.0, flat, 0.2),
            ("points", 2.0, _NONE, 0.2),
        ),
        *(("needles", 2.0, (1.0, 1e-6, 1e-6), 0.2), ("1e-12 m", 2.0, (1e-12, 1e-12, 1e-12), 0.2)),
        *(("100 m", 2.0, (100.0, 50.0, 1.0), 0.2), ("2 cm away", 0.02, small, 0.2)),
        *(("10 km away", 1e4, small, 0.2), ("89° aside", 2.0, small, 50.0)),
    )
    families = [Family(name, _shapes(_cloud(d, s, a)), step=1e-6 * d) for name, d, s, a in shapes]
    return Stress(
        name="project_gaussians",
        title="Gaussians as a camera sees them",
        domain="Gaussians of any size farther than 1 cm ahead; nearer ones mean nothing and are "
        "not drawn; a camera with a lens is an error",
        error="1 + r: place over focal length, covariance over its largest possible size",
        families=tuple(families),
        ways=(Way("monopart", _project, True),),
        exact=exact_project,
        scale=lambda extra, found, points, factors: (
            1 + np.linalg.norm(points[:, :2], axis=1) / points[:, 2]
        ),
        wrt=(0, 1),
    )


# --- pictures ----------------------------------------------------------------------------------


def _picture(backend: Backend) -> Way:
    def run(extra: None, *parts: Tensor) -> Tensor:
        return render_gaussians(Gaussians(*parts), _camera(parts[0]), backend).flatten(0, 1)

    return Way(f"monopart {backend}", run, True, kinds_of(backend))


def exact_picture(extra: None, *parts: np.ndarray) -> np.ndarray:
    """Pixel after pixel, splat after splat from the nearest on, in extended precision."""
    points, factors, opacity, color = (part.astype(_EXACT) for part in parts)
    out = np.zeros((_SIDE, _SIDE, 4), dtype=_EXACT)
    light = np.ones((_SIDE, _SIDE), dtype=_EXACT)
    columns, rows = np.meshgrid(np.arange(_SIDE) + _EXACT(0.5), np.arange(_SIDE) + _EXACT(0.5))
    for i in np.argsort(points[:, 2], kind="stable"):
        x, y, z = points[i]
        if z <= NEAREST:
            continue
        slope = _FOCAL * np.array([[1 / z, 0, -x / z**2], [0, 1 / z, -y / z**2]])
        u, v = slope @ factors[i]
        blur = _EXACT(BLUR)
        xx, xy, yy = u @ u + blur, u @ v, v @ v + blur
        area = np.cross(u, v)
        det = area @ area + blur * (u @ u + v @ v) + blur**2
        dx, dy = columns - _FOCAL * x / z - _SIDE / 2, rows - _FOCAL * y / z - _SIDE / 2
        alpha = opacity[i] * np.exp(-(yy * dx * dx + xx * dy * dy - 2 * xy * dx * dy) / (2 * det))
        alpha = np.where((alpha >= FAINT) & (light >= SPENT), np.minimum(alpha, DENSE), 0)
        out[..., :3] += (light * alpha)[..., None] * color[i]
        out[..., 3] += light * alpha
        light = light * (1 - alpha)
    return out.reshape(-1, 4).astype(np.float64)


def _pictures() -> Stress:
    small, half = (0.02, 0.05, 0.1), 0.5
    shapes = (
        *(("usual", _cloud(2.0, small)), ("points", _cloud(2.0, _NONE))),
        *(
            ("needles", _cloud(2.0, (100.0, 1e-6, 1e-6))),
            ("walls", _cloud(2.0, (99.0, 99.0, 0.0))),
        ),
        *(("opaque", _cloud(2.0, small, dense=1.0)), ("none seen", _cloud(2.0, small, dense=0.0))),
        *(("at the camera", _cloud(0.0, small)), ("behind it", _cloud(-2.0, small))),
        *(
            ("1 km away", _cloud(1e3, (10.0, 20.0, 40.0))),
            ("2 cm away", _cloud(0.02, (1e-3, 1e-3, 1e-3))),
        ),
        ("one", lambda g, n: tuple(x[:1] for x in _cloud(2.0, small, 0.0, half)(g, n))),
        ("no Gaussians", lambda g, n: tuple(x[:0] for x in _cloud(2.0, small)(g, n))),
    )
    # A splat ends where it is fainter than 1/255: pictures have small steps, so no differences.
    families = [Family(name, make, smooth=name == "one", step=1e-7) for name, make in shapes]
    return Stress(
        name="render_gaussians",
        title="pictures of Gaussians",
        domain="any finite Gaussians, opacities in [0, 1]; what is nearer than 1 cm or behind is "
        "not drawn; needles and walls of any length; none at all give black",
        error="1 + pixels off the optical centre over 0.55, the width of the narrowest splat",
        families=tuple(families),
        ways=(_picture("torch"), _picture("warp")),
        exact=exact_picture,
        scale=_slope,
        wrt=(0, 1, 2, 3),
        cases=24,
        rows_apart=False,
    )


def _slope(extra: None, found: np.ndarray, points: np.ndarray, *rest: np.ndarray) -> float:
    seen = points[points[:, 2] > NEAREST]
    aside = np.abs(seen[:, :2] / seen[:, 2:]).max() if len(seen) else 0.0
    return 1 + (_SIDE / 2 + _FOCAL * float(aside)) / BLUR**0.5


def splats() -> list[Stress]:
    """Operations on Gaussians."""
    return [_projection(), _pictures()]
