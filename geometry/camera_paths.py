"""Cameras that move: around a point, and from one camera to another."""

import dataclasses
import math

import torch
from jaxtyping import Float
from torch import Tensor

from .camera_checks import intrinsics_from_fov
from .cameras import Camera
from .errors import InputError
from .norms import brought_to_one
from .rotations import axis_angle_to_rotmat, rotmat_to_axis_angle

NEAR_X = 0.9
"""Share of the first world axis in an axis from which on a ring starts from the second one."""


def _axis(up: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Unit vector of a direction of any finite length."""
    scaled = brought_to_one(up)
    length = scaled.norm()
    if not bool((length > 0) & length.isfinite()):
        raise InputError(f"up: expected a direction, found {up.tolist()}; pass e.g. (0, 0, 1)")
    return scaled / length


def orbit_cameras(
    camera: Camera, center: Float[Tensor, "3"], up: Float[Tensor, "3"], count: int
) -> list[Camera]:
    """Cameras on the circle through a given camera, around a vertical axis: a turntable.

    Args:
        camera: the first camera of the circle.
        center: a point of the axis, world metres, 3.
        up: direction of the axis, world axes, any length, 3; the cameras turn counter-clockwise
            seen from its tip.
        count: number of cameras, evenly spaced over the full circle.

    Returns:
        `count` cameras that see the axis as the given one does; the first one equals it.

    Raises:
        InputError: a count below one, an axis of zero length.
    """
    _check_count(count)
    axis, pivot = _axis(up).to(camera.K), center.to(camera.K)
    cross = torch.linalg.cross(axis.expand(3, 3), torch.eye(3).to(axis)).mT
    cameras = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        turn = torch.eye(3).to(axis) + math.sin(angle) * cross
        turn = turn + (1 - math.cos(angle)) * (cross @ cross)
        # x = pivot + turn (x0 - pivot) undone before the first camera's R and t
        R = camera.R @ turn.mT
        t = camera.t + (camera.R - R) @ pivot  # one difference: nothing is left of it at the start
        cameras.append(dataclasses.replace(camera, R=R, t=t))
    return cameras


def ring_of_cameras(
    target: Float[Tensor, "3"],
    up: Float[Tensor, "3"],
    distance: float,
    elevation: float,
    count: int,
    size: tuple[int, int],
    fov: float,
) -> list[Camera]:
    """Cameras on a circle around a point, all looking at it.

    Args:
        target: what they look at, world metres, 3.
        up: direction of the axis and of up in the images, world axes, any length, 3.
        distance: of every camera from the target, metres.
        elevation: angle above the plane through the target, radians, below π/2 in size.
        count: number of cameras, evenly spaced, counter-clockwise seen from the tip of `up`.
        size: (height, width) in pixels.
        fov: vertical field of view, radians.

    Returns:
        The cameras. Where the first stands is continuous in `up`, but for a jump 26° from the first
        world axis.

    Raises:
        InputError: a distance that is not positive, an elevation at the pole, no axis, no camera.

    >>> ring = ring_of_cameras(torch.zeros(3), torch.tensor([0.0, 0, 1]), 2.0, 0.0, 4, (8, 8), 1.0)
    >>> [round(float(c.center.norm()), 5) for c in ring]
    [2.0, 2.0, 2.0, 2.0]
    """
    if not (math.isfinite(distance) and distance > 0):
        raise InputError(f"distance: expected metres above 0, found {distance}; give a length")
    if not abs(elevation) < math.pi / 2:
        raise InputError(f"elevation: expected radians within π/2, found {elevation}; lower it")
    _check_count(count)
    axis = _axis(up.to(target))
    across, side = _across(axis)
    K, back = intrinsics_from_fov(axis, size, fov), distance * torch.eye(3).to(axis)[2]
    cameras = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        outwards = math.cos(angle) * across + math.sin(angle) * side
        right = math.cos(angle) * side - math.sin(angle) * across
        # Axes as they are, where look_at would divide by the cosine of the elevation.
        down = math.sin(elevation) * outwards - math.cos(elevation) * axis
        forward = -math.cos(elevation) * outwards - math.sin(elevation) * axis
        R = torch.stack((right, down, forward))
        cameras.append(Camera(K, R, back - R @ target, size))
    return cameras


def _across(axis: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Two unit vectors across an axis and each other, the second a quarter turn on."""
    # Some jump is unavoidable on a sphere: this one is far from the axes of the world.
    other = torch.zeros_like(axis)
    other[1 if bool(axis[0].abs() > NEAR_X) else 0] = 1
    across = torch.linalg.cross(axis, other)
    across = across / across.norm()
    return across, torch.linalg.cross(axis, across)


def _check_count(count: int) -> None:
    if count < 1:
        raise InputError(f"count: expected at least one camera, found {count}; pass count >= 1")


def blend_cameras(first: Camera, last: Camera, count: int) -> list[Camera]:
    """Cameras on the way from one to another: even turns about one axis, centres on a line.

    Args:
        first: where it starts.
        last: where it ends, of the same size and lens.
        count: number of cameras, both ends included, at least 2.

    Returns:
        The cameras; intrinsics change evenly, the ends are the given ones.

    Raises:
        InputError: fewer than two, or cameras of different sizes or lenses.

    >>> eye = torch.eye(3)
    >>> a, b = (Camera(eye, eye, torch.tensor([x, 0.0, 0.0]), (4, 4)) for x in (0.0, 2.0))
    >>> [c.t[0].item() for c in blend_cameras(a, b, 3)]
    [0.0, 1.0, 2.0]
    """
    if count < 2:
        raise InputError(f"count: expected at least 2 cameras, found {count}; include both ends")
    same_lens = first.lens == last.lens and torch.equal(first.distortion, last.distortion)
    if first.size != last.size or not same_lens:
        raise InputError(
            f"blend_cameras: expected cameras of one size and lens, found {first.size} and "
            f"{last.size} ({first.lens}, {last.lens}); resize or undistort one"
        )
    turn = rotmat_to_axis_angle(last.R @ first.R.mT)
    between = []
    for i in range(1, count - 1):
        share = i / (count - 1)
        R = axis_angle_to_rotmat(share * turn) @ first.R
        center = torch.lerp(first.center, last.center, share)
        K = torch.lerp(first.K, last.K, share)
        between.append(dataclasses.replace(first, K=K, R=R, t=-(R @ center)))
    return [first, *between, last]
