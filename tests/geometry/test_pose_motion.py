"""The closed derivative of skinned points against automatic differentiation of the body itself."""

import dataclasses

import numpy as np
import oracles
import pytest
import torch
from torch import Tensor

from monopart.geometry import joint_motion
from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.body_io import check_body
from monopart.geometry.errors import InputError
from monopart.geometry.kinematics import KinematicTree
from monopart.geometry.pose_motion import descendants
from monopart.geometry.rotations import axis_angle_to_rotmat, rotmat_to_axis_angle


def random_body(seed: int) -> BodyModel:
    arrays = oracles.random_body(seed, pose_blend=False)
    rounded = {k: v.astype(np.float32) if v.dtype.kind == "f" else v for k, v in arrays.items()}
    return BodyModel.from_arrays(check_body(rounded, "random body"))


@pytest.mark.parametrize("seed", range(3))
def test_is_the_derivative_of_the_body(seed: int) -> None:
    torch.manual_seed(seed)
    body = random_body(seed)
    pose = BodyPose(
        0.7 * torch.randn(body.num_joints, 3, dtype=torch.float64),
        torch.zeros(body.num_betas, dtype=torch.float64),
        torch.zeros(3, dtype=torch.float64),
        torch.zeros(3, dtype=torch.float64),
    )

    def verts(turn: Tensor) -> Tensor:
        both = rotmat_to_axis_angle(axis_angle_to_rotmat(turn) @ axis_angle_to_rotmat(pose.pose))
        return body(dataclasses.replace(pose, pose=both)).verts

    expected = torch.autograd.functional.jacobian(verts, torch.zeros_like(pose.pose))
    posed = body(pose)
    found = joint_motion(
        body.v_template.double(),
        body.weights.double(),
        posed.transforms,
        posed.joints,
        body.tree,
    )
    # [vertex, xyz, joint, axis] against [vertex, joint, axis, xyz]
    torch.testing.assert_close(found, expected.permute(0, 2, 3, 1), atol=1e-10, rtol=1e-8)


def test_a_joint_moves_what_it_carries_alone() -> None:
    tree = KinematicTree((-1, 0, 1, 0))
    assert descendants(tree)[:, 1].tolist() == [0.0, 1.0, 1.0, 0.0]
    transforms = torch.eye(4).repeat(4, 1, 1)
    joints = torch.tensor([[0.0, 0, 0], [0, 1, 0], [0, 2, 0], [1, 0, 0]])
    point, weights = torch.tensor([[0.0, 3.0, 0.0]]), torch.tensor([[0.0, 0.0, 1.0, 0.0]])
    moved = joint_motion(point, weights, transforms, joints, tree)[0]
    levers = torch.tensor([3.0, 2.0, 1.0, 0.0])
    assert torch.equal(moved[:, 2, 0], -levers)  # about z, upwards goes to -x
    assert torch.equal(moved[:, 0, 2], levers) and not moved[:, 1].any()


def test_no_points() -> None:
    tree = KinematicTree((-1, 0))
    nothing = joint_motion(
        torch.zeros(0, 3), torch.zeros(0, 2), torch.eye(4).repeat(2, 1, 1), torch.zeros(2, 3), tree
    )
    assert nothing.shape == (0, 2, 3, 3)


def test_another_body_is_refused() -> None:
    with pytest.raises(InputError, match="expected 2 joints"):
        joint_motion(
            torch.zeros(1, 3),
            torch.ones(1, 2) / 2,
            torch.eye(4).repeat(3, 1, 1),
            torch.zeros(2, 3),
            KinematicTree((-1, 0)),
        )
