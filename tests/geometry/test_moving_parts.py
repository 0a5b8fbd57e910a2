"""Canonical points as functions of poses, against the kernels, the formulas and differences."""

import dataclasses

import pytest
import torch

from monopart.geometry.body import BodyModel, BodyPose, PosedBody
from monopart.geometry.cameras import Rays
from monopart.geometry.culling import BodyShell, ShellSamples
from monopart.geometry.errors import InputError
from monopart.geometry.moving_parts import MovingParts, closest_bary
from monopart.geometry.parts import PartMap
from monopart.geometry.posed_parts import PartPairs, PosedParts
from monopart.geometry.skinning import blend_transforms

BODY = BodyModel.default()
PARTS = PartMap.default()
RADIUS = 0.05
CANONICAL = BODY.canonical(torch.zeros(BODY.num_betas))


def pose(seed: int = 5, count: int = 2) -> BodyPose:
    generator = torch.Generator().manual_seed(seed)
    rest = BodyPose.zeros(BODY, (count,))
    draw = {
        "pose": 0.3 * torch.randn(count, BODY.num_joints, 3, generator=generator),
        "rotation": 0.5 * torch.randn(count, 3, generator=generator),
        "translation": 0.5 * torch.randn(count, 3, generator=generator),
    }
    return dataclasses.replace(rest, **draw)


def moving(posed: PosedBody) -> MovingParts:
    still = PosedParts(BODY, posed, CANONICAL, PARTS, RADIUS)
    return MovingParts.like(still, BODY, posed, still.shell)


def ask(parts: PosedParts, count: int = 300) -> tuple[ShellSamples, PartPairs]:
    generator = torch.Generator().manual_seed(7)
    body = torch.randint(len(parts.verts), (count,), dtype=torch.int32, generator=generator)
    pick = torch.randint(BODY.num_verts, (count,), generator=generator)
    target = parts.verts[body.long(), pick] + 0.02 * torch.randn(count, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    samples = parts.shell.sample(Rays(target - 0.1 * directions, directions), 0.02, body)
    return samples, parts.pairs(samples)


def test_world_normals_are_those_of_the_new_poses() -> None:
    old, new = BODY(pose(5)), BODY(pose(6))
    still = PosedParts(BODY, old, CANONICAL, PARTS, RADIUS)
    before = still.world_normals()
    moved = MovingParts.like(still, BODY, new, BodyShell(new.verts, BODY.faces, RADIUS))
    expected = PosedParts(BODY, new, CANONICAL, PARTS, RADIUS).world_normals()
    torch.testing.assert_close(moved.world_normals(), expected)
    assert float((before - expected).norm(dim=-1).mean()) > 0.1
    assert not moved.world_normals().requires_grad and torch.equal(
        moved.translation, new.translation
    )


def test_following_gives_what_the_kernel_gives() -> None:
    parts = moving(BODY(pose()))
    samples, pairs = ask(parts)
    expected, found = parts.unskin(samples, pairs), parts.follow(samples, pairs)
    assert len(pairs.sample) > 1000 and torch.equal(expected.valid, found.valid)
    torch.testing.assert_close(found.points, expected.points, atol=2e-5, rtol=0)
    torch.testing.assert_close(found.uv, expected.uv, atol=2e-4, rtol=0)
    empty = dataclasses.replace(
        pairs, **{n: getattr(pairs, n)[:0] for n in ("sample", "part", "face", "bary")}
    )
    nothing = parts.follow(samples, empty)
    assert nothing.points.shape == (0, 3) and nothing.uv.shape == (0, 2)


TRIANGLE = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)


@pytest.mark.parametrize(
    ("point", "bary"),
    [
        ((0.2, 0.3, 0.4), (0.5, 0.2, 0.3)),
        ((0.4, -0.5, 0.1), (0.6, 0.4, 0.0)),
        ((-0.3, 0.25, 0.2), (0.75, 0.0, 0.25)),
        ((0.9, 0.7, -0.1), (0.0, 0.6, 0.4)),
        ((-1.0, -1.0, 0.3), (1.0, 0.0, 0.0)),
    ],
)
def test_barycentrics_of_inside_edges_and_corners(
    point: tuple[float, ...], bary: tuple[float, ...]
) -> None:
    points = torch.tensor([point], dtype=torch.float64, requires_grad=True)
    corners = TRIANGLE[None].clone().requires_grad_()
    held = torch.tensor([bary], dtype=torch.float64)
    torch.testing.assert_close(closest_bary(points, corners, held), held)
    assert torch.autograd.gradcheck(lambda p, c: closest_bary(p, c, held), (points, corners))


def test_needles_and_points_are_held_with_finite_gradients() -> None:
    needle = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], [[1.0, 1, 1]] * 3])
    needle.requires_grad_()
    held = torch.tensor([[0.2, 0.3, 0.5], [0.0, 0.5, 0.5]])
    found = closest_bary(torch.ones(2, 3), needle, held)
    assert torch.equal(found.detach(), held)
    (grad,) = torch.autograd.grad(found.sum(), needle, allow_unused=True)
    assert grad is None or bool(grad.isfinite().all())


def _doubled(posed: PosedBody) -> PosedBody:
    return PosedBody(*(getattr(posed, f.name).double() for f in dataclasses.fields(posed)))


def test_the_gradient_in_poses_and_placements_is_that_of_differences() -> None:
    """In float64: pairs are held, everything else is made anew from the pose."""
    start = pose(count=1)
    samples, pairs = ask(moving(BODY(start)), 40)
    some = torch.arange(0, len(pairs.sample), max(1, len(pairs.sample) // 25))
    few = dataclasses.replace(
        pairs, **{n: getattr(pairs, n)[some] for n in ("sample", "part", "face", "bary")}
    )
    first = _doubled(BODY(start))
    world = first.to_world(samples.points.double()[None])[0]
    like = torch.zeros((), dtype=torch.float64)
    frozen = PosedParts(BODY, first, CANONICAL, PARTS, RADIUS)
    exact = dataclasses.replace(samples, points=samples.points.double())

    def canonical(theta: torch.Tensor, rh: torch.Tensor, th: torch.Tensor) -> torch.Tensor:
        posed = BODY(BodyPose(theta, start.betas.double(), rh, th), backend="torch")
        parts = MovingParts.like(frozen, BODY, posed, frozen.shell)
        # the points stand still in the world: `follow` starts from their present local place
        local = posed.to_local(world[None])[0].detach()
        moved = dataclasses.replace(exact, points=local)
        rest = parts.follow(moved, few)
        return torch.cat([rest.points, rest.uv], -1)

    # With `points` at the local place of the given pose the differences see the whole chain.
    inputs = [start.pose.double(), start.rotation.double(), start.translation.double()]
    assert inputs[0].dtype == like.dtype
    for value in inputs:
        value.requires_grad_()
    assert torch.autograd.gradcheck(canonical, inputs, eps=1e-6, atol=1e-5, fast_mode=True)


def test_shells_are_joined_in_order() -> None:
    posed = BODY(pose(count=3))
    whole = PosedParts(BODY, posed, CANONICAL, PARTS, RADIUS)
    face_part = PARTS.face_parts(BODY.weights, BODY.faces)
    radii = torch.full((5,), RADIUS)
    single = [BodyShell(v, BODY.faces, radii, face_part) for v in posed.verts]
    points = posed.verts[:, ::50].reshape(-1, 3) + 0.03
    body = torch.arange(3).repeat_interleave(len(points) // 3)
    joined = BodyShell.joined(single)
    each = [s.bits(points[body == b]) for b, s in enumerate(single)]
    assert torch.equal(joined.bits(points, body), torch.cat(each))
    assert len(joined.lo) == len(whole.shell.lo) == 3
    with pytest.raises(InputError, match="one voxel size"):
        BodyShell.joined([single[0], BodyShell(posed.verts[0], BODY.faces, radii, voxel=0.03)])
    with pytest.raises(InputError, match="as many bodies"):
        MovingParts.like(whole, BODY, posed, single[0])
    maps = blend_transforms(posed.transforms, BODY.weights)[..., :3, :].reshape(-1, 3, 4)
    assert torch.equal(MovingParts.like(whole, BODY, posed, joined).posed_maps, maps)
