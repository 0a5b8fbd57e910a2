"""Several rest points of one posed point: the arm laid against the trunk."""

import pytest
import torch

from monopart.geometry.body import BodyModel, BodyPose, PosedBody
from monopart.geometry.diffused_weights import DiffusedField
from monopart.geometry.errors import InputError
from monopart.geometry.parts import PartMap
from monopart.geometry.skinning import blend_transforms, skin
from monopart.geometry.unskin import inverse_skin
from monopart.geometry.unskin_roots import inverse_skin_all

REACH = 0.03  # metres: a root is on or near its part


@pytest.fixture(scope="module")
def contact() -> tuple[BodyModel, PosedBody, torch.Tensor, PartMap]:
    """The left arm pressed into the trunk, and points of the arm."""
    body = BodyModel.default()
    pose = torch.zeros(body.num_joints, 3)
    pose[16, 2] = -1.7
    still = torch.zeros(3)
    posed = body(BodyPose(pose, torch.zeros(body.num_betas), still, still))
    parts = PartMap.preset("five", body.num_joints)
    arm = parts.vertex_parts(body.weights) == parts.names.index("left_arm")
    return body, posed, posed.verts[arm], parts


def test_both_parts_of_an_overlap_are_found(
    contact: tuple[BodyModel, PosedBody, torch.Tensor, PartMap],
) -> None:
    body, posed, points, parts = contact
    roots = inverse_skin_all(points, posed, body, max_distance=REACH)
    assert (roots.count >= 1).all()
    two = roots.count >= 2
    assert two.sum() >= 20
    back = skin(
        roots.points.flatten(0, 1),
        blend_transforms(posed.transforms, roots.weights.flatten(0, 1)),
    ).view_as(roots.points)
    off = (back - points[:, None]).norm(dim=-1)
    assert off[roots.valid].max() <= 1e-3
    part = parts.vertex_parts(roots.weights[two, :2].flatten(0, 1)).view(-1, 2)
    assert (part[:, 0] != part[:, 1]).float().mean() > 0.8
    apart = (roots.points[two, 0] - roots.points[two, 1]).norm(dim=-1)
    assert apart.min() > 0.01
    assert (roots.residual.diff(dim=1)[two][:, 0] >= 0).all()


def test_the_root_of_the_plain_call_is_among_them(
    contact: tuple[BodyModel, PosedBody, torch.Tensor, PartMap],
) -> None:
    body, posed, points, _ = contact
    one = inverse_skin(points, posed, body, max_distance=REACH)
    roots = inverse_skin_all(points, posed, body, max_distance=REACH, most=4)
    gap = (roots.points - one.points[:, None]).norm(dim=-1)
    nearest = torch.where(roots.valid, gap, torch.inf).amin(1)
    assert (nearest[one.valid] <= 0.01).all()


def test_what_is_missing_is_masked(
    contact: tuple[BodyModel, PosedBody, torch.Tensor, PartMap],
) -> None:
    body, posed, points, _ = contact
    far = torch.cat([points[:3], torch.tensor([[9.0, 0, 0], [torch.nan, 0, 0]])])
    roots = inverse_skin_all(far, posed, body, max_distance=REACH)
    assert roots.points.shape == (5, 3, 3)
    assert roots.count[3:].tolist() == [0, 0]
    assert roots.residual[~roots.valid].isinf().all()
    assert (roots.weights[~roots.valid] == 0).all()
    assert inverse_skin_all(far[:0], posed, body).points.shape == (0, 3, 3)


def test_every_root_has_its_gradient(
    contact: tuple[BodyModel, PosedBody, torch.Tensor, PartMap],
) -> None:
    body, posed, points, _ = contact
    count = inverse_skin_all(points, posed, body, max_distance=REACH).count
    chosen = points[count >= 2][:8]
    x = chosen.clone().requires_grad_()
    roots = inverse_skin_all(x, posed, body, max_distance=REACH)
    for k in range(2):
        (slope,) = torch.autograd.grad(roots.points[:, k].sum(), x, retain_graph=True)
        assert slope.isfinite().all()
        moves = slope[roots.valid[:, k]].norm(dim=-1) > 0.1
        assert moves.float().mean() > 0.8  # a Jacobian without inverse passes nothing on


@pytest.mark.parametrize("backend", ["torch", "diffused"])
def test_other_fields_serve_too(
    contact: tuple[BodyModel, PosedBody, torch.Tensor, PartMap], backend: str
) -> None:
    body, posed, points, _ = contact
    if backend == "diffused":
        field, given, who = DiffusedField(body, voxel=0.02), points[::8], body
        roots = inverse_skin_all(given, posed, who, rest_verts=field, max_distance=REACH)
        assert (roots.count >= 1).float().mean() > 0.9
        return
    double = body.to(torch.zeros(1, dtype=torch.float64))
    pose = torch.zeros(body.num_joints, 3, dtype=torch.float64)
    pose[16, 2] = -1.7
    still = torch.zeros(3, dtype=torch.float64)
    betas = torch.zeros(body.num_betas, dtype=torch.float64)
    exact = double(BodyPose(pose, betas, still, still))
    few = points[::60]
    slow = inverse_skin_all(few.double(), exact, double, max_distance=REACH, starts=4)
    fast = inverse_skin_all(few, posed, body, max_distance=REACH, starts=4)
    assert (slow.count == fast.count).float().mean() > 0.85


def test_limits_are_checked(contact: tuple[BodyModel, PosedBody, torch.Tensor, PartMap]) -> None:
    body, posed, points, _ = contact
    with pytest.raises(InputError, match="apart, most"):
        inverse_skin_all(points, posed, body, apart=0.0)
    with pytest.raises(InputError, match="apart, most"):
        inverse_skin_all(points, posed, body, most=0)
