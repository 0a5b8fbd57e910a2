"""Our body laid on unrigged people in other poses, shapes, units, axes and resolutions."""

import numpy as np
import pytest
import torch
from sample_meshes import changed

from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.rotations import axis_angle_to_rotmat
from monopart.tools.body import build_body
from monopart.tools.meshio import Mesh
from monopart.tools.partition import default_body, partition
from monopart.tools.templates import bent, fitted_person, person


def posed(model: BodyModel, arms: float, legs: float, beta: float) -> np.ndarray:
    rest = BodyPose.zeros(model)
    pose = rest.pose.clone()
    pose[16, 2], pose[17, 2], pose[1, 2], pose[2, 2] = -arms, arms, legs, -legs
    pose[18, 1], pose[19, 1] = -0.15, 0.15
    betas = torch.full((model.num_betas,), beta)
    return model(BodyPose(pose, betas, rest.rotation, rest.translation)).verts.double().numpy()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arms", "legs", "beta"), [(0.0, 0.0, 0.0), (0.7, 0.1, 0.4), (1.15, 0.05, -0.5)]
)
def test_scans_in_other_poses_get_the_right_parts(arms: float, legs: float, beta: float) -> None:
    body = default_body()
    verts = 180 * posed(BodyModel.default(), arms, legs, beta)[:, [2, 0, 1]] + 5
    scan = changed(body, verts=verts, weights=None, skeleton=None, corner_uv=None)
    parts = partition(scan, "six")
    assert parts.method == "transfer" and not parts.notes
    assert (parts.face_part == partition(body, "six").face_part).mean() > 0.97
    assert parts.upright is not None and parts.upright.residual < 0.02
    up = parts.upright(verts)  # y up and the left side at +x, for pictures
    assert up[parts.vertex_part == parts.names.index("head"), 1].mean() > up[:, 1].mean() + 0.4
    assert up[parts.vertex_part == parts.names.index("left_arm"), 0].min() > 0


@pytest.mark.slow
def test_a_scan_of_other_triangles() -> None:
    model = BodyModel.from_arrays(build_body(num_faces=3000))
    verts, faces = posed(model, 0.6, 0.08, 0.3), model.faces.numpy()
    own = partition(Mesh(verts, faces, weights=model.weights.double().numpy()), "three")
    parts = partition(Mesh(verts * 0.01, faces), "three")
    assert (parts.face_part == own.face_part).mean() > 0.95


def test_bending_is_linear_blend_skinning() -> None:
    body, model = default_body(), BodyModel.default()
    rest = BodyPose.zeros(model)
    pose = rest.pose.clone()
    turns = {}
    for joint, turn in ((4, [0.3, 0, 0.1]), (16, [0, 0.5, -0.4]), (20, [0.2, 0.1, 0])):
        pose[joint] = torch.tensor(turn)
        turns[model.joint_names[joint]] = axis_angle_to_rotmat(pose[joint]).double().numpy()
    exact = model(BodyPose(pose, rest.betas, rest.rotation, rest.translation)).verts
    assert body.skeleton is not None
    assert np.abs(bent(body, body.skeleton, turns) - exact.double().numpy()).max() < 1e-5
    assert np.abs(bent(body, body.skeleton, {}) - body.verts).max() < 1e-6
    arms = person(body, 0.5, 0.2)
    assert arms[:, 1].min() > body.verts[:, 1].min() and np.ptp(arms[:, 0]) < np.ptp(
        body.verts[:, 0]
    )


def test_the_pose_is_found() -> None:
    body = default_body()
    target = person(body, 0.8, 0.15)
    found, moved = fitted_person(body, target, body.faces)
    assert np.linalg.norm(found - target, axis=1).mean() < 0.02
    assert moved.residual < 0.006 and moved.scale == pytest.approx(1, abs=0.02)
