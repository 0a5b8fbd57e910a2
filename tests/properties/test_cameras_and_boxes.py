"""Cameras and boxes follow motions, scales, mirrors, crops and resizes."""

import dataclasses
import math

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from motions import Motion, close, generator, motions, normal, seeds, shuffled, unit
from torch import Tensor

from monopart.geometry.boxes import box_of, in_box, ray_box
from monopart.geometry.camera_paths import orbit_cameras
from monopart.geometry.cameras import Camera, Rays

PIXELS = 1e-9  # float64
FAR = 0.02  # pixels at 60 pixels per metre of depth 3: roundings of 7.6e-6 m at 100 m
FEW = settings(max_examples=20)
LENS = torch.tensor([-0.2, 0.05, 1e-3, -2e-3, 0.01], dtype=torch.float64)
lenses = st.sampled_from([torch.zeros(0, dtype=torch.float64), LENS])


def camera(seed: int, lens: Tensor) -> Camera:
    """A camera with skew, unequal focal lengths and its centre off the middle."""
    g = generator(seed)
    fx, fy, s, cx, cy = (torch.rand(5, generator=g).double() * 2 - 1).tolist()
    K = torch.tensor([[70 + 9 * fx, 4 * s, 32 + 5 * cx], [0, 60 + 9 * fy, 24 + 5 * cy], [0, 0, 1]])
    up = unit(seed)
    eye = 3 * unit(seed + 1)
    target = 0.2 * unit(seed + 2)
    looking = Camera.look_at(eye, target, up, (48, 64), K=K.double())
    return dataclasses.replace(looking, distortion=lens)


def seen(seed: int, cam: Camera, count: int = 20) -> tuple[Tensor, Tensor]:
    """Points in front of a camera and inside its picture, and how far away they are."""
    g = generator(seed)
    pixels = torch.rand(count, 2, generator=g).double() * torch.tensor([64.0, 48.0])
    far = torch.rand(count, generator=g).double() * 4 + 0.5
    return cam.rays(pixels).at(far), far


def moved(cam: Camera, motion: Motion) -> Camera:
    """The same camera in a world where x became motion(x)."""
    R = cam.R @ motion.rotmat.mT
    return dataclasses.replace(cam, R=R, t=cam.t - R @ motion.shift)


@FEW
@given(seeds, lenses, motions())
def test_pictures_do_not_know_where_the_world_is(seed: int, lens: Tensor, motion: Motion) -> None:
    cam = camera(seed, lens)
    points, _ = seen(seed, cam)
    other = moved(cam, motion)
    pixels, depth = cam.project(points)
    again, other_depth = other.project(motion(points))
    close(again, pixels, PIXELS)
    close(other_depth, depth, PIXELS)
    close(other.center, motion(cam.center), PIXELS)
    rays, turned = cam.rays(pixels), other.rays(pixels)
    close(turned.directions, motion.turn(rays.directions), PIXELS)
    close(turned.origins, motion(rays.origins), PIXELS)
    assert torch.equal(other.visible(motion(points)), cam.visible(points))


@FEW
@given(seeds, lenses, st.sampled_from([1e-3, 0.3, 1e3]))
def test_pictures_do_not_know_the_scale_of_the_world(seed: int, lens: Tensor, scale: float) -> None:
    cam = camera(seed, lens)
    points, _ = seen(seed, cam)
    other = dataclasses.replace(cam, t=scale * cam.t)
    pixels, depth = cam.project(points)
    again, other_depth = other.project(scale * points)
    close(again, pixels, PIXELS)
    close(other_depth / scale, depth, PIXELS)


@FEW
@given(seeds, lenses)
def test_pixel_to_ray_to_pixel(seed: int, lens: Tensor) -> None:
    cam = camera(seed, lens)
    g = generator(seed)
    pixels = torch.rand(30, 2, generator=g).double() * torch.tensor([64.0, 48.0])
    rays, valid = cam.rays_with_mask(pixels)
    assert bool(valid.all())
    far = torch.rand(30, generator=g).double() * 5 + 0.1
    points = rays.at(far)
    back, depth = cam.project(points)
    close(back, pixels, 1e-8)
    close((points - cam.center).norm(dim=-1), far, 1e-12)
    axis = cam.R[2]
    close(depth, far * (rays.directions @ axis), 1e-12)


@FEW
@given(seeds, lenses)
def test_points_of_one_ray_share_a_pixel(seed: int, lens: Tensor) -> None:
    cam = camera(seed, lens)
    points, _ = seen(seed, cam)
    nearer = cam.center + 0.3 * (points - cam.center)
    close(cam.project(nearer)[0], cam.project(points)[0], 1e-8)


@FEW
@given(seeds)
def test_the_mirror_image(seed: int) -> None:
    """A mirrored world seen by the mirrored camera is the picture flipped left to right."""
    cam = camera(seed, torch.zeros(0, dtype=torch.float64))
    flip = torch.diag(torch.tensor([-1.0, 1, 1], dtype=torch.float64))
    K = cam.K.clone()
    K[0, 1], K[0, 2] = -K[0, 1], cam.size[1] - K[0, 2]
    other = dataclasses.replace(cam, K=K, R=flip @ cam.R @ flip, t=flip @ cam.t)
    points, _ = seen(seed, cam)
    pixels, depth = cam.project(points)
    again, other_depth = other.project(points @ flip)
    close(again, torch.stack([cam.size[1] - pixels[:, 0], pixels[:, 1]], -1), PIXELS)
    close(other_depth, depth, PIXELS)


@FEW
@given(seeds, lenses, st.integers(-20, 20), st.integers(-20, 20), st.sampled_from([0.5, 2.0, 3.0]))
def test_crops_and_resizes_compose(seed: int, lens: Tensor, x: int, y: int, scale: float) -> None:
    cam = camera(seed, lens)
    points, _ = seen(seed, cam)
    pixels = cam.project(points)[0]
    corner = torch.tensor([x, y])
    crop = cam.cropped((x, y, x + 40, y + 30))
    close(crop.project(points)[0], pixels - corner, PIXELS)
    twice = crop.cropped((3, -2, 30, 20))
    direct = cam.cropped((x + 3, y - 2, x + 30, y + 20))
    close(twice.K, direct.K, PIXELS)
    assert twice.size == direct.size
    both = crop.resized(scale)
    close(both.project(points)[0], scale * (pixels - corner), PIXELS)
    close(cam.resized(scale).resized((48, 64)).K, cam.K, PIXELS)
    close(cam.resized(2.0).resized(1.5).K, cam.resized(3.0).K, PIXELS)


@FEW
@given(seeds, st.integers(2, 9))
def test_turntables_close_and_turn_the_right_way(seed: int, count: int) -> None:
    cam = camera(seed, torch.zeros(0, dtype=torch.float64))
    center, up = 0.3 * unit(seed + 5), unit(seed + 6)
    ring = orbit_cameras(cam, center, up, count)
    close(ring[0].R, cam.R, 1e-12)
    next_ring = orbit_cameras(ring[1], center, up, count)
    for i in range(count):
        close(next_ring[i].R, ring[(i + 1) % count].R, 1e-12)
        close(next_ring[i].t, ring[(i + 1) % count].t, 1e-12)
        arm = ring[i].center - center
        close((arm @ up)[None], ((cam.center - center) @ up)[None], 1e-12)
    first, second = ring[0].center - center, ring[1].center - center
    first, second = first - (first @ up) * up, second - (second @ up) * up
    if count > 2 and float(first.norm()) > 1e-3:  # counter-clockwise seen from the tip of up
        sine = torch.linalg.cross(first, second) @ up / first.square().sum()
        close(sine, torch.tensor(math.sin(2 * math.pi / count), dtype=sine.dtype), 1e-9)


@FEW
@given(seeds, lenses)
def test_the_order_of_points_does_not_matter(seed: int, lens: Tensor) -> None:
    cam = camera(seed, lens)
    points, _ = seen(seed, cam)
    order = shuffled(seed, len(points))
    pixels = cam.project(points)[0]
    close(cam.project(points[order])[0], pixels[order], 1e-12)
    close(cam.rays(pixels[order]).directions, cam.rays(pixels).directions[order], 1e-12)


@FEW
@given(seeds)
def test_pictures_100_m_away(seed: int) -> None:
    cam = camera(seed, torch.zeros(0, dtype=torch.float64))
    points, _ = seen(seed, cam)
    points = points[(points - cam.center).norm(dim=-1) > 1.0]
    away = Motion(torch.eye(3, dtype=torch.float64), 100 * unit(seed))
    single = torch.zeros((), dtype=torch.float32)
    far = moved(cam, away).to(single)
    pixels, _ = far.project(away(points).float())
    close(pixels.double(), cam.project(points)[0], FAR)


# --- boxes ----------------------------------------------------------------------------------------


@FEW
@given(seeds, st.sampled_from([0.25, 4.0]))
def test_boxes_follow_shifts_scales_and_swapped_axes(seed: int, scale: float) -> None:
    points, shift = normal(seed, 9, 3), normal(seed + 1, 3)
    lo, hi = box_of(points, 0.1)
    origins, way = 3 * normal(seed + 2, 40, 3), normal(seed + 3, 40, 3)
    rays = Rays(origins, way / way.norm(dim=-1, keepdim=True))
    near, far, hit = ray_box(rays, lo, hi)
    axes = torch.tensor([2, 0, 1])
    others = [
        (Rays(origins + shift, rays.directions), lo + shift, hi + shift, 1.0),
        (Rays(scale * origins, rays.directions), scale * lo, scale * hi, scale),
        (Rays(origins[:, axes], rays.directions[:, axes]), lo[axes], hi[axes], 1.0),
        (Rays(-origins, -rays.directions), -hi, -lo, 1.0),
    ]
    for other, low, high, size in others:
        found = ray_box(other, low, high)
        assert torch.equal(found[2], hit)
        close(found[0], size * near, 1e-12)
        close(found[1], size * far, 1e-12)
    middle = rays.at((near + far) / 2)[hit]
    assert bool(in_box(middle, lo - 1e-9, hi + 1e-9).all())
    behind = Rays(rays.at(far + 0.01), rays.directions)
    assert not bool(ray_box(behind, lo, hi)[2][hit].any())
