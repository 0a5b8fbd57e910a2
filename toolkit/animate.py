"""Moving pictures of an avatar: the turntable."""

import numpy as np
import torch

from monopart.geometry.body import BodyPose
from monopart.geometry.camera_paths import orbit_cameras
from monopart.geometry.cameras import Camera
from monopart.geometry.errors import InputError

from .avatar import Avatar, View
from .captures.records import CaptureRecord


def turntable_views(
    avatar: Avatar, count: int, frame: int | None = None, size: int | None = None
) -> list[View]:
    """Views from cameras on a circle around the person, who keeps one pose.

    Args:
        avatar: the person.
        count: number of views of one turn.
        frame: frame that gives the pose; the first training frame if None.
        size: longer side of the pictures, pixels; the training camera's if None.

    Raises:
        InputError: no such frame.
    """
    record = avatar.record
    train = record.split("train")
    frame = train.frames[0] if frame is None else frame
    pose = pose_of(record, frame)
    with torch.no_grad():
        joints = record.body(pose)
    center = joints.to_world(joints.joints).mean(0)
    camera = record.cameras[train.cameras[0]]
    if size is not None:
        camera = camera.resized(size / max(camera.size))
    up = world_up(record.cameras)
    cameras = orbit_cameras(camera, center, up, count)
    return [View(c, pose, frame) for c in cameras]


def pose_of(record: CaptureRecord, frame: int) -> BodyPose:
    """The body pose of a frame.

    Raises:
        InputError: the frame has none.
    """
    if frame not in record.poses:
        known = sorted(record.poses)
        raise InputError(
            f"--frame {frame}: expected a frame with a body pose, {known[0]} to {known[-1]}, "
            "found none; choose one of these"
        )
    return record.poses[frame]


def world_up(cameras: list[Camera]) -> torch.Tensor:
    """The world axis nearest to the mean upward direction of the cameras."""
    mean = torch.stack([-c.R[1] for c in cameras]).mean(0)
    axis = int(mean.abs().argmax())
    up = torch.zeros_like(mean)
    up[axis] = 1.0 if float(mean[axis]) > 0 else -1.0
    return up


def as_uint8(image: torch.Tensor) -> np.ndarray:
    """A float image in [0, 1] as eight bits a channel."""
    return (image * 255.0).round().clamp(0, 255).to(torch.uint8).cpu().numpy()
