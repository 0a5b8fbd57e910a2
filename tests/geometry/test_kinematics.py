"""Forward kinematics against a float64 loop over joints."""

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from monopart.geometry.errors import BackendError, InputError
from monopart.geometry.kinematics import KinematicTree, forward_kinematics
from monopart.geometry.rigid import transform_points
from monopart.geometry.rotations import axis_angle_to_rotmat

PARENTS = (-1, 0, 0, 1, 0, 3, 5, 2)


def random_pose(*batch: int, num_joints: int = 8) -> tuple[torch.Tensor, torch.Tensor]:
    axis_angle = torch.randn(*batch, num_joints, 3, dtype=torch.float64)
    return axis_angle_to_rotmat(axis_angle), torch.randn(*batch, num_joints, 3).double()


@pytest.mark.parametrize("batch", [(), (2,), (2, 3), (0,)])
def test_against_the_loop(batch: tuple[int, ...]) -> None:
    rotmats, joints = random_pose(*batch)
    found = forward_kinematics(KinematicTree(PARENTS), rotmats, joints)
    assert found.shape == (*batch, 8, 4, 4)
    flat = (found.reshape(-1, 8, 4, 4), rotmats.reshape(-1, 8, 3, 3), joints.reshape(-1, 8, 3))
    for transforms, r, j in zip(*flat, strict=True):
        expected = oracles.forward_kinematics(PARENTS, r.numpy(), j.numpy())
        np.testing.assert_allclose(transforms.numpy(), expected, atol=1e-13)


def test_float32_on_a_body_sized_skeleton() -> None:
    rotmats, joints = random_pose()
    rotmats, joints = rotmats.float(), joints.float() * 0.4
    expected = oracles.forward_kinematics(
        PARENTS, rotmats.double().numpy(), joints.double().numpy()
    )
    found = forward_kinematics(KinematicTree(PARENTS), rotmats, joints)
    assert np.abs(found.double().numpy() - expected).max() <= 1e-6


def test_single_joint() -> None:
    rotmats, joints = random_pose(num_joints=1)
    transforms = forward_kinematics(KinematicTree((-1,)), rotmats, joints)
    torch.testing.assert_close(transforms[0, :3, :3], rotmats[0])
    torch.testing.assert_close(transform_points(transforms, joints), joints)


def test_rotations_of_a_leaf_move_only_its_own_joint_about_itself() -> None:
    tree = KinematicTree(PARENTS)
    rotmats, joints = random_pose()
    before = forward_kinematics(tree, rotmats, joints)
    rotmats = rotmats.clone()
    rotmats[6] = torch.eye(3)
    after = forward_kinematics(tree, rotmats, joints)
    changed = (before - after).abs().amax((1, 2)) > 1e-12
    assert changed.tolist() == [False] * 6 + [True, False]
    torch.testing.assert_close(transform_points(before, joints), transform_points(after, joints))


def test_gradients() -> None:
    tree = KinematicTree(PARENTS[:5])
    rotmats, joints = random_pose(2, num_joints=5)
    inputs = (rotmats.requires_grad_(), joints.requires_grad_())
    assert torch.autograd.gradcheck(lambda r, j: forward_kinematics(tree, r, j), inputs)


@given(st.integers(0, 10_000), st.integers(1, 12))
def test_turning_the_root_turns_everything_about_the_root(seed: int, num_joints: int) -> None:
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    tree = KinematicTree.from_parents([-1, *(int(rng.integers(j)) for j in range(1, num_joints))])
    rotmats, joints = random_pose(num_joints=num_joints)
    turn = axis_angle_to_rotmat(torch.randn(3, dtype=torch.float64))
    turned = rotmats.clone()
    turned[0] = turn @ rotmats[0]
    points = torch.randn(num_joints, 3, dtype=torch.float64)
    before = transform_points(forward_kinematics(tree, rotmats, joints), points)
    after = transform_points(forward_kinematics(tree, turned, joints), points)
    torch.testing.assert_close(after, (before - joints[0]) @ turn.mT + joints[0])


def test_levels() -> None:
    tree = KinematicTree(PARENTS)
    assert tree.levels == ((0,), (1, 2, 4), (3, 7), (5,), (6,))
    assert tree.num_joints == 8
    assert hash(tree) == hash(KinematicTree(PARENTS))


@pytest.mark.parametrize("root", [-1, 4294967295])
@pytest.mark.parametrize("form", [list, np.array, torch.tensor])
def test_from_parents_accepts_both_marks_of_the_root(root: int, form: object) -> None:
    assert KinematicTree.from_parents(form([root, 0, 1])).parents == (-1, 0, 1)  # pyright: ignore


@pytest.mark.parametrize(
    ("parents", "named"),
    [
        ([], "joint 0"),
        ([0, 0], "joint 0"),
        ([-1, -1], "joint 1"),
        ([-1, 2, 0], "joint 1"),
        ([-1, 1], "joint 1"),
        ([-1, 0, 7], "joint 2"),
        ([-1, -3], "joint 1"),
    ],
)
def test_bad_trees_are_refused(parents: list[int], named: str) -> None:
    with pytest.raises(InputError, match=named) as caught:
        KinematicTree.from_parents(parents)
    assert "\n" not in str(caught.value)


def test_wrong_number_of_joints_is_refused() -> None:
    rotmats, joints = random_pose(num_joints=7)
    with pytest.raises(InputError, match=r"expected 8 joints .* found 7"):
        forward_kinematics(KinematicTree(PARENTS), rotmats, joints)


# --- the kernels ----------------------------------------------------------------------------------


def chain_and_gradients(
    parents: tuple[int, ...], rotmats: torch.Tensor, joints: torch.Tensor, backend: str
) -> list[torch.Tensor]:
    rotmats, joints = (t.detach().clone().requires_grad_() for t in (rotmats, joints))
    transforms = forward_kinematics(KinematicTree(parents), rotmats, joints, backend)
    pull = torch.linspace(-1, 1, transforms.numel(), dtype=joints.dtype).view_as(transforms)
    gradients = torch.autograd.grad((pull * transforms).sum(), (rotmats, joints))
    return [transforms.detach(), *gradients]


@pytest.mark.parametrize("batch", [(), (1,), (2,), (2, 3), (0,)])
@pytest.mark.parametrize("parents", [(-1,), (-1, 0), PARENTS, tuple(range(-1, 9))])
def test_kernels_equal_their_twin(batch: tuple[int, ...], parents: tuple[int, ...]) -> None:
    torch.manual_seed(5)
    rotmats, joints = random_pose(*batch, num_joints=len(parents))
    exact = chain_and_gradients(parents, rotmats, joints, "torch")
    single = (rotmats.float(), joints.float())
    found = chain_and_gradients(parents, *single, "warp")
    automatic = chain_and_gradients(parents, *single, "auto")
    for have, same, want in zip(found, automatic, exact, strict=True):
        assert have.dtype == torch.float32 and torch.equal(have, same)
        torch.testing.assert_close(have, want.float(), atol=1e-5, rtol=2e-6)


@pytest.mark.parametrize("backend", ["warp", "torch"])
def test_one_rest_pose_serves_many_rotations(backend: str) -> None:
    rotmats, joints = (t.float() for t in random_pose(3))
    whole = chain_and_gradients(PARENTS, rotmats, joints[:1].expand(3, 8, 3), backend)
    found = chain_and_gradients(PARENTS, rotmats, joints[0], backend)
    whole[2] = whole[2].sum(0)
    torch.testing.assert_close(found, whole)


def test_kernels_give_the_same_bits_on_any_number_of_threads() -> None:
    rotmats, joints = (t.float() for t in random_pose(1500))
    before = torch.get_num_threads()
    runs = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        try:
            runs.append(chain_and_gradients(PARENTS, rotmats, joints, "warp"))
        finally:
            torch.set_num_threads(before)
    for other in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(runs[0], other, strict=True))


def test_what_the_kernels_cannot_do() -> None:
    rotmats, joints = random_pose(2)
    with pytest.raises(BackendError, match="expected float32"):
        forward_kinematics(KinematicTree(PARENTS), rotmats, joints, "warp")
    joints = joints.float().requires_grad_()
    transforms = forward_kinematics(KinematicTree(PARENTS), rotmats.float(), joints, "warp")
    with pytest.raises(BackendError, match=r"second derivative .*backend='torch'"):
        torch.autograd.grad(transforms.sum(), joints, create_graph=True)


def test_joints_that_do_not_fit_the_rotations_are_refused() -> None:
    rotmats, joints = random_pose(2)
    with pytest.raises(InputError, match=r"joints: expected torch\.float64"):
        forward_kinematics(KinematicTree(PARENTS), rotmats, joints.float())
