"""What Newton's steps do not bring home: Broyden's method in the kernel, and its plain twin."""

from dataclasses import replace

import pytest
import torch
from posing import around, pose_of, share
from torch import Tensor

from monopart.geometry.body import BodyModel, PosedBody
from monopart.geometry.skinning_field import SkinningField, vertex_maps
from monopart.geometry.unskin import inverse_skin
from monopart.geometry.unskin_broyden import rescued
from monopart.geometry.unskin_newton import Bones, Plan, newton_torch, newton_warp


@pytest.fixture(scope="module")
def contorted() -> tuple[BodyModel, PosedBody, Tensor]:
    """A pose in which limbs meet, and points around it."""
    torch.manual_seed(5)
    body = BodyModel.default()
    posed = pose_of(body, 0.5 * torch.randn(body.num_joints, 3))
    return body, posed, around(posed.verts, body.faces, 6000)


def test_newton_finds_what_broyden_finds_from_many_starts(contorted) -> None:
    body, posed, points = contorted
    many = inverse_skin(points, posed, body, "broyden", starts=13).valid
    one = inverse_skin(points, posed, body, "broyden").valid
    newton = inverse_skin(points, posed, body, starts=13)
    assert share(newton.valid) >= share(many) - 5e-4 and share(newton.valid) > share(one)
    assert share(inverse_skin(points, posed, body).valid) >= share(many) - 1e-3
    assert newton.residual[newton.valid].quantile(0.95) < 5e-7


def test_a_rescue_only_adds(contorted) -> None:
    body, posed, points = contorted
    field = SkinningField(body)
    maps = vertex_maps(posed.transforms, body.weights)
    bones = Bones.of(posed.joints, posed.transforms)
    plan = Plan(8, 1, 0.2, 4e-7, True)
    guess = inverse_skin(points, posed, body, "surface").points
    alone, weights = newton_warp(field, points, maps, bones, plan, guess)
    saved, more = newton_warp(field, points, maps, bones, replace(plan, rescues=2), guess)
    failed = alone.residual > 1e-3
    assert 10 < int(failed.sum()) < 500
    for before, after in ((alone.points, saved.points), (weights, more)):
        assert torch.equal(before[~failed], after[~failed])
    assert (saved.residual <= alone.residual).all()
    home = failed & (saved.residual <= 1e-3)
    assert home.sum() >= 0.3 * failed.sum()
    # the weights are those of the place, and the residual that of the weights
    exact = field.weights_on(saved.points, saved.face, field.rest)
    torch.testing.assert_close(more[home], exact[home], atol=1e-5, rtol=0)
    found = newton_torch(field, points[failed], maps, bones, plan, guess[failed])
    plain = rescued(
        found, field, points[failed], maps, bones, replace(plan, rescues=2), guess[failed]
    )
    both = (plain.residual <= 1e-3).float().mean() - share(saved.residual[failed] <= 1e-3)
    assert abs(float(both)) < 0.1  # secants across kinks part ways after a rounding


def test_nothing_to_rescue(contorted) -> None:
    body, posed, _ = contorted
    field = SkinningField(body, backend="torch")
    maps = vertex_maps(posed.transforms, body.weights)
    bones = Bones.of(posed.joints, posed.transforms)
    plan = Plan(8, 1, 0.2, 5e-6, True, rescues=3)
    none = torch.zeros(0, 3)
    found = newton_torch(field, none, maps, bones, plan, none)
    assert rescued(found, field, none, maps, bones, plan, none) is found
    far = torch.full((3, 3), 50.0)  # no face within reach: not found, by either method
    for backend in ("warp", "torch"):
        lost = inverse_skin(far, posed, body, rest_verts=SkinningField(body, backend=backend))
        assert not lost.valid.any() and lost.residual.isinf().all()
