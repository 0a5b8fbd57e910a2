"""The body against plain float64 loops and against the vertices of the captures."""

import dataclasses
from pathlib import Path

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from monopart.geometry.body import BodyModel, BodyPose, PosedBody, convert_smplx_translation
from monopart.geometry.body_io import check_body, read_npy_object
from monopart.geometry.errors import BackendError, InputError
from monopart.geometry.rigid import transform_points
from monopart.geometry.rotations import axis_angle_to_rotmat


def body_of(arrays: dict[str, np.ndarray]) -> BodyModel:
    # the model stores float32: round first, so that the loops see the same numbers
    rounded = {k: v.astype(np.float32) if v.dtype.kind == "f" else v for k, v in arrays.items()}
    arrays.update({k: v.astype(np.float64) for k, v in rounded.items() if v.dtype.kind == "f"})
    return BodyModel.from_arrays(check_body(rounded, "random body"))


def random_pose(body: BodyModel, *batch: int, scale: float = 0.7) -> BodyPose:
    return BodyPose(
        pose=scale * torch.randn(*batch, body.num_joints, 3, dtype=torch.float64),
        betas=torch.randn(*batch, body.num_betas, dtype=torch.float64),
        rotation=torch.randn(*batch, 3, dtype=torch.float64),
        translation=torch.randn(*batch, 3, dtype=torch.float64),
    )


@pytest.fixture(scope="module")
def small() -> BodyModel:
    return body_of(oracles.random_body(0))


@pytest.mark.parametrize("pose_blend", [True, False])
@pytest.mark.parametrize("batch", [(), (2,), (2, 2), (0,)])
def test_against_the_loops(batch: tuple[int, ...], pose_blend: bool) -> None:
    arrays = oracles.random_body(3, pose_blend=pose_blend)
    body = body_of(arrays)
    assert body.has_pose_blend_shapes == pose_blend
    pose = random_pose(body, *batch)
    posed = body(pose)
    assert posed.verts.shape == (*batch, body.num_verts, 3)
    assert posed.joints.shape == (*batch, body.num_joints, 3)
    assert posed.transforms.shape == (*batch, body.num_joints, 4, 4)
    assert posed.verts_world.shape == posed.verts.shape
    angles, betas = pose.pose.reshape(-1, body.num_joints, 3), pose.betas.reshape(-1, 4)
    for i in range(len(betas)):
        found = (posed.verts, posed.joints, posed.transforms)
        expected = oracles.pose_body(arrays, angles[i].numpy(), betas[i].numpy())
        for have, want in zip(found, expected, strict=True):
            np.testing.assert_allclose(
                have.flatten(0, len(batch) - 1)[i] if batch else have, want, atol=3e-7
            )


def test_pose_blend_shapes_are_in_the_vertices_and_not_in_the_transforms(small: BodyModel) -> None:
    arrays = oracles.random_body(0, pose_blend=False)
    plain, pose = body_of(arrays), random_pose(small)
    assert torch.equal(plain(pose).transforms, small(pose).transforms)
    assert (plain(pose).verts - small(pose).verts).norm(dim=-1).max() > 1e-3


def test_default_body_in_float32_against_the_loops() -> None:
    body = BodyModel.default()
    arrays = {
        "v_template": body.v_template,
        "weights": body.weights,
        "J_regressor": body.joint_regressor,
        "kintree_table": torch.tensor([body.tree.parents]),
        "shapedirs": body.shapedirs,
        "posedirs": body.posedirs,
    }
    pose = random_pose(body, scale=0.5).to(torch.zeros(1))
    posed = body(pose)
    assert posed.verts.dtype == torch.float32
    verts, joints, _ = oracles.pose_body(
        {k: v.numpy() for k, v in arrays.items()}, pose.pose.numpy(), pose.betas.numpy()
    )
    assert np.abs(posed.verts.double().numpy() - verts).max() <= 1e-6
    assert np.abs(posed.joints.double().numpy() - joints).max() <= 1e-6
    world = verts @ oracles.rodrigues(pose.rotation.numpy()).T + pose.translation.numpy()
    assert np.abs(posed.verts_world.double().numpy() - world).max() <= 2e-6


@pytest.mark.parametrize("actor", ["actor_a", "actor_b"])
def test_vertices_of_the_captures_are_reproduced(captures_dir: Path, actor: str) -> None:
    files = sorted((captures_dir / actor / "new_params").glob("*.npy"))
    assert len(files) >= 100
    params = [read_npy_object(f) for f in files]
    pose = BodyPose(
        pose=torch.stack([torch.from_numpy(p["poses"].reshape(-1, 3)) for p in params]),
        betas=torch.stack([torch.from_numpy(p["shapes"][0]) for p in params]),
        rotation=torch.stack([torch.from_numpy(p["Rh"][0]) for p in params]),
        translation=torch.stack([torch.from_numpy(p["Th"][0]) for p in params]),
    )
    found = BodyModel.default()(pose).verts_world
    assert found.dtype == torch.float32
    for file, verts in zip(files, found, strict=True):
        expected = np.load(file.parents[1] / "new_vertices" / file.name)
        assert np.abs(verts.numpy() - expected).max() <= 1e-5, file


def test_default_body() -> None:
    body = BodyModel.default()
    assert BodyModel.default() is body
    assert (body.num_joints, len(body.joint_names)) == (24, 24)
    assert body.v_template.dtype == torch.float32 and body.faces.dtype == torch.int64
    assert not body.has_pose_blend_shapes
    joints = dict(zip(body.joint_names, body.shaped(torch.zeros(10))[1], strict=True))
    assert joints["left_wrist"][0] > 0.4 > -0.4 > joints["right_wrist"][0]  # +x: subject's left
    assert joints["head"][1] > joints["pelvis"][1] > joints["left_ankle"][1]  # y up
    assert joints["left_foot"][2] > joints["left_ankle"][2]  # z front


def test_zero_pose_is_the_shaped_rest(small: BodyModel) -> None:
    betas = torch.randn(2, small.num_betas)
    still = BodyPose.zeros(small, (2,))
    posed = small(BodyPose(still.pose, betas, still.rotation, still.translation))
    verts, joints = small.shaped(betas)
    torch.testing.assert_close(posed.verts, verts)
    torch.testing.assert_close(posed.joints, joints)
    torch.testing.assert_close(posed.verts_world, verts)


def test_fewer_betas_are_padded_with_zeros(small: BodyModel) -> None:
    betas = torch.randn(2)
    full = torch.cat((betas, torch.zeros(small.num_betas - 2)))
    torch.testing.assert_close(small.shaped(betas), small.shaped(full))


def test_world_is_a_rotation_about_the_local_origin(small: BodyModel) -> None:
    pose = random_pose(small, 3)
    posed = small(pose)
    for i in range(3):
        rotation = oracles.rodrigues(pose.rotation[i].numpy())
        expected = posed.verts[i].numpy() @ rotation.T + pose.translation[i].numpy()
        np.testing.assert_allclose(posed.verts_world[i].numpy(), expected, atol=1e-12)
    torch.testing.assert_close(posed.to_local(posed.verts_world), posed.verts)


def test_canonical_is_the_big_pose() -> None:
    body = BodyModel.default()
    betas = torch.randn(2, 10)
    pose = BodyPose.zeros(body, (2,))
    pose.pose[:, 1, 2], pose.pose[:, 2, 2] = np.pi / 6, -np.pi / 6
    expected = body(BodyPose(pose.pose, betas, pose.rotation, pose.translation))
    found = body.canonical(betas)
    torch.testing.assert_close(found.verts, expected.verts)
    torch.testing.assert_close(found.verts_world, found.verts)
    at = {name: j for j, name in enumerate(body.joint_names)}
    rest = body.shaped(betas)[1]
    spread = found.joints[:, at["left_ankle"], 0] - found.joints[:, at["right_ankle"], 0]
    spread_rest = rest[:, at["left_ankle"], 0] - rest[:, at["right_ankle"], 0]
    assert (spread > spread_rest + 0.5).all()  # the legs open, they do not cross


def test_canonical_of_a_body_of_two_joints_is_at_rest() -> None:
    arrays = oracles.random_body(1)
    arrays["kintree_table"] = arrays["kintree_table"][:, :2]
    arrays["weights"] = arrays["weights"][:, :2] / arrays["weights"][:, :2].sum(1, keepdims=True)
    arrays["J_regressor"], arrays["posedirs"] = (
        arrays["J_regressor"][:2],
        arrays["posedirs"][..., :9],
    )
    body = body_of(arrays)
    torch.testing.assert_close(body.canonical(torch.zeros(4)).verts, body.v_template)


def test_copies_follow_the_input_and_are_kept(small: BodyModel) -> None:
    ref = torch.zeros(1, dtype=torch.float64)
    double = small.to(ref)
    assert double is small.to(ref) and small.to(small.v_template) is small
    assert double.v_template.dtype == torch.float64 and double.faces.dtype == torch.int64
    assert small(random_pose(small)).verts.dtype == torch.float64


def test_gradients(small: BodyModel) -> None:
    pose = random_pose(small, 1)
    inputs = tuple(t.requires_grad_() for t in vars(pose).values())

    def run(*fields: torch.Tensor) -> tuple[torch.Tensor, ...]:
        posed = small(BodyPose(*fields))
        return posed.verts_world[:, ::20], posed.joints[:, 4], posed.transforms[:, 4]

    assert torch.autograd.gradcheck(run, inputs)


def test_gradients_at_the_zero_pose_are_finite(small: BodyModel) -> None:
    pose = BodyPose.zeros(small)
    inputs = [t.requires_grad_() for t in vars(pose).values()]
    verts = small(pose).verts_world
    (verts * torch.randn_like(verts)).sum().backward()
    for tensor in inputs:
        assert tensor.grad is not None and tensor.grad.isfinite().all() and tensor.grad.any()


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_transforms_carry_rest_joints_to_posed_joints(seed: int) -> None:
    torch.manual_seed(seed)
    body = body_of(oracles.random_body(seed))
    pose = random_pose(body)
    posed: PosedBody = body(pose)
    rest = body.shaped(pose.betas)[1]
    torch.testing.assert_close(transform_points(posed.transforms, rest), posed.joints)
    parent = list(body.tree.parents[1:])
    lengths = (posed.joints[1:] - posed.joints[parent]).norm(dim=-1)  # bones keep their length
    torch.testing.assert_close(lengths, (rest[1:] - rest[parent]).norm(dim=-1))


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_smplx_translation_turns_about_the_pelvis(seed: int) -> None:
    rng = np.random.default_rng(seed)
    axis_angle, transl, pelvis, point = rng.normal(size=(4, 3))
    # smplx puts the global orientation into the root joint and adds transl
    rotation = oracles.rodrigues(axis_angle)
    root = oracles.forward_kinematics((-1,), rotation[None], pelvis[None])[0]
    expected = root[:3, :3] @ point + root[:3, 3] + transl
    tensors = [torch.from_numpy(a) for a in (axis_angle, transl, pelvis)]
    found = convert_smplx_translation(*tensors)
    world = rotation @ point + found.numpy()
    np.testing.assert_allclose(world, expected, atol=1e-12)
    back = convert_smplx_translation(tensors[0], found, tensors[2], inverse=True)
    torch.testing.assert_close(back, tensors[1])


def test_smplx_conversion_on_a_whole_body(small: BodyModel) -> None:
    pose = random_pose(small)
    pelvis = small.shaped(pose.betas)[1][0]
    still = torch.zeros(3, dtype=torch.float64)
    pose.pose[0] = pose.rotation  # smplx: global orientation is the root joint's rotation
    as_smplx = small(BodyPose(pose.pose, pose.betas, still, pose.translation)).verts_world
    without_root = pose.pose.clone()
    without_root[0] = 0
    translation = convert_smplx_translation(pose.rotation, pose.translation, pelvis)
    found = small(BodyPose(without_root, pose.betas, pose.rotation, translation)).verts_world
    torch.testing.assert_close(found, as_smplx)
    rotmat = axis_angle_to_rotmat(pose.rotation)
    assert (rotmat @ pelvis - pelvis).norm() > 1e-3  # the two conventions do differ here


def test_wrong_counts_are_refused(small: BodyModel) -> None:
    pose = BodyPose.zeros(small)
    with pytest.raises(InputError, match=r"pose: expected 5 joints .* found 4"):
        small(BodyPose(pose.pose[:4], pose.betas, pose.rotation, pose.translation))
    with pytest.raises(InputError, match=r"betas: expected at most 4 .* found 6"):
        small(BodyPose(pose.pose, torch.zeros(6), pose.rotation, pose.translation))


@pytest.mark.parametrize("batch", [(), (1,), (2, 2), (0,)])
@pytest.mark.parametrize("pose_blend", [True, False])
def test_kernels_equal_their_twin(batch: tuple[int, ...], pose_blend: bool) -> None:
    body = body_of(oracles.random_body(2, pose_blend=pose_blend))
    torch.manual_seed(2)
    exact = random_pose(body, *batch)
    results = []
    for pose, backend in ((exact, "torch"), (exact.to(torch.zeros(1)), "warp")):
        fields = [t.detach().clone().requires_grad_() for t in vars(pose).values()]
        posed = body(BodyPose(*fields), backend)
        found = (posed.verts_world, posed.joints, posed.transforms)
        total = sum((t * torch.linspace(-1, 1, t.numel()).view_as(t)).sum() for t in found)
        results.append([*found, *torch.autograd.grad(total, fields)])
    for want, have in zip(*results, strict=True):
        assert have.dtype == torch.float32
        atol = 3e-6 * (1 + float(want.detach().abs().max())) if want.numel() else 0.0
        torch.testing.assert_close(have, want.float(), atol=atol, rtol=0)


def test_a_back_end_by_name_runs_or_raises(small: BodyModel) -> None:
    pose = random_pose(small)
    with pytest.raises(BackendError, match="expected float32"):
        small(pose, "warp")
    single = pose.to(torch.zeros(1))
    single.pose.requires_grad_()
    with pytest.raises(BackendError, match="second derivative"):
        torch.autograd.grad(small(single).verts.sum(), single.pose, create_graph=True)
    verts = small(single, "torch").verts
    (first,) = torch.autograd.grad(verts.square().sum(), single.pose, create_graph=True)
    (second,) = torch.autograd.grad(first.square().sum(), single.pose)
    assert second.isfinite().all() and second.any()


def test_shape_directions_that_are_fitted_receive_a_gradient(small: BodyModel) -> None:
    fitted = dataclasses.replace(small, shapedirs=small.shapedirs.clone().requires_grad_())
    betas = torch.randn(2, 3)
    with torch.no_grad():
        expected = small.shaped(betas)[0]
        torch.testing.assert_close(fitted.shaped(betas)[0], expected)
    verts = fitted.shaped(betas)[0]
    verts.sum().backward()
    assert fitted.shapedirs.grad is not None
    rows = betas.sum(0).expand(small.num_verts, 3, 3)
    torch.testing.assert_close(fitted.shapedirs.grad[..., :3], rows)
