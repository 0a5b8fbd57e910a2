"""World → camera → pixel → ray → world comes back within 1e-5 m, for any camera and lens."""

import math

import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from monopart.geometry.cameras import Camera
from monopart.geometry.rotations import axis_angle_to_rotmat

F64 = torch.float64
BOUND = 1e-5
# k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 τx τy, as lenses are calibrated
_LARGEST = (0.3, 0.1, 5e-3, 5e-3, 0.02, 0.3, 0.1, 0.02, 0.01, 2e-3, 0.01, 2e-3, 0.3, 0.3)


UNIT = st.floats(-1, 1, width=32)
NUMBERS = {
    "kind": st.sampled_from(
        [("brown", n) for n in (0, 4, 5, 8, 12, 14)] + [("fisheye", n) for n in (0, 4)]
    ),
    "units": st.tuples(*[UNIT] * 25),
    "size": st.tuples(st.integers(16, 1080), st.integers(16, 1920)),
    "focal": st.tuples(st.floats(0.4, 4), st.floats(0.8, 1.25)),
    "seed": st.integers(0, 2**31),
}


def make(
    kind: tuple[str, int],
    units: tuple[float, ...],
    size: tuple[int, int],
    focal: tuple[float, float],
) -> Camera:
    """Any camera that a person may own, up to 5 m from the origin."""
    lens, count = kind
    largest = (_LARGEST if lens == "brown" else (0.1, 0.05, 0.02, 0.01))[:count]
    k = [scale * unit for scale, unit in zip(largest, units, strict=False)]
    u = units[14:]
    fx = max(size) * focal[0]
    cx, cy = size[1] * (0.5 + 0.2 * u[0]), size[0] * (0.5 + 0.2 * u[1])
    K = torch.tensor([[fx, 2 * u[2], cx], [0, fx * focal[1], cy], [0, 0, 1]], dtype=F64)
    R = axis_angle_to_rotmat(3.2 * torch.tensor(u[3:6], dtype=F64))
    center = 3 * torch.tensor(u[6:9], dtype=F64)
    return Camera(K, R, -(R @ center), size, torch.tensor(k, dtype=F64), lens)


def _seen(camera: Camera, seed: int) -> torch.Tensor:
    """World points in front of a camera, well inside the fold of its lens, 0.3 to 5 m deep."""
    generator = torch.Generator().manual_seed(seed)
    radius = min(0.8 * camera.fold_radius, 2.0)
    r, a, depth = torch.rand(3, 64, generator=generator, dtype=F64)
    r, a, depth = radius * r.sqrt(), 2 * math.pi * a, 0.3 + 4.7 * depth
    local = torch.stack([r * a.cos(), r * a.sin(), torch.ones_like(r)], -1) * depth[:, None]
    return (local - camera.t) @ camera.R


def _comes_back(camera: Camera, points: torch.Tensor, bound: float) -> None:
    pixels, depth = camera.project(points)
    rays, valid = camera.rays_with_mask(pixels)
    assert bool((depth > 0).all())
    again = rays.at((points - camera.center.to(points)).norm(dim=-1))
    assert bool(valid.all())
    assert bool(((again - points).abs() <= bound).all())


@settings(max_examples=60, deadline=None)
@given(**NUMBERS)
def test_double(kind, units, size, focal, seed) -> None:
    camera = make(kind, units, size, focal)
    assume(camera.fold_radius > 0.05)
    _comes_back(camera, _seen(camera, seed), 1e-9)


@settings(max_examples=60, deadline=None)
@given(**NUMBERS)
def test_single(kind, units, size, focal, seed) -> None:
    camera = make(kind, units, size, focal)
    assume(camera.fold_radius > 0.05)
    points = _seen(camera, seed)  # a pixel far outside the image has fewer digits left
    single = camera.to(torch.zeros(()))
    _comes_back(single, points[camera.visible(points)].float(), BOUND)


@settings(max_examples=60, deadline=None)
@given(**NUMBERS)
def test_every_pixel_has_a_ray_that_returns_or_a_mask(kind, units, size, focal, seed) -> None:
    camera = make(kind, units, size, focal)
    generator = torch.Generator().manual_seed(seed)
    sides = torch.tensor([camera.size[1], camera.size[0]])
    pixels = (torch.rand(64, 2, generator=generator, dtype=F64) * 1.4 - 0.2) * sides
    rays, valid = camera.rays_with_mask(pixels)
    assert bool(torch.isfinite(rays.directions).all())
    again, _ = camera.project(rays.at(torch.full((64,), 2.0, dtype=F64)))
    assert float(((again - pixels).abs() * valid[:, None]).max()) <= 1e-6
