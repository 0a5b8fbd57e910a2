"""Closest surface where floats are short of digits: needles, faces without area, no numbers."""

import math

import pytest
import torch

from monopart.geometry.surface import (
    SurfaceIndex,
    closest_on_triangle,
    closest_point,
    vertex_normals,
)
from monopart.tools.bench.stability_meshes import ball, exact_distance, near, soup

BACKENDS = ("torch", "warp")


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("width", ["1e-2", "1e-3", "1e-4", "1e-5", "1e-7"])
@pytest.mark.parametrize("gap", [0.0, 0.01])
def test_needles_keep_their_digits(width: str, gap: float, backend: str) -> None:
    mesh = soup(width)
    points, verts = (x.float() for x in near(mesh, gap)(torch.Generator().manual_seed(4), 100))
    exact = exact_distance(mesh.faces, points.double().numpy(), verts.double().numpy())
    hit = closest_point(points, verts, mesh.faces, backend=backend)
    size = float(verts.abs().max())
    assert (hit.distance.double() - torch.from_numpy(exact)).abs().max() < 3e-7 * size
    foot = (hit.bary[..., None] * verts[mesh.faces[hit.face]]).sum(1)
    assert ((points - foot).norm(dim=1) - hit.distance).abs().max() < 3e-7 * size
    assert (hit.bary >= -1e-3).all()
    torch.testing.assert_close(hit.bary.sum(1), torch.ones(100))


def test_gradients_of_needles() -> None:
    mesh = soup("1e-4")
    points, verts = near(mesh, 0.01)(torch.Generator().manual_seed(4), 40)
    slopes = []
    for dtype in (torch.float32, torch.float64):
        leaves = [x.float().to(dtype).requires_grad_() for x in (points, verts)]
        hit = closest_point(leaves[0], leaves[1], mesh.faces, backend="torch")
        slopes.append(torch.autograd.grad(hit.distance.sum(), leaves))
    for single, double in zip(*slopes, strict=True):
        assert single.isfinite().all()
        torch.testing.assert_close(single.double(), double, atol=2e-3, rtol=0)


def test_corners_that_coincide_have_finite_gradients() -> None:
    corners = torch.tensor([[[0.0, 0, 0]] * 3, [[0.0, 0, 0], [0, 0, 0], [1, 0, 0]]])
    points = torch.tensor([[0.5, 0.5, 0.0], [0.5, 0.5, 0.0]])
    corners.requires_grad_()
    bary = closest_on_triangle(points, corners)
    (slope,) = torch.autograd.grad((bary[..., None] * corners).sum(-2).square().sum(), corners)
    assert slope.isfinite().all()
    foot = (bary[..., None] * corners).sum(-2)
    torch.testing.assert_close(foot, torch.tensor([[0.0, 0, 0], [0.5, 0, 0]]))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_points_that_are_not_finite_spoil_nothing(bad: float, backend: str) -> None:
    mesh = ball(rings=4)
    verts = mesh.verts.float().requires_grad_()
    points = torch.tensor([[bad, 0.0, 0.0], [2.0, 0.1, 0.2]], requires_grad=True)
    hit = SurfaceIndex(verts, mesh.faces, backend).query(points)
    assert hit.found.tolist() == [False, True]
    assert hit.distance[0] == math.inf
    good = hit.distance[hit.found].sum()
    slopes = torch.autograd.grad(good, (points, verts))
    assert slopes[0].isfinite().all() and slopes[1].isfinite().all()
    assert torch.equal(slopes[0][0], torch.zeros(3))
    alone = torch.tensor([[2.0, 0.1, 0.2]])
    expected = closest_point(alone, verts.detach(), mesh.faces, backend=backend)
    torch.testing.assert_close(hit.distance[1:].detach(), expected.distance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_normals_without_area_are_zero(dtype: torch.dtype) -> None:
    mesh = soup("all degenerate")
    verts = mesh.verts.to(dtype).requires_grad_()
    normals = vertex_normals(verts, mesh.faces)
    assert torch.equal(normals, torch.zeros_like(normals))
    (slope,) = torch.autograd.grad(normals.sum(), verts)
    assert torch.equal(slope, torch.zeros_like(slope))
    whole = ball()
    lengths = vertex_normals(whole.verts.to(dtype) * 1e-6, whole.faces).norm(dim=1)
    torch.testing.assert_close(lengths, torch.ones_like(lengths))
