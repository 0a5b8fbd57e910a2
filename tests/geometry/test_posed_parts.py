"""Pairs, inverse skinning and the way back, against per-part searches and the torch path."""

import dataclasses

import pytest
import torch

from monopart.geometry.body import BodyModel, BodyPose, PosedBody
from monopart.geometry.cameras import Rays
from monopart.geometry.consistency import consistency_loss, round_trip
from monopart.geometry.culling import BodyShell, ShellSamples
from monopart.geometry.errors import InputError
from monopart.geometry.parts import PartMap
from monopart.geometry.posed_parts import PartHit, PartPairs, PosedParts, RestPoints
from monopart.geometry.skinning import blend_transforms, skin, unskin
from monopart.geometry.surface import SurfaceIndex

BODY = BodyModel.default()
PARTS = PartMap.default()
RADIUS = torch.tensor([0.06, 0.04, 0.05, 0.03, 0.03])
FACE_PART = PARTS.face_parts(BODY.weights, BODY.faces)
CANONICAL = BODY.canonical(torch.zeros(BODY.num_betas))
Batch = tuple[PosedParts, ShellSamples, PartPairs, RestPoints]


def poses() -> BodyPose:
    generator = torch.Generator().manual_seed(5)
    pose = BodyPose.zeros(BODY, (3,))
    pose.pose[1:] = 0.3 * torch.randn(2, 24, 3, generator=generator)
    pose.betas[:] = 0.5 * torch.randn(3, BODY.num_betas, generator=generator)
    return pose


def ask(parts: PosedParts, count: int = 1500, step: float = 0.02) -> Batch:
    """Samples of rays at the bodies and all that follows."""
    generator = torch.Generator().manual_seed(7)
    body = torch.randint(len(parts.verts), (count,), dtype=torch.int32, generator=generator)
    pick = torch.randint(BODY.num_verts, (count,), generator=generator)
    target = parts.verts[body.long(), pick] + 0.02 * torch.randn(count, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    samples = parts.shell.sample(Rays(target - 0.1 * directions, directions), step, body)
    pairs = parts.pairs(samples)
    return parts, samples, pairs, parts.unskin(samples, pairs)


@pytest.fixture(scope="module")
def batch() -> Batch:
    return ask(PosedParts(BODY, BODY(poses()), CANONICAL, PARTS, RADIUS))


@pytest.fixture(scope="module")
def canonical() -> PosedParts:
    return PosedParts(BODY, CANONICAL, CANONICAL, PARTS, 0.2)


def full_bary(pairs: PartPairs) -> torch.Tensor:
    return torch.cat([pairs.bary, 1 - pairs.bary.sum(-1, keepdim=True)], -1)


def test_pairs_are_the_parts_within_their_radius(batch: Batch) -> None:
    parts, samples, pairs, _ = batch
    count = len(samples.points)
    found = torch.zeros(5, count, dtype=torch.bool)
    found[pairs.part, pairs.sample] = True
    assert int(found.sum()) == len(pairs.part) > 5000  # no pair twice
    for b, verts in enumerate(parts.verts):
        mine = samples.body == b
        for part, radius in enumerate(RADIUS.tolist()):
            index = SurfaceIndex(verts, BODY.faces[FACE_PART == part])
            distance = index.query(samples.points[mine]).distance
            edge = (distance - radius).abs() < 1e-6
            assert torch.equal(found[part, mine][~edge], (distance <= radius)[~edge])
            assert 10 < int((distance <= radius).sum())


def test_pairs_name_the_closest_point(batch: Batch) -> None:
    parts, samples, pairs, _ = batch
    assert torch.equal(FACE_PART[pairs.face], pairs.part)
    owner = samples.body[pairs.sample].long()
    corners = parts.verts[owner[:, None], BODY.faces[pairs.face]]
    point = (full_bary(pairs)[..., None] * corners).sum(1)
    distance = (samples.points[pairs.sample] - point).norm(dim=-1)
    for b, verts in enumerate(parts.verts):
        for part in range(5):
            rows = (owner == b) & (pairs.part == part)
            index = SurfaceIndex(verts, BODY.faces[FACE_PART == part])
            exact = index.query(samples.points[pairs.sample[rows]]).distance
            torch.testing.assert_close(distance[rows], exact, atol=1e-6, rtol=0)


def test_pairs_are_sorted_by_part_then_sample(batch: Batch) -> None:
    _, samples, pairs, _ = batch
    order = pairs.part * len(samples.points) + pairs.sample
    assert bool((order.diff() > 0).all())
    assert pairs.counts == tuple(torch.bincount(pairs.part, minlength=5).tolist())


def test_unskin_is_the_torch_path(batch: Batch) -> None:
    parts, samples, pairs, rest = batch
    corner_weights = BODY.weights.double()[BODY.faces[pairs.face]]
    weights = (full_bary(pairs).double()[..., None] * corner_weights).sum(1)
    transforms = BODY(poses()).transforms.double()
    owner = samples.body[pairs.sample].long()
    valid = torch.zeros(len(owner), dtype=torch.bool)
    expected = torch.zeros(len(owner), 3, dtype=torch.float64)
    there = blend_transforms(CANONICAL.transforms.double(), weights)
    for b in range(3):
        rows = owner == b
        blended = blend_transforms(transforms[b], weights[rows])
        back, valid[rows] = unskin(samples.points[pairs.sample[rows]].double(), blended)
        expected[rows] = skin(back, there[rows])
    assert torch.equal(rest.valid, valid)
    assert float(valid.float().mean()) > 0.99
    torch.testing.assert_close(rest.points[valid].double(), expected[valid], atol=1e-5, rtol=0)
    assert bool(rest.points.isfinite().all())
    assert BODY.uv is not None
    uv = BODY.uv.at_faces(pairs.face, full_bary(pairs))
    torch.testing.assert_close(rest.uv, uv, atol=1e-6, rtol=0)
    assert parts.num_parts == 5


def test_a_body_alone_is_asked_like_one_of_many(batch: Batch) -> None:
    _, samples, pairs, rest = batch
    posed = BODY(poses())
    fields = [getattr(posed, field.name) for field in dataclasses.fields(PosedBody)]
    for b in range(3):
        single = PosedBody(*(field[b] for field in fields))
        alone = PosedParts(BODY, single, CANONICAL, PARTS, RADIUS)
        rows = (samples.body == b).nonzero().squeeze(-1)
        mine = dataclasses.replace(
            samples,
            points=samples.points[rows],
            depth=samples.depth[rows],
            ray=samples.ray[rows],
            body=torch.zeros(len(rows), dtype=torch.int32),
            candidates=samples.candidates[rows],
        )
        own = alone.pairs(mine)
        same = samples.body[pairs.sample] == b
        assert torch.equal(rows[own.sample], pairs.sample[same])
        assert torch.equal(own.face, pairs.face[same])
        torch.testing.assert_close(alone.unskin(mine, own).points, rest.points[same])


def test_singular_maps_are_marked() -> None:
    """Weights half and half over opposite half turns have no inverse."""
    pose = BodyPose.zeros(BODY)
    pose.pose[18, 1] = torch.pi  # the left elbow turned on its back
    rest = ask(PosedParts(BODY, BODY(pose), CANONICAL, PARTS, 0.05), 4000)[3]
    assert 0 < int((~rest.valid).sum()) < len(rest.valid) / 2
    assert bool(rest.points.isfinite().all())


def test_on_part_searches_the_asked_part(canonical: PosedParts) -> None:
    points = CANONICAL.verts[::20] + 0.05 * torch.randn_like(CANONICAL.verts[::20])
    part = torch.randint(5, (len(points),))
    hit = canonical.on_part(points, part, reach=0.1)
    assert 20 < int(hit.found.sum()) < len(points) - 20
    assert torch.equal(FACE_PART[hit.face[hit.found]], part[hit.found])
    for k in range(5):
        index = SurfaceIndex(CANONICAL.verts, BODY.faces[FACE_PART == k])
        exact = index.query(points[part == k], 0.1)
        assert torch.equal(hit.found[part == k], exact.found)
        rows = (part == k) & hit.found
        corners = CANONICAL.verts[BODY.faces[hit.face[rows]]]
        point = (hit.bary[rows][..., None] * corners).sum(1)
        distance = (points[rows] - point).norm(dim=-1)
        torch.testing.assert_close(distance, exact.distance[exact.found], atol=1e-6, rtol=0)
    assert BODY.uv is not None
    uv = BODY.uv.at_faces(hit.face, hit.bary)
    torch.testing.assert_close(hit.uv[hit.found], uv[hit.found])
    none = canonical.on_part(torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64))
    assert none.face.shape == (0,) and none.found.shape == (0,)


def test_reskin_undoes_unskin_with_the_same_weights(batch: Batch) -> None:
    """With the hit of the pair itself the two maps are exact inverses, wherever LBS has one."""
    parts, samples, pairs, rest = batch
    canonical = PosedParts(BODY, CANONICAL, CANONICAL, PARTS, 0.05)
    ok = rest.valid
    hit = PartHit(pairs.face[ok], full_bary(pairs)[ok], rest.uv[ok], ok[ok])
    owner = samples.body[pairs.sample].long()[ok]
    back = parts.reskin(rest.points[ok], owner, hit, canonical)
    gap = (back - samples.points[pairs.sample[ok]]).norm(dim=-1)
    # a small determinant amplifies rounding; everywhere else it is a few micrometres
    assert gap.quantile(0.99) < 2e-5 and gap.max() < 5e-3


def trip(batch: Batch, canonical: PosedParts) -> tuple[torch.Tensor, PartHit]:
    """Round trip of an untrained model: residuals are zero, the canonical hit is looked up."""
    parts, samples, pairs, rest = batch
    hit = canonical.on_part(rest.points, pairs.part, reach=0.2)
    owner = samples.body[pairs.sample].long()
    points = samples.points[pairs.sample]
    distance = round_trip(
        points, lambda _: rest.points, lambda c: parts.reskin(c, owner, hit, canonical)
    )
    return distance, hit


def test_the_round_trip_is_exact_where_skinning_is_rigid(
    batch: Batch, canonical: PosedParts
) -> None:
    distance, hit = trip(batch, canonical)
    weights, pairs, rest = BODY.weights, batch[2], batch[3]
    here = weights[BODY.faces[pairs.face]].amin(1)  # the least weight over the corners
    there = weights[BODY.faces[hit.face]].amin(1)
    rigid = (here.amax(-1) > 0.99999) & (there.amax(-1) > 0.99999)
    rigid &= (here.argmax(-1) == there.argmax(-1)) & rest.valid & hit.found
    assert int(rigid.sum()) > 500
    assert distance[rigid].max() < 1e-4
    # around joints the look-up finds other weights: what the loss is there to see
    bent = ~rigid & rest.valid & hit.found
    assert distance[bent].max() > 0.005
    assert consistency_loss(distance[rigid]).item() == 0.0


def test_the_canonical_pose_comes_back_to_itself(canonical: PosedParts) -> None:
    """Posed = canonical: unskinning moves nothing."""
    parts = PosedParts(BODY, CANONICAL, CANONICAL, PARTS, 0.04)
    found = ask(parts, 500)
    _, samples, pairs, rest = found
    torch.testing.assert_close(
        rest.points[rest.valid], samples.points[pairs.sample][rest.valid], atol=2e-5, rtol=0
    )
    distance, hit = trip(found, canonical)
    assert bool(hit.found.all())
    assert distance[rest.valid].max() < 1e-4


def test_reskin_is_differentiable_in_points(batch: Batch, canonical: PosedParts) -> None:
    parts, samples, pairs, rest = batch
    rows = rest.valid.nonzero().squeeze(-1)[:: len(rest.valid) // 6]
    points = rest.points[rows].double().requires_grad_()
    hit = canonical.on_part(rest.points[rows], pairs.part[rows])
    owner = samples.body[pairs.sample[rows]].long()
    assert torch.autograd.gradcheck(lambda p: parts.reskin(p, owner, hit, canonical), points)


def test_no_samples(batch: Batch, canonical: PosedParts) -> None:
    parts = batch[0]
    samples = parts.shell.sample(Rays(torch.zeros(0, 3), torch.zeros(0, 3)), 0.01)
    pairs = parts.pairs(samples)
    rest = parts.unskin(samples, pairs)
    assert pairs.counts == (0,) * 5 and rest.points.shape == (0, 3) and rest.uv.shape == (0, 2)
    hit = canonical.on_part(rest.points, pairs.part)
    owner = torch.zeros(0, dtype=torch.int64)
    assert parts.reskin(rest.points, owner, hit, canonical).shape == (0, 3)


def test_a_part_that_no_face_belongs_to() -> None:
    """A joint that moves no vertex leaves its part empty: nothing is found there."""
    still = PartMap((0,) * 23 + (1,), ("whole", "last"))
    weights = BODY.weights.clone()
    weights[:, 22] += weights[:, 23]
    weights[:, 23] = 0
    body = dataclasses.replace(BODY, weights=weights)
    parts = PosedParts(body, body.canonical(torch.zeros(BODY.num_betas)), CANONICAL, still, 0.05)
    found = ask(parts, 200)
    assert found[2].counts[0] > 100 and found[2].counts[1] == 0
    hit = parts.on_part(CANONICAL.verts[:5], torch.tensor([0, 1, 0, 1, 1]))
    assert hit.found.tolist() == [True, False, True, False, False]


def test_a_body_without_uv_is_refused() -> None:
    with pytest.raises(InputError, match="UV"):
        PosedParts(dataclasses.replace(BODY, uv=None), CANONICAL, CANONICAL, PARTS)


def test_a_kept_shell_gives_the_same_samples(batch: Batch) -> None:
    parts, samples, pairs, _ = batch
    kept = BodyShell(parts.verts, BODY.faces, RADIUS, FACE_PART, grid=parts.shell.grid)
    again = ask(PosedParts(BODY, BODY(poses()), CANONICAL, PARTS, RADIUS, kept))
    assert torch.equal(again[1].points, samples.points)
    assert torch.equal(again[1].candidates, samples.candidates)
    assert torch.equal(again[2].face, pairs.face)
    with pytest.raises(InputError, match="shell: expected 1 bodies, found 3"):
        PosedParts(BODY, CANONICAL, CANONICAL, PARTS, RADIUS, kept)


def test_world_normals_turn_with_the_body() -> None:
    pose = poses()
    pose.rotation[:] = torch.tensor([[0.0, 0, 0], [0.0, 1.2, 0.3], [-0.7, 0.2, 2.0]])
    posed = BODY(pose)
    parts = PosedParts(BODY, posed, CANONICAL, PARTS, RADIUS)
    normals = parts.world_normals()
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(normals.shape[:2]))
    corners = posed.verts_world[:, BODY.faces]
    flat = torch.linalg.cross(
        corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    )
    flat = torch.nn.functional.normalize(flat, dim=-1)
    face = torch.arange(0, len(BODY.faces), 7)
    for body in range(3):
        middle = torch.full((len(face), 2), 1 / 3)
        found = parts.interpolate(normals, torch.full_like(face, body), face, middle)
        # the middle of a face looks where the face looks, but for the bend of the surface
        assert float((found * flat[body, face]).sum(-1).quantile(0.1)) > 0.85


@pytest.mark.parametrize("columns", [1, 3, 4, 8])
def test_values_of_vertices_are_mixed_on_faces(columns: int) -> None:
    parts = PosedParts(BODY, BODY(poses()), CANONICAL, PARTS, RADIUS)
    generator = torch.Generator().manual_seed(2)
    values = torch.randn(3, BODY.num_verts, columns, generator=generator)
    body = torch.randint(3, (2000,), generator=generator)
    face = torch.randint(len(BODY.faces), (2000,), generator=generator)
    three = torch.rand(2000, 3, generator=generator)
    three = three / three.sum(1, keepdim=True)
    found = parts.interpolate(values, body, face, three[:, :2])
    exact = torch.einsum("mc,mcf->mf", three, values[body[:, None], BODY.faces[face]])
    torch.testing.assert_close(found, exact, atol=2e-6, rtol=1e-5)
    double = parts.interpolate(values.double(), body, face, three[:, :2])
    torch.testing.assert_close(found, double.float(), atol=2e-6, rtol=1e-5)
    assert parts.interpolate(values, body[:0], face[:0], three[:0, :2]).shape == (0, columns)
    for name, bad in (("body", (body + 2, face)), ("face", (body, face - len(parts.faces)))):
        with pytest.raises(InputError, match=f"{name}: expected indices"):
            parts.interpolate(values, *bad, three[:, :2])
