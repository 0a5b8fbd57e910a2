"""Cameras that move: around a point, and from one camera to another."""

import dataclasses
import math

import torch
from jaxtyping import Float
from torch import Tensor

from .cameras import Camera
from .errors import InputError


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
    length = float(up.norm())
    if count < 1:
        raise InputError(f"count: expected at least one camera, found {count}; pass count >= 1")
    if not length > 0:
        raise InputError(f"up: expected a direction, found {up.tolist()}; pass e.g. (0, 0, 1)")
    axis, pivot = (up / length).to(camera.K), center.to(camera.K)
    cross = torch.linalg.cross(axis.expand(3, 3), torch.eye(3).to(axis)).mT
    cameras = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        turn = torch.eye(3).to(axis) + math.sin(angle) * cross
        turn = turn + (1 - math.cos(angle)) * (cross @ cross)
        # x = pivot + turn (x0 - pivot) undone before the first camera's R and t
        R = camera.R @ turn.mT
        t = camera.t + camera.R @ pivot - R @ pivot
        cameras.append(dataclasses.replace(camera, R=R, t=t))
    return cameras
