"""How far the joints of a track are from those of another: whole, across the image, and in depth.

One camera hardly sees depth, so its share of the error is told apart from that in the image plane.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from monopart.geometry.body import BodyPose
from monopart.geometry.errors import InputError

from .avatar import Avatar
from .captures.records import CaptureRecord
from .scene import stack_poses


@dataclass(frozen=True)
class JointError:
    """Differences of the joints of two tracks over all frames and joints, not aligned, metres.

    Attributes:
        mean: mean distance in the world.
        across: root mean square of the part parallel to the image plane of the training camera.
        depth: root mean square of the part along its axis.
        constant: mean length of the offset that a joint has in all frames in the axes of the body;
            an avatar trained on the track takes it over, and no picture shows it.
    """

    mean: float
    across: float
    depth: float
    constant: float


@torch.no_grad()
def joint_errors(avatar: Avatar, truth: CaptureRecord) -> tuple[JointError, JointError]:
    """Errors of the joints of the training frames against other poses of them.

    Args:
        avatar: the trained person with its learned poses.
        truth: the same capture with the other body track.

    Returns:
        At the poses as given, and at the learned ones.

    Raises:
        InputError: the other track lacks a training frame or is of another body.
    """
    frames, body = avatar.memory.frames, avatar.record.body
    lacking = [f for f in frames if f not in truth.poses]
    if lacking or truth.body.num_joints != body.num_joints:
        raise InputError(
            f"{truth.params}: expected poses of {body.num_joints} joints in frame "
            f"{(lacking or frames)[0]}, found none; name another track"
        )

    def joints(poses: dict[int, BodyPose]) -> tuple[Tensor, Tensor]:
        posed = body(stack_poses([poses[f].to(body.v_template) for f in frames]))
        return posed.to_world(posed.joints), posed.rotation

    exact, axes = joints(truth.poses)
    camera = avatar.record.cameras[avatar.record.split("train").cameras[0]]

    def error(poses: dict[int, BodyPose]) -> JointError:
        off = joints(poses)[0] - exact
        seen = off @ camera.R.to(off).mT
        constant = (off @ axes).mean(0)  # in the axes of the body
        squares = seen.square().mean((0, 1))
        return JointError(
            mean=float(off.norm(dim=-1).mean()),
            across=float(squares[:2].sum().sqrt()),
            depth=float(squares[2].sqrt()),
            constant=float(constant.norm(dim=-1).mean()),
        )

    return error(avatar.given or avatar.record.poses), error(avatar.record.poses)


def joint_error_table(given: JointError, learned: JointError) -> str:
    """Text: a line with the errors at the poses as given beside those at the learned ones.

    Args:
        given: at the poses as given.
        learned: at the learned ones.

    >>> one, two = JointError(0.02, 0.01, 0.015, 0.004), JointError(0.01, 0.005, 0.008, 0.003)
    >>> print(joint_error_table(one, two))
    joint error, mm (mean; rms across the image, in depth; constant): as given 20.00; 10.0, 15.0; \
4.0 | learned 10.00; 5.0, 8.0; 3.0
    """

    def cell(error: JointError) -> str:
        parts = 1e3 * error.mean, 1e3 * error.across, 1e3 * error.depth, 1e3 * error.constant
        return "{:.2f}; {:.1f}, {:.1f}; {:.1f}".format(*parts)

    return (
        "joint error, mm (mean; rms across the image, in depth; constant): "
        f"as given {cell(given)} | learned {cell(learned)}"
    )
