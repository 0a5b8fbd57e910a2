"""Inverse skinning: cycles against float64 loops, methods in order, kernels against their twins."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import oracles
import pytest
import torch
from posing import ITERATIVE, METHODS, around, bent_tube, pose_of, share
from torch import Tensor
from tube import tube

from monopart.geometry.body import BodyModel, BodyPose, PosedBody
from monopart.geometry.body_io import read_npy_object
from monopart.geometry.errors import InputError
from monopart.geometry.skinning import blend_transforms, skin
from monopart.geometry.skinning_field import SkinningField, field_at, field_jacobian, vertex_maps
from monopart.geometry.surface import SurfaceIndex, closest_on_triangle
from monopart.geometry.unskin import Unskinned, inverse_skin
from monopart.geometry.unskin_newton import Bones, Plan, newton_torch, newton_warp


def skinned(body: BodyModel, rest: Tensor, posed: PosedBody, points: Tensor) -> Tensor:
    """The forward field."""
    hit = SurfaceIndex(rest, body.faces).query(points)
    maps = vertex_maps(posed.transforms, body.weights)
    return field_at(points, hit.face, rest, body.faces, maps).image


@pytest.fixture(scope="module")
def scenes() -> list[tuple[PosedBody, Tensor]]:
    """Random poses of the free body, from mild to contorted, and points that have a rest point."""
    torch.manual_seed(3)
    body = BodyModel.default()
    found = []
    for spread in (0.0, 0.2, 0.4):
        posed = pose_of(body, spread * torch.randn(body.num_joints, 3))
        rest = around(body.v_template, body.faces, 1500)
        found.append((posed, skinned(body, body.v_template, posed, rest)))
    return found


# --- the cycle ------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_residual_is_the_cycle_of_the_float64_loop(method: str) -> None:
    body, posed = bent_tube(torch.float32)
    points = around(posed.verts, body.faces, 200)
    found = inverse_skin(points, posed, body, method)
    exact = tube()
    hit = SurfaceIndex(exact.v_template, exact.faces, "torch").query(found.points.double())
    weights = (hit.bary[..., None] * exact.weights[exact.faces[hit.face]]).sum(1)
    arrays = (found.points.double(), weights, posed.transforms.double())
    cycle = oracles.linear_blend_skinning(*(a.numpy() for a in arrays))
    expected = np.linalg.norm(cycle - points.double().numpy(), axis=-1)
    # where two faces of a ridge tie, float32 may take the other one
    close = np.isclose(found.residual.numpy(), expected, atol=2e-6)
    assert close.mean() >= 0.98
    assert torch.equal(found.valid, found.residual <= 1e-3)
    if method in ITERATIVE:
        torch.testing.assert_close(found.weights[close], weights[close].float(), atol=1e-4, rtol=0)
    assert found.weights.sum(-1).sub(1).abs().max() < 1e-5


@pytest.mark.parametrize("method", ["broyden", "newton"])
def test_points_with_a_rest_point_come_back(
    scenes: list[tuple[PosedBody, Tensor]], method: str
) -> None:
    for posed, points in scenes:
        found = inverse_skin(points, posed, BodyModel.default(), method)
        assert share(found.valid) >= 0.985
        assert share(found.residual <= 1e-5) >= 0.98
        body = BodyModel.default()
        back = skinned(body, body.v_template, posed, found.points)
        off = ((back - points).norm(dim=-1) - found.residual).abs()[found.valid]
        assert share(off < 1e-5) >= 0.999  # two faces at the same distance are both right
        own = skin(found.points, blend_transforms(posed.transforms, found.weights))
        assert ((own - points).norm(dim=-1) - found.residual).abs()[found.valid].max() < 2e-6


@pytest.mark.parametrize("actor", ["actor_a"])
def test_poses_of_a_capture(captures_dir: Path, actor: str) -> None:
    body = BodyModel.default()
    for frame in (0, 45, 110):
        params = read_npy_object(captures_dir / actor / "new_params" / f"{frame}.npy")
        betas = torch.from_numpy(params["shapes"][0])
        posed = pose_of(body, torch.from_numpy(params["poses"].reshape(-1, 3)), betas)
        rest = body.shaped(betas)[0]
        inside = skinned(body, rest, posed, around(rest, body.faces, 1500))
        found = inverse_skin(inside, posed, body, rest_verts=rest)
        assert share(found.residual <= 1e-5) >= 0.985
        near = around(posed.verts, body.faces, 1500)
        assert share(inverse_skin(near, posed, body, rest_verts=rest).valid) >= 0.985


def test_methods_in_their_order(scenes: list[tuple[PosedBody, Tensor]]) -> None:
    body = BodyModel.default()
    for posed, points in scenes[1:]:
        good = {m: share(inverse_skin(points, posed, body, m).valid) for m in METHODS}
        assert good["newton"] >= good["fixed_point"] - 1e-3, good
        assert good["broyden"] >= good["fixed_point"] - 1e-3, good
        assert good["fixed_point"] >= good["surface"] + 0.02, good
        assert good["surface"] >= good["nearest"] + 0.05, good


def test_rest_pose_is_the_identity(scenes: list[tuple[PosedBody, Tensor]]) -> None:
    posed, points = scenes[0]
    for method in METHODS:
        found = inverse_skin(points, posed, BodyModel.default(), method)
        assert found.valid.all()
        torch.testing.assert_close(found.points, points, atol=2e-6, rtol=0)


def test_more_starts_and_iterations_never_hurt(scenes: list[tuple[PosedBody, Tensor]]) -> None:
    posed, body = scenes[2][0], BodyModel.default()
    points = around(posed.verts, body.faces, 1500)
    for method in ("broyden", "newton"):
        one = inverse_skin(points, posed, body, method, starts=1)
        many = inverse_skin(points, posed, body, method, starts=4)
        assert (many.residual <= one.residual).all()
        assert many.valid.sum() >= one.valid.sum() + (method == "newton")
    few = inverse_skin(points, posed, body, starts=1, iterations=1)
    assert (inverse_skin(points, posed, body, starts=1).residual <= few.residual).all()


# --- the kernel and its twin ----------------------------------------------------------------------


def test_lists_and_tree_find_the_closest_face() -> None:
    """In the lists, at their border, and beyond."""
    body = BodyModel.default()
    points = torch.cat([around(body.v_template, body.faces, 4000, r) for r in (0.01, 0.07, 0.3)])
    posed = pose_of(body, torch.zeros(body.num_joints, 3))
    field = SkinningField(body)
    maps = vertex_maps(posed.transforms, body.weights)
    bones = Bones.of(posed.joints, posed.transforms)
    roots, weights = newton_warp(field, points, maps, bones, Plan(0, 1, 1.0, 0.0, True), points)
    triangles = body.v_template[body.faces[roots.face]]
    bary = closest_on_triangle(points, triangles)
    gap = (points - (bary[..., None] * triangles).sum(1)).norm(dim=-1)
    hit = field.index.query(points)
    torch.testing.assert_close(gap, hit.distance, atol=1e-6, rtol=0)
    same = roots.face == hit.face
    assert share(same) > 0.3  # corners and edges are shared by faces
    torch.testing.assert_close(weights[same], field.weights_at(points)[same], atol=1e-4, rtol=0)


@pytest.mark.parametrize("gradients", [True, False])
def test_kernel_and_twin_agree(scenes: list[tuple[PosedBody, Tensor]], gradients: bool) -> None:
    body = BodyModel.default()
    field = SkinningField(body)
    posed, points = scenes[1]
    guess = inverse_skin(points, posed, body, "surface").points
    maps = vertex_maps(posed.transforms, body.weights)
    bones = Bones.of(posed.joints, posed.transforms)
    for steps, starts in ((0, 1), (2, 1), (8, 3)):
        plan = Plan(steps, starts, 0.2, 5e-6, gradients)
        fast, _ = newton_warp(field, points, maps, bones, plan, guess)
        plain = newton_torch(field, points, maps, bones, plan, guess)
        close = (fast.points - plain.points).norm(dim=-1) < 2e-5
        assert share(close) >= 0.985  # ties of faces and roots at folds may be taken otherwise
        assert (fast.residual - plain.residual)[close].abs().max() < 2e-5
        arrived = share(fast.residual <= 1e-3) - share(plain.residual <= 1e-3)
        assert abs(arrived) <= 5e-3


@pytest.mark.parametrize("method", METHODS)
def test_back_ends_agree(method: str) -> None:
    body, posed = bent_tube(torch.float32)
    points = around(posed.verts, body.faces, 150)
    warp, plain = (
        inverse_skin(points, posed, body, method, rest_verts=SkinningField(body, backend=b))
        for b in ("warp", "torch")
    )
    close = (warp.points - plain.points).norm(dim=-1) < 2e-5
    assert share(close) >= 0.97 and share(warp.valid == plain.valid) >= 0.97
    torch.testing.assert_close(warp.weights[close], plain.weights[close], atol=5e-4, rtol=0)


def test_float64_arrives_at_float64() -> None:
    body, posed = bent_tube()
    rest = around(body.v_template, body.faces, 100, 0.02)
    points = skinned(body, body.v_template, posed, rest)
    found = inverse_skin(points, posed, body)
    assert found.points.dtype == torch.float64
    assert share(found.residual < 1e-9) >= 0.95


# --- derivatives ----------------------------------------------------------------------------------


def test_jacobian_against_finite_differences() -> None:
    """On faces, edges and corners: all three kinds occur around a tube with sharp rims."""
    body, posed = bent_tube()
    points = around(body.v_template, body.faces, 300)
    maps = vertex_maps(posed.transforms, body.weights)
    index = SurfaceIndex(body.v_template, body.faces, "torch")

    def image(p: Tensor, face: Tensor) -> Tensor:
        return field_at(p, face, body.v_template, body.faces, maps).image

    face = index.query(points).face
    at = field_at(points, face, body.v_template, body.faces, maps)
    kinds = (at.bary > 0).sum(-1)
    assert set(kinds.tolist()) == {1, 2, 3}
    eps = 1e-6
    columns = []
    for axis in range(3):
        shift = eps * torch.eye(3, dtype=points.dtype)[axis]
        columns.append((image(points + shift, face) - image(points - shift, face)) / (2 * eps))
    torch.testing.assert_close(field_jacobian(at), torch.stack(columns, -1), atol=1e-6, rtol=0)


def well_inside(body: BodyModel, posed: PosedBody, backend: str) -> Tensor:
    """Targets whose rest points stay on their face under the shifts of a gradient check."""
    rest = around(body.v_template, body.faces, 200, 0.02)
    hit = SurfaceIndex(body.v_template, body.faces, backend).query(rest)
    rest = rest[(hit.bary.amin(-1) > 0.15) & (hit.distance < 0.02)][:4]
    return skinned(body, body.v_template, posed, rest)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("backend", ["torch", "auto"])
def test_gradients_in_points_and_pose(method: str, backend: str) -> None:
    body, posed = bent_tube()
    points = well_inside(body, posed, backend)
    field = SkinningField(body, backend=backend)
    steps = 80 if method == "fixed_point" else None

    def invert(p: Tensor, transforms: Tensor) -> tuple[Tensor, Tensor]:
        moved = replace(posed, transforms=transforms)
        found = inverse_skin(p, moved, body, method, rest_verts=field, iterations=steps)
        return found.points, found.weights

    inputs = (points.requires_grad_(), posed.transforms.clone().requires_grad_())
    assert torch.autograd.gradcheck(invert, inputs, eps=1e-6, atol=1e-5, fast_mode=True)


def test_gradients_in_pose_and_shape() -> None:
    body, _ = bent_tube()
    pose = torch.tensor([[0.1, 0.2, 0], [0.2, 0.3, 0.7], [0.0, 0.4, -0.5]], dtype=torch.float64)
    points = well_inside(body, pose_of(body, pose), "torch")

    def invert(axis_angle: Tensor, rest: Tensor) -> Tensor:
        return inverse_skin(points, pose_of(body, axis_angle), body, rest_verts=rest).points

    inputs = (pose.requires_grad_(), body.v_template.clone().requires_grad_())
    assert torch.autograd.gradcheck(invert, inputs, eps=1e-6, atol=1e-5, fast_mode=True)


def test_values_do_not_depend_on_gradients() -> None:
    body, posed = bent_tube(torch.float32)
    points = around(posed.verts, body.faces, 50)
    plain = inverse_skin(points, posed, body)
    tracked = inverse_skin(points.clone().requires_grad_(), posed, body)
    assert tracked.points.requires_grad and not tracked.residual.requires_grad
    assert torch.equal(plain.points, tracked.points.detach())
    assert torch.equal(plain.weights, tracked.weights.detach())


# --- edges ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_no_point_and_one_point(method: str) -> None:
    body, posed = bent_tube(torch.float32)
    for count in (0, 1):
        points = posed.verts[20 : 20 + count].clone().requires_grad_()
        found = inverse_skin(points, posed, body, method)
        assert found.points.shape == (count, 3) and found.weights.shape == (count, 3)
        assert found.residual.shape == found.valid.shape == (count,)
        assert found.valid.all()
        found.points.sum().backward()


@pytest.mark.parametrize("method", METHODS)
def test_singular_blends_are_masked(method: str) -> None:
    """Half a turn about the axis of a limb: maps in its middle have no inverse."""
    body = tube(torch.float32)
    posed = pose_of(body, torch.tensor([[0.0, 0, 0], [0, torch.pi, 0], [0, 0, 0]]))
    points = around(posed.verts, body.faces, 400).requires_grad_()
    found = inverse_skin(points, posed, body, method)
    for tensor in (found.points, found.weights):
        assert tensor.isfinite().all()
    assert not found.residual.isnan().any()
    assert (found.residual[found.valid] <= 1e-3).all()
    (found.points.sum() + found.weights.square().sum()).backward()
    assert points.grad is not None and points.grad.isfinite().all()
    flat = replace(posed, transforms=posed.transforms * torch.tensor([1.0, 1, 0, 1])[:, None])
    assert not inverse_skin(points, flat, body, method).valid.any()


@pytest.mark.parametrize("method", METHODS)
def test_numbers_that_are_not_finite_are_masked(method: str) -> None:
    body, posed = bent_tube(torch.float32)
    points = posed.verts[:4].clone()
    clean = inverse_skin(points, posed, body, method)
    points[1, 0], points[2, 2] = float("nan"), float("inf")
    found = inverse_skin(points, posed, body, method)
    assert found.valid.tolist() == [bool(clean.valid[0]), False, False, bool(clean.valid[3])]
    assert found.residual.isinf().tolist() == [False, True, True, False]
    assert found.points.isfinite().all()
    broken = posed.transforms.clone()
    broken[1, 0, 3] = float("nan")
    assert not inverse_skin(points, replace(posed, transforms=broken), body, method).valid.any()


@pytest.mark.parametrize("method", METHODS)
def test_far_points_are_not_valid(method: str) -> None:
    body, posed = bent_tube(torch.float32)
    points = posed.verts[:3] + torch.tensor([5.0, 0, 0])
    found = inverse_skin(points, posed, body, method)
    assert not found.valid.any() and found.points.isfinite().all()
    wide = inverse_skin(points, posed, body, method, max_distance=20.0)
    assert wide.residual.isfinite().all()


def test_another_shape_is_not_mixed_up_with_the_kept_one() -> None:
    body, posed = bent_tube(torch.float32)
    points = posed.verts
    first = inverse_skin(points, posed, body)
    wide = inverse_skin(points, posed, body, rest_verts=body.v_template * 1.05)
    again = inverse_skin(points, posed, body)
    assert torch.equal(first.points, again.points)
    assert not torch.equal(first.weights, wide.weights)


BAD: dict[str, tuple[str, dict]] = {
    "method": ("method: expected one of nearest, .* found 'magic'", {"method": "magic"}),
    "starts": ("starts: expected at least 1, found 0", {"starts": 0}),
    "iterations": ("iterations: expected at least 0, found -1", {"iterations": -1}),
    "reach": ("max_distance: expected metres > 0", {"max_distance": float("nan")}),
    "rest": ("rest_verts: expected dtype", {"rest_verts": torch.zeros(106, 3).double()}),
    "count": ("rest_verts: expected 106 vertices", {"rest_verts": torch.zeros(5, 3)}),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_arguments(name: str) -> None:
    body, posed = bent_tube(torch.float32)
    message, changes = BAD[name]
    with pytest.raises(InputError, match=message) as raised:
        inverse_skin(posed.verts, posed, body, **changes)
    assert "\n" not in str(raised.value)


def test_bad_bodies() -> None:
    body, posed = bent_tube(torch.float32)
    batch = body(BodyPose.zeros(body, (2,)))
    with pytest.raises(InputError, match="posed: expected one body with 3 joints"):
        inverse_skin(posed.verts, batch, body)
    with pytest.raises(InputError, match="posed: expected one body with 24 joints"):
        inverse_skin(posed.verts, posed, BodyModel.default())
    with pytest.raises(InputError, match="posed: expected dtype"):
        inverse_skin(posed.verts.double(), posed, body)


def test_weights_of_rest_points() -> None:
    body = tube(torch.float32)
    field = SkinningField(body)
    torch.testing.assert_close(field.weights_at(body.v_template), body.weights, atol=1e-6, rtol=0)
    assert not field.weights_at(body.v_template + 3.0, max_distance=0.1).any()


def test_the_result_is_frozen() -> None:
    found = Unskinned(torch.zeros(1, 3), torch.zeros(1, 2), torch.zeros(1), torch.ones(1) > 0)
    with pytest.raises(AttributeError):
        found.points = torch.ones(1, 3)  # type: ignore[misc]
