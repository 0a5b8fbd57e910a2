"""Surface queries follow motions, scales and relabellings of mesh and points."""

import dataclasses

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from motions import Motion, close, generator, motions, normal, seeds, shuffled, unit
from torch import Tensor
from tube import tube

from monopart.geometry.surface import (
    SurfaceHit,
    SurfaceIndex,
    closest_point,
    signed_distance,
    vertex_normals,
)
from monopart.geometry.uv import UVMap

EXACT = 1e-13  # metres, float64, a mesh of one metre
SINGLE = 1e-6  # metres, float32
FAR = 5e-5  # metres: six roundings of float32 at 100 m, which are 7.6e-6 m each
BACKENDS = [("torch", torch.float64, EXACT), ("warp", torch.float32, SINGLE)]
FEW = settings(max_examples=20)
TUBE = tube()
backends = st.sampled_from(BACKENDS)


def mesh(dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """The tube with bumps, so that no two faces tie."""
    return (TUBE.v_template + 0.01 * normal(1, TUBE.num_verts, 3)).to(dtype), TUBE.faces


def around(seed: int, verts: Tensor, count: int = 60) -> Tensor:
    pick = torch.randint(len(verts), (count,), generator=generator(seed))
    return verts[pick] + 0.1 * normal(seed, count, 3).to(verts)


def query(points: Tensor, verts: Tensor, faces: Tensor, backend: str) -> SurfaceHit:
    return closest_point(points, verts, faces, backend=backend)


def alike(found: SurfaceHit, expected: SurfaceHit, bound: float) -> None:
    close(found.distance, expected.distance, bound)
    # the foot of a point next to the medial axis may lie on either side
    apart = (found.point - expected.point).norm(dim=-1)
    assert float((apart > 30 * bound).double().mean()) <= 0.02


@FEW
@given(seeds, motions(), backends)
def test_hits_follow_a_motion(seed: int, motion: Motion, backend: tuple) -> None:
    name, dtype, bound = backend
    verts, faces = mesh(dtype)
    points = around(seed, verts)
    before = query(points, verts, faces, name)
    after = query(motion(points), motion(verts), faces, name)
    # not the faces: a foot on an edge belongs to two
    alike(after, dataclasses.replace(before, point=motion(before.point)), 3 * bound)


@FEW
@given(seeds, st.sampled_from([1e-3, 0.25, 7.0, 1e3]), backends)
def test_hits_follow_a_scale(seed: int, scale: float, backend: tuple) -> None:
    name, dtype, bound = backend
    verts, faces = mesh(dtype)
    points = around(seed, verts)
    before = query(points, verts, faces, name)
    after = query(scale * points, scale * verts, faces, name)
    unscaled = dataclasses.replace(
        after, distance=after.distance / scale, point=after.point / scale
    )
    alike(unscaled, before, 3 * bound)


@FEW
@given(seeds, backends)
def test_the_mirror_image_has_mirrored_hits(seed: int, backend: tuple) -> None:
    name, dtype, bound = backend
    verts, faces = mesh(dtype)
    points, mirror = around(seed, verts), torch.tensor([-1, 1, 1])
    before = query(points, verts, faces, name)
    after = query(points * mirror, verts * mirror, faces[:, [0, 2, 1]], name)
    close(after.distance, before.distance, bound)
    normals = vertex_normals(verts, faces), vertex_normals(verts * mirror, faces[:, [0, 2, 1]])
    close(normals[1], normals[0] * mirror, 10 * bound)
    sides = (
        signed_distance(points, before, normals[0], faces),
        signed_distance(points * mirror, after, normals[1], faces[:, [0, 2, 1]]),
    )
    assert float((sides[0] - sides[1]).abs().gt(9 * bound).double().mean()) <= 0.02


@FEW
@given(seeds, backends)
def test_orders_do_not_matter(seed: int, backend: tuple) -> None:
    """Of vertices, of faces, of the corners of a face, of the points."""
    name, dtype, bound = backend
    verts, faces = mesh(dtype)
    points = around(seed, verts)
    before = query(points, verts, faces, name)
    rows, places = shuffled(seed, len(faces)), shuffled(seed + 1, len(verts))
    turned = faces.roll(seed % 3, dims=1)[rows]
    alike(query(points, verts[places], places.argsort()[turned], name), before, bound)
    order = shuffled(seed + 2, len(points))
    mixed = query(points[order], verts, faces, name)
    assert torch.equal(mixed.face, before.face[order])
    close(mixed.bary, before.bary[order], 0)


@FEW
@given(seeds, backends)
def test_the_foot_of_a_foot_is_itself(seed: int, backend: tuple) -> None:
    name, dtype, bound = backend
    verts, faces = mesh(dtype)
    points = around(seed, verts)
    hit = query(points, verts, faces, name)
    again = query(hit.point, verts, faces, name)
    close(again.distance, torch.zeros_like(again.distance), bound)
    # the way to the surface is straight: half way there is half as far
    half = query((points + hit.point) / 2, verts, faces, name)
    close(half.distance, hit.distance / 2, bound)
    close(hit.bary.sum(-1), torch.ones_like(hit.distance), 1e-6)
    assert bool((hit.bary >= -1e-6).all())


@FEW
@given(seeds, backends)
def test_distances_are_one_lipschitz(seed: int, backend: tuple) -> None:
    name, dtype, bound = backend
    verts, faces = mesh(dtype)
    points = around(seed, verts)
    other = points + 0.2 * normal(seed + 1, len(points), 3).to(points)
    change = query(points, verts, faces, name).distance - query(other, verts, faces, name).distance
    assert bool((change.abs() <= (points - other).norm(dim=-1) + bound).all())


@FEW
@given(seeds, st.floats(0.2, 0.8), backends)
def test_a_mesh_is_the_nearer_of_its_pieces(seed: int, part: float, backend: tuple) -> None:
    name, dtype, bound = backend
    verts, faces = mesh(dtype)
    points = around(seed, verts)
    cut = round(part * len(faces))
    rows = shuffled(seed, len(faces))
    pieces = [query(points, verts, faces[r], name).distance for r in (rows[:cut], rows[cut:])]
    close(torch.minimum(*pieces), query(points, verts, faces, name).distance, bound)


@FEW
@given(seeds, motions())
def test_gradients_follow_a_motion(seed: int, motion: Motion) -> None:
    """The gradient of a distance is a direction, and turns with the world."""
    verts, faces = mesh(torch.float64)
    points = around(seed, verts).requires_grad_()
    closest_point(points, verts, faces).distance.sum().backward()
    moved = motion(points.detach()).requires_grad_()
    closest_point(moved, motion(verts), faces).distance.sum().backward()
    close(moved.grad, motion.turn(points.grad), 1e-9)
    close(points.grad.norm(dim=-1), torch.ones(len(points), dtype=points.dtype), 1e-12)


@pytest.mark.parametrize("backend", ["torch", "warp"])
@pytest.mark.parametrize("turned_over", [False, True])
def test_signs_follow_the_side(backend: str, turned_over: bool) -> None:
    verts, faces = mesh(torch.float64 if backend == "torch" else torch.float32)
    faces = faces[:, [0, 2, 1]] if turned_over else faces
    points = torch.cat([verts * torch.tensor([0.3, 1, 0.3]), verts * torch.tensor([2.0, 1, 2.0])])
    points = points[(points[:, 1] > 0.2) & (points[:, 1] < 0.8)]
    hit = query(points, verts, faces, backend)
    sign = signed_distance(points, hit, vertex_normals(verts, faces), faces).sign()
    inside = points[:, [0, 2]].norm(dim=-1) < 0.09
    assert torch.equal(sign < 0, inside != turned_over)


@FEW
@given(seeds, backends)
def test_surface_to_uv(seed: int, backend: tuple) -> None:
    """Every face has a chart of its own: a wrong corner or face reads a wrong coordinate."""
    name, dtype, bound = backend
    verts, faces = mesh(dtype)
    uv = UVMap(torch.rand(len(faces), 3, 2, generator=generator(0)).to(dtype))
    face = torch.randint(len(faces), (50,), generator=generator(seed))
    bary = torch.rand(50, 3, generator=generator(seed + 1)).to(dtype) + 0.2
    bary = bary / bary.sum(-1, keepdim=True)
    expected = (bary[..., None] * uv.corner_uv[face]).sum(1)
    corners = verts[faces[face]]
    normal_of = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lift = 1e-4 * torch.nn.functional.normalize(normal_of, dim=-1)
    for shift in (-lift, 0 * lift, lift):
        hit = query((bary[..., None] * corners).sum(1) + shift, verts, faces, name)
        assert torch.equal(hit.face, face)
        close(uv.at(hit), expected, 100 * bound)  # metres to coordinates: faces are 4 cm


@FEW
@given(seeds, backends)
def test_a_refit_mesh_is_a_new_one(seed: int, backend: tuple) -> None:
    name, dtype, bound = backend
    verts, faces = mesh(dtype)
    index = SurfaceIndex(verts, faces, name)
    moved = verts + 0.05 * normal(seed, len(verts), 3).to(verts)
    index.refit(moved)
    points = around(seed, moved)
    alike(index.query(points), query(points, moved, faces, name), bound)
    reach = 0.03
    near = index.query(points, reach)
    assert torch.equal(near.found, index.query(points).distance <= reach)


@FEW
@given(seeds)
def test_a_mesh_100_m_away(seed: int) -> None:
    verts, faces = mesh(torch.float32)
    points, far = around(seed, verts), (100 * unit(seed)).float()
    before = query(points, verts, faces, "warp")
    after = query(points + far, verts + far, faces, "warp")
    alike(dataclasses.replace(after, point=after.point - far), before, FAR)
