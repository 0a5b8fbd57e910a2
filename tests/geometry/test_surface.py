"""Closest surface: torch and Warp against float64 loops, and gradients against differences."""

import math

import numpy as np
import oracles
import pytest
import torch

from monopart.geometry import backend as backends
from monopart.geometry import surface
from monopart.geometry.body import BodyModel
from monopart.geometry.errors import BackendError, InputError
from monopart.geometry.surface import (
    SurfaceIndex,
    closest_on_triangle,
    closest_point,
    signed_distance,
    vertex_normals,
)

BACKENDS = ("torch", "warp")
TRIANGLE = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.2, 0.8, 0.0]])
# a point in the region of each feature of the triangle, and what it is nearest to
REGIONS = {
    "face": [0.4, 0.3, 0.5],
    "edge ab": [0.5, -0.4, 0.3],
    "edge bc": [0.9, 0.8, -0.3],
    "edge ca": [-0.4, 0.5, 0.2],
    "vertex a": [-0.5, -0.4, 0.1],
    "vertex b": [1.7, -0.3, 0.2],
    "vertex c": [0.1, 1.9, -0.4],
}


def random_mesh(seed: int = 0, faces: int = 50) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    verts = torch.randn(30, 3, generator=generator)
    order = [torch.randperm(30, generator=generator)[:3] for _ in range(faces)]
    return verts, torch.stack(order)


def sphere(radius: float = 0.5) -> tuple[torch.Tensor, torch.Tensor]:
    verts, faces = oracles.sphere(radius, 12, 24)
    return torch.from_numpy(verts).float(), torch.from_numpy(faces)


def box() -> tuple[torch.Tensor, torch.Tensor]:
    """The cube from 0 to 1, two outward triangles per side."""
    verts = torch.tensor([[float(i & 1), float(i >> 1 & 1), float(i >> 2)] for i in range(8)])
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return verts, torch.tensor(faces)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_against_the_loop(backend: str, dtype: torch.dtype) -> None:
    verts, faces = random_mesh()
    points = 2 * torch.randn(100, 3)
    hit = closest_point(points.to(dtype), verts.to(dtype), faces, backend=backend)
    expected, distance = oracles.closest_on_mesh(points.numpy(), verts.double().numpy(), faces)
    np.testing.assert_allclose(hit.distance.numpy(), distance, atol=1e-6)
    np.testing.assert_allclose(hit.point.numpy(), expected, atol=1e-5)
    assert hit.distance.dtype == dtype and hit.face.dtype == torch.int64
    assert bool(hit.found.all())
    # the three ways to name the point agree
    assert bool((hit.bary >= 0).all()) and bool((hit.bary <= 1).all())
    torch.testing.assert_close(hit.bary.sum(-1), torch.ones(100, dtype=dtype))
    rebuilt = (hit.bary[..., None] * verts.to(dtype)[faces[hit.face]]).sum(1)
    torch.testing.assert_close(rebuilt, hit.point)


def test_warp_and_torch_agree_on_the_body() -> None:
    body = BodyModel.default()
    points = body.v_template[::150] + 0.05 * torch.randn(38, 3)
    found = [closest_point(points, body.v_template, body.faces, backend=b) for b in BACKENDS]
    exact = closest_point(points.double(), body.v_template.double(), body.faces, backend="torch")
    for hit in found:
        assert (hit.distance - exact.distance).abs().max() <= 1e-6


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", REGIONS)
def test_each_region_of_a_triangle(backend: str, name: str) -> None:
    point = torch.tensor([REGIONS[name]])
    hit = closest_point(point, TRIANGLE, torch.tensor([[0, 1, 2]]), backend=backend)
    expected = oracles.closest_on_triangle(point[0].double().numpy(), TRIANGLE.double().numpy())
    np.testing.assert_allclose(hit.point[0].numpy(), expected, atol=1e-6)
    corners = "abc" if name == "face" else name.split()[1]
    used = {c for c, w in zip("abc", hit.bary[0].tolist(), strict=True) if w > 1e-6}
    assert used == set(corners)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", REGIONS)
def test_gradients_by_differences(backend: str, name: str) -> None:
    faces = torch.tensor([[0, 1, 2]])

    def function(points: torch.Tensor, verts: torch.Tensor) -> tuple[torch.Tensor, ...]:
        hit = closest_point(points, verts, faces, backend=backend)
        return hit.distance, hit.point, hit.bary

    point = torch.tensor([REGIONS[name]], dtype=torch.float64, requires_grad=True)
    verts = TRIANGLE.double().requires_grad_()
    assert torch.autograd.gradcheck(function, (point, verts))


@pytest.mark.parametrize("backend", BACKENDS)
def test_gradients_on_a_mesh(backend: str) -> None:
    verts, faces = random_mesh(1, 12)

    def function(points: torch.Tensor, verts: torch.Tensor) -> torch.Tensor:
        return closest_point(points, verts, faces, backend=backend).distance

    points = (2 * torch.randn(20, 3, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(function, (points, verts.double().requires_grad_()))


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_gradient_is_the_unit_vector_away_from_the_surface(backend: str) -> None:
    verts, faces = random_mesh(2)
    points = (2 * torch.randn(50, 3)).requires_grad_()
    hit = closest_point(points, verts, faces, backend=backend)
    (gradient,) = torch.autograd.grad(hit.distance.sum(), points)
    away = (points - hit.point) / hit.distance[:, None]
    torch.testing.assert_close(gradient, away.detach(), atol=1e-4, rtol=0)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "bary", [(0.2, 0.3, 0.5), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.5, 0.5, 0.0), (0.0, 0.4, 0.6)]
)
def test_points_of_the_surface(backend: str, bary: tuple[float, ...]) -> None:
    point = (torch.tensor(bary)[None] @ TRIANGLE).requires_grad_()
    verts = TRIANGLE.clone().requires_grad_()
    hit = closest_point(point, verts, torch.tensor([[0, 1, 2]]), backend=backend)
    torch.testing.assert_close(hit.bary[0], torch.tensor(bary), atol=1e-6, rtol=0)
    assert hit.distance.item() <= 1e-6
    for gradient in torch.autograd.grad(hit.distance.sum(), (point, verts)):
        assert bool(gradient.isfinite().all())


DEGENERATE = pytest.mark.parametrize(
    "corners",
    [
        [[0.0, 0, 0], [1, 0, 0], [0.5, 0, 0]],  # the longest edge is the first
        [[0.5, 0.0, 0], [0, 0, 0], [1, 0, 0]],  # or the opposite one
        [[0.0, 0, 0], [0, 0, 0], [1, 0, 0]],  # two corners in one
        [[1.0, 2, 3], [1, 2, 3], [1, 2, 3]],  # a point
    ],
)


@DEGENERATE
def test_a_degenerate_triangle_alone(corners: list[list[float]]) -> None:
    verts = torch.tensor(corners).requires_grad_()
    points = torch.randn(20, 3).requires_grad_()
    faces = torch.tensor([[0, 1, 2]])
    hit = closest_point(points, verts, faces, backend="torch")
    exact = [
        np.linalg.norm(p - oracles.closest_on_triangle(p, np.array(corners)))
        for p in points.detach().double().numpy()
    ]
    np.testing.assert_allclose(hit.distance.detach().numpy(), exact, atol=1e-6)
    for gradient in torch.autograd.grad(hit.distance.sum(), (points, verts)):
        assert bool(gradient.isfinite().all())
    # Warp passes over a segment, and says so
    fast = closest_point(points, verts, faces, backend="warp")
    assert not bool((fast.found & (fast.distance != hit.distance)).any())


@DEGENERATE
@pytest.mark.parametrize("backend", BACKENDS)
def test_degenerate_triangles_in_a_mesh(backend: str, corners: list[list[float]]) -> None:
    # two fans that hold every edge of the degenerate face
    verts = torch.cat([torch.tensor(corners), torch.tensor([[0.3, 1.0, 0.1], [0.4, -1.0, 0.2]])])
    faces = torch.tensor(
        [[0, 1, 2], [0, 1, 3], [1, 2, 3], [2, 0, 3], [0, 1, 4], [1, 2, 4], [2, 3, 4]]
    )
    points = torch.randn(30, 3).requires_grad_()
    moving = verts.clone().requires_grad_()
    hit = closest_point(points, moving, faces, backend=backend)
    _, exact = oracles.closest_on_mesh(points.detach().numpy(), verts.double().numpy(), faces)
    np.testing.assert_allclose(hit.distance.detach().numpy(), exact, atol=1e-6)
    for gradient in torch.autograd.grad(hit.distance.sum(), (points, moving)):
        assert bool(gradient.isfinite().all())


@pytest.mark.parametrize("backend", BACKENDS)
def test_max_distance(backend: str) -> None:
    verts, faces = random_mesh(3)
    points = (2 * torch.randn(200, 3)).requires_grad_()
    index = SurfaceIndex(verts, faces, backend)
    free, limited = index.query(points), index.query(points, max_distance=0.4)
    assert 20 < int(limited.found.sum()) < 180
    assert torch.equal(limited.found, free.distance <= 0.4)
    assert torch.equal(limited.distance[limited.found], free.distance[limited.found])
    assert bool(limited.distance[~limited.found].isinf().all())
    assert bool((limited.face[~limited.found] == 0).all())
    kept = torch.where(limited.found, limited.distance, 0.0)
    (gradient,) = torch.autograd.grad(kept.sum(), points)
    assert bool(gradient.isfinite().all()) and not bool(gradient[~limited.found].any())


@pytest.mark.parametrize("backend", BACKENDS)
def test_zero_points_one_point_and_nan(backend: str) -> None:
    index = SurfaceIndex(TRIANGLE, torch.tensor([[0, 1, 2]]), backend)
    none = index.query(torch.zeros(0, 3))
    assert none.face.shape == (0,) and none.bary.shape == (0, 3) and none.found.shape == (0,)
    assert index.query(torch.tensor([[0.2, 0.2, 0.7]])).distance.tolist() == pytest.approx([0.7])
    lost = index.query(torch.full((1, 3), math.nan))
    assert not bool(lost.found.any())


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_refit_equals_a_new_index(backend: str, dtype: torch.dtype) -> None:
    verts, faces = (t.to(dtype) if t.is_floating_point() else t for t in random_mesh(4))
    moved = verts + 0.5 * torch.randn_like(verts)
    points = 2 * torch.randn(100, 3, dtype=dtype)
    index = SurfaceIndex(verts, faces, backend)
    before = index.query(points).distance
    index.refit(moved)
    after, new = index.query(points), SurfaceIndex(moved, faces, backend).query(points)
    torch.testing.assert_close(after.distance, new.distance, atol=1e-6, rtol=0)
    assert not torch.allclose(after.distance, before)
    index.refit(verts)
    assert torch.equal(index.query(points).distance, before)


def test_an_index_keeps_its_own_positions() -> None:
    """The search tree must not follow a tensor that the caller overwrites."""
    verts, faces = random_mesh(5)
    points = 2 * torch.randn(50, 3)
    given = verts.clone()
    index = SurfaceIndex(given, faces, "warp")
    face = index.query(points).face
    given += 100
    index.verts = verts
    assert torch.equal(index.query(points).face, face)


@pytest.mark.parametrize("backend", BACKENDS)
def test_bad_input(backend: str) -> None:
    faces = torch.tensor([[0, 1, 2]])
    with pytest.raises(InputError, match="at least one triangle"):
        SurfaceIndex(TRIANGLE, torch.zeros(0, 3, dtype=torch.int64), backend)
    with pytest.raises(InputError, match=r"0\.\.2, found 1\.\.3"):
        SurfaceIndex(TRIANGLE, faces + 1, backend)
    with pytest.raises(InputError, match="found -1"):
        SurfaceIndex(TRIANGLE, faces - 1, backend)
    index = SurfaceIndex(TRIANGLE, faces, backend)
    with pytest.raises(InputError, match="float64"):
        index.query(torch.zeros(1, 3, dtype=torch.float64))
    with pytest.raises(InputError, match="build a new SurfaceIndex"):
        index.refit(torch.zeros(4, 3))


def test_backends_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    faces = torch.tensor([[0, 1, 2]])
    assert SurfaceIndex(TRIANGLE, faces).backend == "warp"
    with pytest.raises(InputError, match="'fast'"):
        SurfaceIndex(TRIANGLE, faces, "fast")
    monkeypatch.setattr(backends, "warp_is_installed", lambda: False)
    assert SurfaceIndex(TRIANGLE, faces).backend == "torch"
    with pytest.raises(BackendError, match="pip install"):
        SurfaceIndex(TRIANGLE, faces, "warp")


def test_the_reference_is_the_same_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    verts, faces = random_mesh(6)
    points = torch.randn(40, 3)
    whole = closest_point(points, verts, faces, backend="torch")
    monkeypatch.setattr(surface, "_CHUNK", 7 * len(faces))
    pieces = closest_point(points, verts, faces, backend="torch")
    assert torch.equal(whole.distance, pieces.distance)


def test_closest_on_triangle_takes_any_batch() -> None:
    points, triangles = torch.randn(2, 3, 3), torch.randn(2, 3, 3, 3)
    bary = closest_on_triangle(points, triangles)
    one = closest_on_triangle(points[1, 2], triangles[1, 2])
    torch.testing.assert_close(bary[1, 2], one)
    assert closest_on_triangle(torch.zeros(0, 3), torch.zeros(0, 3, 3)).shape == (0, 3)


def test_normals_of_a_sphere_are_radial() -> None:
    verts, faces = sphere()
    normals = vertex_normals(verts, faces)
    cosine = (normals * verts / 0.5).sum(-1)
    assert cosine.min() > 0.998
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(len(verts)))
    batch = vertex_normals(torch.stack([verts, -verts]), faces)
    torch.testing.assert_close(batch[0], normals)
    torch.testing.assert_close(batch[1], normals)  # through the origin, orientation flips too


def test_normals_are_area_weighted_and_finite() -> None:
    verts = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 1], [5, 5, 5]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])  # doubled areas 4 along z and 2 along x
    normals = vertex_normals(verts, faces)
    torch.testing.assert_close(normals[0], torch.tensor([2.0, 0.0, 4.0]) / math.sqrt(20))
    assert normals[4].tolist() == [0.0, 0.0, 0.0]
    double = verts.double().requires_grad_()
    assert torch.autograd.gradcheck(lambda v: vertex_normals(v, faces), double)
    flat = torch.zeros(3, 3, requires_grad=True)
    vertex_normals(flat, torch.tensor([[0, 1, 2]])).sum().backward()
    assert flat.grad is not None and bool(flat.grad.isfinite().all())


@pytest.mark.parametrize("backend", BACKENDS)
def test_signed_distance_of_a_sphere(backend: str) -> None:
    verts, faces = sphere()
    points = torch.randn(300, 3) * 0.4
    hit = closest_point(points, verts, faces, backend=backend)
    signed = signed_distance(points, hit, vertex_normals(verts, faces), faces)
    assert 30 < int((signed < 0).sum()) < 270
    # the facets lie up to radius * (1 - cos(pi / 12)) inside the sphere
    torch.testing.assert_close(signed, points.norm(dim=-1) - 0.5, atol=0.018, rtol=0)


def test_signed_distance_of_a_box() -> None:
    verts, faces = box()
    points = 2 * torch.rand(500, 3) - 0.5
    hit = closest_point(points, verts, faces)
    signed = signed_distance(points, hit, vertex_normals(verts, faces), faces)
    inward = torch.minimum(points, 1 - points).amin(-1)
    outside = (-torch.minimum(points, 1 - points)).clamp(min=0).norm(dim=-1)
    torch.testing.assert_close(signed, torch.where(inward > 0, -inward, outside), atol=1e-6, rtol=0)


def test_signed_distance_of_what_was_not_found_is_plus_infinity() -> None:
    verts, faces = sphere()
    points = torch.cat([torch.zeros(1, 3), 3 * torch.randn(50, 3)])
    hit = closest_point(points, verts, faces, max_distance=1e-3)
    assert not bool(hit.found.any())
    signed = signed_distance(points, hit, vertex_normals(verts, faces), faces)
    assert bool((signed == math.inf).all())
