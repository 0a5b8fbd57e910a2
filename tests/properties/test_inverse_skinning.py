"""Inverse skinning and the body shell follow what happens to the body."""

import dataclasses

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from motions import Motion, close, generator, motions, normal, seeds, shuffled, unit
from posing import METHODS, around, pose_of
from torch import Tensor
from tube import tube

from monopart.geometry.body import BodyModel, PosedBody
from monopart.geometry.cameras import Rays
from monopart.geometry.culling import BodyShell
from monopart.geometry.kinematics import KinematicTree
from monopart.geometry.unskin import inverse_skin

FEW = settings(max_examples=8)
EXACT = 1e-9  # metres, float64: what an iteration stops at is 1e-10
FAR = 1e-4  # metres, float32 at 100 m: roundings of 7.6e-6 m times the condition of a bend
methods = st.sampled_from(METHODS)


def bent(seed: int, dtype: torch.dtype = torch.float64) -> tuple[BodyModel, PosedBody, Tensor]:
    """The tube in a pose, and points on and around it."""
    body = tube(dtype)
    posed = pose_of(body, (0.35 * normal(seed, 3, 3)).to(dtype))
    torch.manual_seed(seed % 1000)
    return body, posed, around(posed.verts, body.faces, 60, 0.02)


def moved(posed: PosedBody, motion: Motion) -> PosedBody:
    return dataclasses.replace(
        posed,
        verts=motion(posed.verts),
        joints=motion(posed.joints),
        transforms=motion.matrix(posed.transforms) @ posed.transforms,
    )


def agree(found: Tensor, expected: Tensor, bound: float, share: float = 0.9) -> None:
    """Most points within a bound: where two roots or two feet tie, either is right."""
    apart = (found - expected).norm(dim=-1)
    assert float((apart <= bound).double().mean()) >= share, apart.topk(5).values


@FEW
@given(seeds, motions(), methods)
def test_rest_points_do_not_know_where_the_body_stands(
    seed: int, motion: Motion, method: str
) -> None:
    body, posed, points = bent(seed)
    before = inverse_skin(points, posed, body, method)
    after = inverse_skin(motion(points), moved(posed, motion), body, method)
    both = before.valid & after.valid
    assert float((before.valid == after.valid).double().mean()) >= 0.95
    agree(after.points[both], before.points[both], EXACT)
    agree(after.weights[both], before.weights[both], 1e-6)


@FEW
@given(seeds, st.sampled_from([0.5, 3.0]))
def test_rest_points_follow_the_scale(seed: int, scale: float) -> None:
    body, posed, points = bent(seed)
    other = dataclasses.replace(body, v_template=scale * body.v_template)
    transforms = posed.transforms.clone()
    transforms[..., :3, 3] *= scale
    large = dataclasses.replace(
        posed, verts=scale * posed.verts, joints=scale * posed.joints, transforms=transforms
    )
    before = inverse_skin(points, posed, body, "surface", max_distance=0.2)
    after = inverse_skin(scale * points, large, other, "surface", max_distance=0.2 * scale)
    agree(after.points / scale, before.points, EXACT)
    close(after.residual / scale, before.residual, 1e-6)


@FEW
@given(seeds, methods)
def test_orders_do_not_matter(seed: int, method: str) -> None:
    """Of points, of vertices and of faces."""
    body, posed, points = bent(seed)
    before = inverse_skin(points, posed, body, method)
    order = shuffled(seed, len(points))
    mixed = inverse_skin(points[order], posed, body, method)
    close(mixed.points, before.points[order], EXACT)
    places, rows = shuffled(seed + 1, body.num_verts), shuffled(seed + 2, len(body.faces))
    other = dataclasses.replace(
        body,
        v_template=body.v_template[places],
        faces=places.argsort()[body.faces[rows]],
        weights=body.weights[places],
        joint_regressor=body.joint_regressor[:, places],
        shapedirs=body.shapedirs[places],
        posedirs=body.posedirs[places],
    )
    renamed = dataclasses.replace(posed, verts=posed.verts[places])
    after = inverse_skin(points, renamed, other, method)
    agree(after.points, before.points, EXACT, 0.85)


@FEW
@given(seeds)
def test_the_order_of_joints_does_not_matter(seed: int) -> None:
    """Of a body whose two last joints are siblings."""
    body, posed, points = bent(seed)
    order = [0, 2, 1]
    sibling = dataclasses.replace(body, tree=KinematicTree.from_parents([-1, 0, 0]))
    other = dataclasses.replace(
        sibling, weights=body.weights[:, order], joint_regressor=body.joint_regressor[order]
    )
    renamed = dataclasses.replace(
        posed, joints=posed.joints[order], transforms=posed.transforms[order]
    )
    before = inverse_skin(points, posed, sibling)
    after = inverse_skin(points, renamed, other)
    agree(after.points, before.points, EXACT)
    agree(after.weights, before.weights[:, order], 1e-6)


@FEW
@given(seeds, st.sampled_from(["fixed_point", "broyden", "newton"]))
def test_valid_points_are_skinned_back_to_where_they_were(seed: int, method: str) -> None:
    body, posed, points = bent(seed)
    found = inverse_skin(points, posed, body, method)
    assert float(found.valid.double().mean()) >= 0.6
    maps = (found.weights @ posed.transforms[:, :3].flatten(1)).unflatten(-1, (3, 4))
    image = (maps[..., :3] * found.points[:, None]).sum(-1) + maps[..., 3]
    gap = (image - points).norm(dim=-1)[found.valid]
    assert float(gap.max()) <= 1e-3
    close(found.weights.sum(-1)[found.valid], torch.ones(len(gap), dtype=gap.dtype), 1e-9)


@FEW
@given(seeds, methods)
def test_rest_points_of_a_body_100_m_away(seed: int, method: str) -> None:
    body, posed, points = bent(seed, torch.float32)
    away = Motion(torch.eye(3, dtype=torch.float64), 100 * unit(seed))
    before = inverse_skin(points, posed, body, method)
    after = inverse_skin(away(points), moved(posed, away), body, method)
    both = before.valid & after.valid
    assert float((before.valid == after.valid).double().mean()) >= 0.9
    agree(after.points[both], before.points[both], FAR, 0.85)


# --- the shell ------------------------------------------------------------------------------------


def shell_of(verts: Tensor, faces: Tensor) -> BodyShell:
    return BodyShell(verts, faces, 0.05, voxel=0.03)


@FEW
@given(seeds, motions())
def test_the_shell_loses_nothing_wherever_the_body_stands(seed: int, motion: Motion) -> None:
    """Voxels have axes of their own, so a turned shell is another one; what it promises stays."""
    body, posed, _ = bent(seed, torch.float32)
    near = around(posed.verts, body.faces, 300, 0.0499)
    shell = shell_of(motion(posed.verts), body.faces)
    assert bool(shell.occupied(motion(near)).all())
    eye = motion(torch.tensor([0.0, 0.5, 3.0]))
    ways = motion(near) - eye
    rays = Rays(eye.expand_as(ways), torch.nn.functional.normalize(ways, dim=-1))
    first, last, hit = shell.intervals(rays)
    length = ways.norm(dim=-1)
    assert bool((hit & (first <= length + 1e-5) & (last >= length - 1e-5)).all())
    far = motion(2.0 * normal(seed, 300, 3).float() + 6.0)
    assert not bool(shell.occupied(far).any())


@FEW
@given(seeds)
def test_the_shell_moves_with_the_body(seed: int) -> None:
    body, posed, points = bent(seed, torch.float32)
    shift = torch.randint(-64, 64, (3,), generator=generator(seed)).float()
    before, after = shell_of(posed.verts, body.faces), shell_of(posed.verts + shift, body.faces)
    probe = torch.cat([points, points + 0.2 * normal(seed, len(points), 3).float()])
    same = before.occupied(probe) == after.occupied(probe + shift)
    assert float(same.double().mean()) >= 0.98  # a border of a voxel may round to either side
    way = unit(seed).float().expand_as(probe)
    near, far, hit = before.intervals(Rays(probe - 3 * way, way))
    other_near, other_far, other_hit = after.intervals(Rays(probe + shift - 3 * way, way))
    both = hit & other_hit
    assert float((hit == other_hit).double().mean()) >= 0.98
    assert float(((near - other_near).abs() < 1e-3)[both].double().mean()) >= 0.95
    assert float(((far - other_far).abs() < 1e-3)[both].double().mean()) >= 0.95


@FEW
@given(seeds)
def test_orders_do_not_matter_to_the_shell(seed: int) -> None:
    body = tube(torch.float32)
    verts = torch.stack(
        [pose_of(body, 0.3 * normal(seed + b, 3, 3).float()).verts for b in range(3)]
    )
    shell = shell_of(verts, body.faces)
    places, rows, bodies = (shuffled(seed, n) for n in (body.num_verts, len(body.faces), 3))
    renamed = shell_of(verts[:, places], places.argsort()[body.faces[rows]])
    assert torch.equal(renamed.grid, shell.grid)
    mixed = shell_of(verts[bodies], body.faces)
    points = around(verts[0], body.faces, 200, 0.2)
    for new, old in enumerate(bodies.tolist()):
        assert torch.equal(mixed.bits(points, new), shell.bits(points, old))


@pytest.mark.parametrize("step", [0.01, 0.03])
def test_samples_of_a_ray_do_not_depend_on_the_other_rays(step: float) -> None:
    body, posed, points = bent(5, torch.float32)
    shell = shell_of(posed.verts, body.faces)
    way = torch.nn.functional.normalize(points - torch.tensor([0.0, 0.5, 2.0]), dim=-1)
    rays = Rays(points - 2 * way, way)
    jitter = torch.rand(len(points), generator=generator(0))
    whole = shell.sample(rays, step, jitter=jitter)
    order = shuffled(1, len(points))
    mixed = shell.sample(Rays(rays.origins[order], way[order]), step, jitter=jitter[order])
    counts = whole.ray_start.diff()
    assert torch.equal(mixed.ray_start.diff(), counts[order])
    rows = torch.cat(
        [torch.arange(int(whole.ray_start[r]), int(whole.ray_start[r + 1])) for r in order]
    )
    assert torch.equal(mixed.points, whole.points[rows])
    assert torch.equal(mixed.depth, whole.depth[rows])
