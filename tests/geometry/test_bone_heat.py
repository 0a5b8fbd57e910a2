"""Weights by heat and by transfer: rows sum to 1, stay within 0 and 1, follow order and motion."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sample_meshes import cube, grid, joined, rigged, shifted, sphere

from monopart.geometry.alignment import align, align_to_best, fitted_similarity, surface_points
from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.bone_heat import (
    bones_of_joints,
    heat_weights,
    nearest_bones,
    solved_rows,
    surface_laplacian,
)
from monopart.geometry.errors import InputError
from monopart.geometry.parts import PartMap
from monopart.geometry.surface import closest_point
from monopart.geometry.weight_transfer import (
    barycentrics,
    closest_faces,
    corner_normals,
    transfer_rows,
)


@pytest.fixture(scope="module")
def body() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    model = BodyModel.default()
    verts = model.v_template.double()
    joints = model.joint_regressor.double() @ verts
    return verts.numpy(), model.faces.numpy(), model.weights.double().numpy(), joints.numpy()


def test_heat_on_the_body_finds_its_parts(body) -> None:
    verts, faces, weights, joints = body
    found = heat_weights(verts, faces, joints, BodyModel.default().tree.parents)
    assert np.abs(found.sum(1) - 1).max() < 1e-12 and found.min() >= 0 and found.max() <= 1 + 1e-12
    for name, share in (("five", 0.97), ("per_limb", 0.95)):
        part = np.array(PartMap.preset(name).joint_part)
        assert (part[found.argmax(1)] == part[weights.argmax(1)]).mean() > share
    # a hand has nothing of the other one's joints
    left = joints[20, 0] + 0.05 < verts[:, 0]
    assert found[left][:, [17, 19, 21, 23]].max() < 1e-6


def test_heat_does_not_depend_on_order_place_and_size(body) -> None:
    verts, faces, _, joints = body
    parents = BodyModel.default().tree.parents
    whole = heat_weights(verts, faces, joints, parents)
    new = np.random.default_rng(0).permutation(len(verts))
    number = np.argsort(new)
    moved = heat_weights(verts[new], number[faces], joints, parents)
    assert np.abs(moved - whole[new]).max() < 1e-6
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    other = heat_weights(7 * verts @ turn.T + 3, faces, 7 * joints @ turn.T + 3, parents)
    # the winding number is a fast sum: a few vertices at the brink see another bone
    gap = np.abs(other - whole).max(1)
    assert gap.mean() < 5e-3 and np.quantile(gap, 0.98) < 0.05


def test_a_tube_of_two_bones_by_hand() -> None:
    ball = rigged()
    joints = np.array([[0.0, -0.6, 0], [0, 0, 0]])
    weights = heat_weights(ball.verts, ball.faces, joints, (-1, 0))
    low, high = ball.verts[:, 1] < -0.5, ball.verts[:, 1] > 0.5
    assert weights[low, 0].min() > 0.8 and weights[high, 1].min() > 0.8
    order = np.argsort(ball.verts[:, 1])
    assert (np.diff(weights[order, 1]) > -1e-3).all()  # more of the upper bone the higher


def test_bones_hidden_behind_a_wall_do_not_pull() -> None:
    """Two spheres side by side: a vertex does not follow the nearer bone of the other sphere."""
    both = joined(sphere(), shifted(sphere(radius=0.2), 1.3, 0, 0))
    joints = np.array([[-0.5, 0.0, 0], [-0.4, 0.0, 0], [1.3, 0, 0]])
    bones, owner = bones_of_joints(joints, (-1, 0, -1))
    bone, reach = nearest_bones(both.verts, both.faces, bones)
    first = both.verts[:, 0] < 1.05
    assert set(owner[bone[first]]) == {0, 1} or set(owner[bone[first]]) == {1}
    assert set(owner[bone[~first]]) == {2}
    assert np.isfinite(reach).all()
    weights = heat_weights(both.verts, both.faces, joints, (-1, 0, -1))
    assert weights[first][:, 2].max() == 0 and weights[~first][:, 2].min() == pytest.approx(1)


def test_bones_go_from_joints_to_their_children() -> None:
    joints = np.array([[0.0, 0, 0], [0, 1, 0], [1, 0, 0]])
    bones, owner = bones_of_joints(joints, (-1, 0, 0))
    assert owner.tolist() == [0, 0, 1, 2]
    assert bones[2].tolist() == [[0, 1, 0], [0, 2, 0]]
    single, owner = bones_of_joints(joints[:1], (-1,))
    assert single.tolist() == [[[0, 0, 0], [0, 0, 0]]] and owner.tolist() == [0]


def test_the_laplacian_is_that_of_cotangents_where_they_are_positive() -> None:
    import igl

    verts, faces = sphere(12, 16).verts, sphere(12, 16).faces
    ours, mass = surface_laplacian(verts, faces)
    theirs = igl.cotmatrix(verts, faces)
    assert np.abs((ours + theirs).toarray()).max() < 2e-5
    assert np.allclose(mass, igl.massmatrix(verts, faces, 0).diagonal())
    flat, flat_faces = grid(4)
    skew = flat @ np.array([[1, 0, 0], [2.5, 1, 0], [0, 0, 1]])
    assert (surface_laplacian(skew, flat_faces)[0].toarray() - np.diag([1e9] * 25)).max() <= 0


@settings(max_examples=25)
@given(st.integers(0, 10**6))
def test_rows_that_spread_stay_a_partition_of_unity(seed: int) -> None:
    rng = np.random.default_rng(seed)
    verts, faces = grid(4)
    verts = verts + 0.1 * rng.normal(size=verts.shape)
    target = rng.random((25, 3)) ** 4
    target /= target.sum(1, keepdims=True)
    pull = np.where(rng.random(25) < 0.4, 10.0 ** rng.integers(-2, 4, 25), 0.0)
    pull[rng.integers(25)] = np.inf
    rows = solved_rows(verts, faces, pull, target)
    assert np.abs(rows.sum(1) - 1).max() < 1e-9 and rows.min() >= 0
    assert np.array_equal(rows[np.isinf(pull)], target[np.isinf(pull)])
    assert (rows.max(0) <= target[pull > 0].max(0) + 1e-9).all()  # nothing beyond the targets


def test_heat_says_what_is_wrong() -> None:
    box = cube()
    with pytest.raises(InputError, match="at least one triangle"):
        heat_weights(box.verts, box.faces[:0], np.zeros((1, 3)), (-1,))
    with pytest.raises(InputError, match="2 parents"):
        heat_weights(box.verts, box.faces, np.zeros((1, 3)), (-1, 0))
    with pytest.raises(InputError, match="joints"):
        heat_weights(box.verts, box.faces, np.full((1, 3), np.nan), (-1,))
    outside = heat_weights(box.verts, box.faces, np.array([[5.0, 0, 0], [9, 0, 0]]), (-1, 0))
    assert np.allclose(outside.sum(1), 1)  # no bone is seen: the nearest one serves


def test_closest_faces_are_those_of_the_surface_search(body) -> None:
    verts, faces = body[:2]
    points = np.random.default_rng(0).normal(size=(200, 3)) * 0.4
    face, bary, distance = closest_faces(points, verts, faces)
    hit = closest_point(torch.from_numpy(points), torch.from_numpy(verts), torch.from_numpy(faces))
    assert np.abs(distance - hit.distance.numpy()).max() < 1e-6
    place = (bary[..., None] * verts[faces[face]]).sum(1)
    assert np.abs(np.linalg.norm(place - points, axis=1) - distance).max() < 1e-9
    assert closest_faces(points[:0], verts, faces)[0].shape == (0,)


@settings(max_examples=30)
@given(st.integers(0, 10**6), st.booleans())
def test_barycentrics_give_the_point_back(seed: int, needle: bool) -> None:
    rng = np.random.default_rng(seed)
    tri = rng.normal(size=(5, 3, 3))
    if needle:
        tri[:, 2] = tri[:, 0] + rng.random((5, 1)) * (tri[:, 1] - tri[:, 0])
    share = rng.dirichlet([1, 1, 1], size=5)
    if needle:
        share = np.stack([share[:, 0], 1 - share[:, 0], 0 * share[:, 0]], 1)
    point = (share[..., None] * tri).sum(1)
    found = barycentrics(point, tri)
    assert np.abs((found[..., None] * tri).sum(1) - point).max() < 1e-9
    assert np.abs(found.sum(1) - 1).max() < 1e-12 and found.min() >= 0


def test_transfer_to_itself_to_a_cut_copy_and_to_another_shape(body) -> None:
    verts, faces, weights, _ = body
    same, taken = transfer_rows(weights, (verts, faces), (verts, faces))
    assert taken.mean() > 0.99 and np.abs(same - weights)[taken].max() < 1e-6
    loose = verts[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
    apart, _ = transfer_rows(weights, (verts, faces), loose)
    assert np.abs(apart - same[faces].reshape(-1, same.shape[1])).max() < 1e-9
    model = BodyModel.default()
    shaped = model.shaped(torch.full((10,), 0.3))[0].double().numpy()
    other, taken = transfer_rows(weights, (verts, faces), (shaped, faces), 0.1)
    assert 0.5 * np.abs(other - weights).sum(1).mean() < 0.1
    assert np.abs(other.sum(1) - 1).max() < 1e-6 and other.min() >= 0


def test_gaps_are_filled_from_their_neighbours() -> None:
    verts, faces = grid(6)
    rows = np.stack([(verts[:, 0] + 1) / 2, (1 - verts[:, 0]) / 2], 1)
    bump = verts.copy()
    middle = np.linalg.norm(verts[:, :2], axis=1) < 0.3
    bump[middle, 2] = 5.0
    found, taken = transfer_rows(rows, (verts, faces), (bump, faces), 0.5, math.pi)
    assert (taken == ~middle).all()
    assert np.abs(found[middle] - 0.5).max() < 1e-9  # symmetric, so the middle is the mean
    far = verts + 100.0
    alone, taken = transfer_rows(rows, (verts, faces), (far, faces), 0.5)
    assert not taken.any() and np.allclose(alone.sum(1), 1)
    with pytest.raises(InputError, match="rows"):
        transfer_rows(rows[:3], (verts, faces), (verts, faces))


def test_normals_of_a_cut_cube_are_those_of_the_whole() -> None:
    box = cube()
    loose = box.verts[box.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3)
    whole = corner_normals(box.verts, box.faces)
    assert np.allclose(corner_normals(*loose), whole[box.faces].reshape(-1, 3))
    assert (np.sign(whole) == np.sign(box.verts)).all()


@pytest.mark.parametrize("seed", range(3))
def test_align_finds_any_turn_size_and_place(body, seed: int) -> None:
    verts, faces = body[:2]
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    scale, shift = 10.0 ** rng.uniform(-2, 3), rng.normal(size=3) * 10
    moved = scale * verts @ turn.T + shift
    found = align((moved, faces), (verts, faces))
    assert np.linalg.norm(found(moved) - verts, axis=1).max() < 0.02
    assert found.residual < 0.01
    back = found.inverse()
    assert np.allclose(back(found(moved)), moved)


def test_align_to_another_pose_and_resolution(body) -> None:
    verts, faces = body[:2]
    model = BodyModel.default()
    rest = BodyPose.zeros(model)
    pose = rest.pose.clone()
    pose[16, 2], pose[17, 2] = -0.3, 0.3
    other = model(BodyPose(pose, rest.betas, rest.rotation, rest.translation)).verts
    other = 1000 * other.double().numpy()[:, [1, 2, 0]]
    found = align((other, faces), (verts, faces))
    assert found.residual < 0.03
    ends = np.linalg.norm(found(other) - verts, axis=1)
    assert np.median(ends) < 0.08


def test_similarities_by_hand() -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    found = fitted_similarity(points, 3 * points @ turn.T + [1, 2, 3])
    assert np.allclose(found.rotation, turn) and found.scale == pytest.approx(3)
    assert found.residual < 1e-12
    mirrored = fitted_similarity(points, points * [-1, 1, 1])
    assert np.linalg.det(mirrored.rotation) == pytest.approx(1)
    spread = surface_points(cube().verts, cube().faces, 6000)
    assert np.abs(np.abs(spread).max(1) - 0.5).max() < 1e-12
    top = (spread[:, 1] == 0.5).mean()
    assert top == pytest.approx(1 / 6, abs=0.01)
    with pytest.raises(InputError, match="targets"):
        align_to_best((cube().verts, cube().faces), [])
    with pytest.raises(InputError, match="area"):
        surface_points(np.zeros((3, 3)), np.array([[0, 1, 2]]), 4)
