"""Bodies and skinning follow motions, scales and relabellings of what they are given."""

import dataclasses
import itertools

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from motions import Motion, close, motions, normal, seeds, shuffled
from torch import Tensor
from tube import tube

from monopart.geometry.body import BodyModel, BodyPose, PosedBody, convert_smplx_translation
from monopart.geometry.kinematics import KinematicTree, forward_kinematics
from monopart.geometry.rotations import axis_angle_to_rotmat, rotmat_to_axis_angle
from monopart.geometry.skinning import SkinWeights, blend_skin, blend_transforms, skin, unskin
from monopart.geometry.skinning_field import SkinningField

EXACT = 1e-13  # metres, float64, bodies of a few metres
SINGLE = 2e-6  # metres, float32
FAR = 3e-5  # metres: four roundings of float32 at 100 m, which are 7.6e-6 m each
BACKENDS = [("torch", torch.float64, EXACT), ("warp", torch.float32, SINGLE)]
FEW = settings(max_examples=20)


def random_body() -> BodyModel:
    """Forty vertices, five joints, shape and pose blend shapes; float64."""
    arrays = oracles.random_body(3)

    def tensor(name: str) -> Tensor:
        return torch.from_numpy(np.asarray(arrays[name]))

    return BodyModel(
        v_template=tensor("v_template"),
        faces=tensor("f"),
        weights=tensor("weights"),
        tree=KinematicTree.from_parents(arrays["kintree_table"][0]),
        joint_regressor=tensor("J_regressor"),
        shapedirs=tensor("shapedirs"),
        posedirs=tensor("posedirs"),
    )


BODY = random_body()


def pose(seed: int, body: BodyModel = BODY, spread: float = 0.8) -> BodyPose:
    numbers = normal(seed, body.num_joints + 2, 3)
    return BodyPose(
        pose=spread * numbers[2:],
        betas=normal(seed + 1, body.num_betas),
        rotation=numbers[0],
        translation=numbers[1],
    )


def same(found: PosedBody, expected: PosedBody, bound: float = EXACT) -> None:
    for field in dataclasses.fields(PosedBody):
        close(getattr(found, field.name), getattr(expected, field.name), bound)


# --- motions of the world and of the body ---------------------------------------------------------


@FEW
@given(seeds, motions())
def test_the_body_follows_the_world(seed: int, motion: Motion) -> None:
    still = pose(seed)
    turned = motion.rotmat @ axis_angle_to_rotmat(still.rotation)
    moved = dataclasses.replace(
        still, rotation=rotmat_to_axis_angle(turned), translation=motion(still.translation)
    )
    before, after = BODY(still), BODY(moved)
    close(after.verts, before.verts, 0)
    # the axis of a turn next to a half turn is the root of a rounding
    close(after.verts_world, motion(before.verts_world), 1e-6)
    close(after.to_local(motion(before.verts_world)), before.verts, 1e-6)


@FEW
@given(seeds)
def test_world_to_local_and_back(seed: int) -> None:
    posed, points = BODY(pose(seed)), normal(seed, 7, 3)
    close(posed.to_local(posed.to_world(points)), points, EXACT)
    close(posed.to_world(posed.to_local(points)), points, EXACT)


@FEW
@given(seeds, motions())
def test_turning_the_root_turns_the_body_about_it(seed: int, motion: Motion) -> None:
    body, still = tube(), pose(seed, tube())
    turned = still.pose.clone()
    turned[0] = rotmat_to_axis_angle(motion.rotmat @ axis_angle_to_rotmat(still.pose[0]))
    before, after = body(still), body(dataclasses.replace(still, pose=turned))
    pivot = before.joints[0]
    close(after.verts, motion.turn(before.verts - pivot) + pivot, 1e-6)
    close(after.joints, motion.turn(before.joints - pivot) + pivot, 1e-6)


@FEW
@given(seeds, motions(), st.sampled_from(BACKENDS))
def test_skinning_follows_a_motion_after_it(
    seed: int, motion: Motion, backend: tuple[str, torch.dtype, float]
) -> None:
    name, dtype, bound = backend
    posed = BODY(pose(seed))
    transforms, points = posed.transforms.to(dtype), BODY.v_template.to(dtype)
    weights = SkinWeights(BODY.weights.to(dtype))
    before = blend_skin(points, transforms, weights, name)
    after = blend_skin(points, motion.matrix(transforms) @ transforms, weights, name)
    close(after, motion(before), 4 * bound)


@FEW
@given(seeds, motions())
def test_skinning_undoes_a_motion_before_it(seed: int, motion: Motion) -> None:
    """T M⁻¹ on points M p is T on p: rest poses may be stated in any frame."""
    transforms = BODY(pose(seed)).transforms
    blended = blend_transforms(transforms, BODY.weights)
    elsewhere = blended @ torch.linalg.inv(motion.matrix(blended))
    close(skin(motion(BODY.v_template), elsewhere), skin(BODY.v_template, blended), EXACT)


@FEW
@given(seeds)
def test_smplx_translations_there_and_back(seed: int) -> None:
    rotation, shift, pelvis = normal(seed, 3, 5, 3).unbind(0)
    there = convert_smplx_translation(rotation, shift, pelvis)
    close(convert_smplx_translation(rotation, there, pelvis, inverse=True), shift, EXACT)
    turn = axis_angle_to_rotmat(rotation)
    point = normal(seed + 1, 5, 3)
    ours = (turn @ point[..., None]).squeeze(-1) + there
    theirs = (turn @ (point - pelvis)[..., None]).squeeze(-1) + pelvis + shift
    close(ours, theirs, EXACT)


# --- scale ----------------------------------------------------------------------------------------


@FEW
@given(seeds, st.sampled_from([1e-3, 0.25, 3.0, 1e3]))
def test_a_body_of_another_scale_is_that_body_scaled(seed: int, scale: float) -> None:
    other = dataclasses.replace(
        BODY,
        v_template=scale * BODY.v_template,
        shapedirs=scale * BODY.shapedirs,
        posedirs=scale * BODY.posedirs,
    )
    still = pose(seed)
    before = BODY(still)
    after = other(dataclasses.replace(still, translation=scale * still.translation))
    close(after.verts_world, scale * before.verts_world, scale * EXACT)
    close(after.joints, scale * before.joints, scale * EXACT)
    close(after.transforms[..., :3, :3], before.transforms[..., :3, :3], EXACT)
    close(after.transforms[..., :3, 3], scale * before.transforms[..., :3, 3], scale * EXACT)


# --- relabelling ----------------------------------------------------------------------------------


@FEW
@given(seeds)
def test_the_order_of_vertices_does_not_matter(seed: int) -> None:
    order = shuffled(seed, BODY.num_verts)
    other = dataclasses.replace(
        BODY,
        v_template=BODY.v_template[order],
        faces=order.argsort()[BODY.faces],
        weights=BODY.weights[order],
        joint_regressor=BODY.joint_regressor[:, order],
        shapedirs=BODY.shapedirs[order],
        posedirs=BODY.posedirs[order],
    )
    before, after = BODY(pose(seed)), other(pose(seed))
    close(after.verts, before.verts[order], EXACT)
    close(after.transforms, before.transforms, EXACT)
    close(after.verts[other.faces], before.verts[BODY.faces], EXACT)


def orders_of_joints() -> list[tuple[int, ...]]:
    """Every order of the joints that has parents first."""
    parents = BODY.tree.parents
    every = itertools.permutations(range(BODY.num_joints))
    return [
        o for o in every if all(p < 0 or o.index(p) < o.index(j) for j, p in enumerate(parents))
    ]


@pytest.mark.parametrize("order", orders_of_joints())
def test_the_order_of_joints_does_not_matter(order: tuple[int, ...]) -> None:
    index = torch.tensor(order)
    place = index.argsort().tolist()
    parents = [BODY.tree.parents[j] for j in order]
    blocks = BODY.posedirs.unflatten(-1, (-1, 9))[:, :, index[1:] - 1]
    other = dataclasses.replace(
        BODY,
        tree=KinematicTree.from_parents([-1 if p < 0 else place[p] for p in parents]),
        weights=BODY.weights[:, index],
        joint_regressor=BODY.joint_regressor[index],
        posedirs=blocks.flatten(-2),
    )
    still = pose(sum(order))
    before = BODY(still)
    after = other(dataclasses.replace(still, pose=still.pose[index]))
    close(after.verts, before.verts, EXACT)
    close(after.transforms, before.transforms[index], EXACT)
    close(after.joints, before.joints[index], EXACT)


@FEW
@given(seeds, st.integers(1, 6), st.sampled_from(["torch", "warp"]))
def test_bodies_of_a_batch_do_not_know_each_other(seed: int, count: int, backend: str) -> None:
    dtype = torch.float64 if backend == "torch" else torch.float32
    poses = [pose(seed + i) for i in range(count)]
    fields = [f.name for f in dataclasses.fields(BodyPose)]
    batch = BodyPose(*(torch.stack([getattr(p, n) for p in poses]).to(dtype) for n in fields))
    order = shuffled(seed, count)
    whole = BODY(batch, backend)
    mixed = BODY(BodyPose(*(getattr(batch, n)[order] for n in fields)), backend)
    bound = EXACT if dtype == torch.float64 else SINGLE
    for name in ("verts", "joints", "transforms"):
        close(getattr(mixed, name), getattr(whole, name)[order], bound)
    alone = BODY(BodyPose(*(getattr(batch, n)[0] for n in fields)), backend)
    same(
        alone, PosedBody(*(getattr(whole, f.name)[0] for f in dataclasses.fields(PosedBody))), bound
    )


# --- partition of unity ---------------------------------------------------------------------------


@FEW
@given(seeds, motions(), st.sampled_from(BACKENDS))
def test_equal_transforms_move_every_point_alike(
    seed: int, motion: Motion, backend: tuple[str, torch.dtype, float]
) -> None:
    """Weights sum to one: where all joints move alike, weights do not matter."""
    name, dtype, bound = backend
    points = normal(seed, BODY.num_verts, 3, dtype=dtype)
    transforms = motion.matrix(points).expand(BODY.num_joints, 4, 4).contiguous()
    weights = SkinWeights(BODY.weights.to(dtype))
    close(blend_skin(points, transforms, weights, name), motion(points), 3 * bound)


@pytest.mark.parametrize("make", [tube, BodyModel.default])
def test_weights_are_a_partition_of_unity(make: object) -> None:
    body = make()
    ones = torch.ones(body.num_verts, dtype=body.weights.dtype)
    close(body.weights.sum(-1), ones, 2e-6)
    assert bool((body.weights >= 0).all())
    field = SkinningField(body)
    points = body.v_template[::7] + 0.03 * normal(0, len(body.v_template[::7]), 3).to(ones)
    found = field.weights_at(points)
    close(found.sum(-1), torch.ones_like(found[:, 0]), 2e-6)
    assert bool((found >= -1e-6).all())
    assert not field.weights_at(points + 50.0, max_distance=1.0).any()


# --- there and back -------------------------------------------------------------------------------


@FEW
@given(seeds)
def test_skinning_and_back_with_the_same_weights(seed: int) -> None:
    blended = blend_transforms(BODY(pose(seed)).transforms, BODY.weights)
    rest = normal(seed + 1, BODY.num_verts, 3)
    back, valid = unskin(skin(rest, blended), blended)
    det = torch.linalg.det(blended[:, :3, :3])
    assert torch.equal(valid, det.abs() > 1e-2)
    condition = torch.linalg.cond(blended[valid][:, :3, :3])
    error = (back - rest)[valid].abs().amax(-1)
    assert bool((error <= 1e-13 * condition**2).all())


@FEW
@given(seeds)
def test_kinematics_and_back_by_the_opposite_turns(seed: int) -> None:
    """A chain whose joints turn, posed again by the inverse turns, is the rest pose."""
    tree = KinematicTree.from_parents([-1, 0, 1, 2])
    rotmats, joints = axis_angle_to_rotmat(normal(seed, 4, 3)), normal(seed + 1, 4, 3)
    there = forward_kinematics(tree, rotmats, joints)
    # inverse of a product: the same joints in the opposite order
    back = forward_kinematics(tree, rotmats.flip(0).mT, joints.flip(0))
    eye = torch.eye(4, dtype=joints.dtype)
    close(back[-1] @ there[-1], eye, EXACT)


# --- far from the origin --------------------------------------------------------------------------


@FEW
@given(seeds, st.sampled_from([(100.0, 0.0, 0.0), (-60.0, 70.0, 40.0)]))
def test_a_body_100_m_away_loses_only_the_digits_of_its_place(
    seed: int, place: tuple[float, ...]
) -> None:
    """Local numbers do not change at all; those of the world are rounded at 100 m."""
    body, far = BodyModel.default(), torch.tensor(place)
    still = pose(seed, body, 0.3).to(far)
    away = dataclasses.replace(still, translation=still.translation + far)
    before, after = body(still), body(away)
    assert torch.equal(after.verts, before.verts)
    assert torch.equal(after.transforms, before.transforms)
    close(after.verts_world - far, before.verts_world, FAR)
    close(after.to_local(after.verts_world), before.verts, FAR)
