"""All rest points of a posed point, in a pose that brings the arms against the torso."""

import pytest
import torch
from posing import around, bent_tube, pose_of, share
from torch import Tensor
from tube import tube

from monopart.geometry.body import BodyModel, PosedBody
from monopart.geometry.diffused_weights import DiffusedField
from monopart.geometry.errors import InputError
from monopart.geometry.skinning import blend_transforms, skin
from monopart.geometry.skinning_field import SkinningField
from monopart.geometry.unskin import inverse_skin
from monopart.geometry.unskin_roots import UnskinnedRoots, inverse_skin_all

ARM = (16, 18, 20, 22, 17, 19, 21, 23)


def arms_down() -> PosedBody:
    """Upper arms pressed against the ribs."""
    body = BodyModel.default()
    pose = torch.zeros(body.num_joints, 3)
    pose[16, 2], pose[17, 2] = -1.5, 1.5
    return pose_of(body, pose)


def in_contact(field: SkinningField, posed: PosedBody) -> tuple[Tensor, Tensor, Tensor]:
    """Points that a rest point of the torso and one of an arm are moved to, and these two."""
    rest = around(field.rest, field.faces, 30000, 0.03)
    weights = field.weights_at(rest)
    image = skin(rest, blend_transforms(posed.transforms, weights))
    # well inside one limb: at the armpit the two are one piece of the map
    sure = weights.amax(1) > 0.9
    arm = torch.isin(weights.argmax(1), torch.tensor(ARM))
    a, t = (sure & arm).nonzero().squeeze(-1), (sure & ~arm).nonzero().squeeze(-1)
    gap = torch.cat([torch.cdist(part, image[a]).min(1).values for part in image[t].split(500)])
    nearest = torch.cat([torch.cdist(p, image[a]).argmin(1) for p in image[t].split(500)])
    near = gap < 0.004
    return image[t][near], rest[t][near], rest[a][nearest[near]]


@pytest.fixture(scope="module", params=["surface", "diffused"])
def field(request: pytest.FixtureRequest) -> SkinningField:
    body = BodyModel.default()
    return SkinningField(body) if request.param == "surface" else DiffusedField.of(body)


def test_points_in_contact_have_a_root_on_each_limb(field: SkinningField) -> None:
    body, posed = BodyModel.default(), arms_down()
    points, torso, arm = in_contact(field, posed)
    assert len(points) > 20
    found = inverse_skin_all(points, posed, body, rest_verts=field)
    on_arm = torch.isin(found.weights.argmax(-1), torch.tensor(ARM)) & found.valid
    on_rest = ~torch.isin(found.weights.argmax(-1), torch.tensor(ARM)) & found.valid
    assert share(on_arm.any(1) & on_rest.any(1)) >= 0.97
    assert share(found.count >= 2) >= 0.97
    # the root that is known, and one near the other sample
    gaps = [(found.points - known[:, None]).norm(dim=-1).amin(1) for known in (torso, arm)]
    assert share(gaps[0] < 1e-3) >= 0.97 and share(gaps[1] < 0.02) >= 0.95
    image = skin(
        found.points.flatten(0, 1), blend_transforms(posed.transforms, found.weights.flatten(0, 1))
    )
    cycle = (image.view_as(found.points) - points[:, None]).norm(dim=-1)
    assert (cycle[found.valid] <= 1e-3).all()
    torch.testing.assert_close(cycle[found.valid], found.residual[found.valid], atol=2e-6, rtol=0)


def check_form(found: UnskinnedRoots, apart: float) -> None:
    count = found.valid.sum(1)
    assert torch.equal(found.count, count)
    first = torch.arange(found.valid.shape[1]) < count[:, None]
    assert torch.equal(found.valid, first)  # the valid ones come first
    assert (found.residual[:, 1:] >= found.residual[:, :-1]).all()
    assert (found.residual[found.valid] <= 1e-3).all() and found.residual[
        ~found.valid
    ].isinf().all()
    assert not found.weights[~found.valid].any()
    gap = torch.cdist(found.points, found.points)
    both = found.valid[:, :, None] & found.valid[:, None] & ~torch.eye(len(first[0])).bool()
    assert (gap[both] > apart - 1e-4).all()


def test_form_and_limits(field: SkinningField) -> None:
    body, posed = BodyModel.default(), arms_down()
    points = around(posed.verts, body.faces, 1500, 0.05)
    found = inverse_skin_all(points, posed, body, rest_verts=field)
    check_form(found, 0.01)
    check_form(inverse_skin_all(points, posed, body, rest_verts=field, apart=0.2), 0.2)
    one = inverse_skin_all(points, posed, body, rest_verts=field, most=1)
    assert one.points.shape == (1500, 1, 3)
    assert torch.equal(one.residual[:, 0], found.residual[:, 0])
    few = inverse_skin_all(points, posed, body, rest_verts=field, starts=2)
    assert few.count.max() == 2 and few.count.sum() <= found.count.sum()
    single = inverse_skin(points, posed, body, rest_verts=field)
    assert share((found.count > 0) == single.valid) >= 0.99
    gap = (found.points - single.points[:, None]).norm(dim=-1)
    assert share((gap.amin(1) < 0.011)[single.valid]) >= 0.99  # its root is among these
    far = inverse_skin_all(points + 5, posed, body, rest_verts=field)
    assert not far.count.any() and far.points.isfinite().all()


def field_of(kind: str, body: BodyModel, backend: str) -> SkinningField:
    if kind == "surface":
        return SkinningField(body, backend=backend)
    return DiffusedField(body, backend=backend, voxel=0.05, reach=0.12)


@pytest.mark.parametrize("kind", ["surface", "diffused"])
def test_back_ends_agree(kind: str) -> None:
    body, posed = bent_tube(torch.float32)
    points = around(posed.verts, body.faces, 100)
    fast, plain = (
        inverse_skin_all(points, posed, body, rest_verts=field_of(kind, body, b))
        for b in ("warp", "torch")
    )
    same = fast.count == plain.count
    assert share(same) >= 0.95
    # the order of two residuals of 1e-6 is by chance: every root of one is among those of the other
    gap = torch.cdist(fast.points[same], plain.points[same]).amin(2)[fast.valid[same]]
    assert share(gap < 1e-4) >= 0.97


@pytest.mark.parametrize("kind", ["surface", "diffused"])
def test_gradients(kind: str) -> None:
    body, posed = bent_tube()
    field = field_of(kind, body, "torch")
    rest = around(body.v_template, body.faces, 200, 0.02)
    hit = field.index.query(rest)
    rest = rest[hit.bary.amin(-1) > 0.15][:3]
    points = skin(rest, blend_transforms(posed.transforms, field.weights_at(rest)))

    def invert(p: Tensor, transforms: Tensor) -> tuple[Tensor, Tensor]:
        moved = PosedBody(posed.verts, posed.joints, transforms, posed.rotation, posed.translation)
        found = inverse_skin_all(p, moved, body, rest_verts=field, starts=2, most=1)
        return found.points, found.weights

    inputs = (points.requires_grad_(), posed.transforms.clone().requires_grad_())
    assert torch.autograd.gradcheck(invert, inputs, eps=1e-6, atol=1e-5, fast_mode=True)


def test_no_point_one_point_and_numbers_that_are_not_finite(field: SkinningField) -> None:
    body, posed = BodyModel.default(), arms_down()
    for count in (0, 1):
        points = posed.verts[:count].clone().requires_grad_()
        found = inverse_skin_all(points, posed, body, rest_verts=field)
        assert found.points.shape == (count, 3, 3) and found.weights.shape == (count, 3, 24)
        assert found.count.shape == (count,)
        found.points.sum().backward()
        assert points.grad is not None and points.grad.isfinite().all()
    points = posed.verts[:3].clone()
    points[1, 0] = float("nan")
    found = inverse_skin_all(points, posed, body, rest_verts=field)
    assert not found.count[1] and found.count[0] and found.points.isfinite().all()


@pytest.mark.parametrize(
    ("name", "value"), [("starts", 0), ("most", 0), ("apart", 0.0), ("max_distance", -1.0)]
)
def test_bad_arguments(name: str, value: float) -> None:
    body = tube(torch.float32)
    posed = pose_of(body, torch.zeros(3, 3))
    with pytest.raises(InputError, match=f"{name}.*: expected"):
        inverse_skin_all(posed.verts, posed, body, **{name: value})  # type: ignore[arg-type]
