"""Symmetric meshes: one half tells the other where to cut and how to unfold."""

import numpy as np
import pytest
import torch

from monopart.geometry import uv_newton
from monopart.geometry.unwrap import unwrap
from monopart.geometry.uv_charts import Atlas, first_atlas
from monopart.geometry.uv_mesh import CutMesh
from monopart.geometry.uv_mirror import (
    chart_mates,
    extended,
    image_vertices,
    symmetric_edges,
    symmetric_start,
)
from monopart.geometry.uv_seams import Surface, edge_index


def _hill(crossed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A hill over a square, symmetric in x; some quads on the right may be split otherwise."""
    x, y = np.meshgrid(np.linspace(-1, 1, 13), np.linspace(0, 1.3, 9), indexing="ij")
    z = 0.5 * np.exp(-3 * (x**2 + (y - 0.6) ** 2)) + 0.2 * np.abs(x) * y
    verts = np.stack([x, y, z], -1).reshape(-1, 3)
    i, j = (a.reshape(-1) for a in np.meshgrid(np.arange(12), np.arange(8), indexing="ij"))
    p, q, r, s = i * 9 + j, i * 9 + 9 + j, i * 9 + 10 + j, i * 9 + 1 + j
    left = (i < 6) | ((i == 9) & (j < crossed))
    a = np.where(left[:, None], np.stack([p, q, r], 1), np.stack([p, q, s], 1))
    b = np.where(left[:, None], np.stack([p, r, s], 1), np.stack([q, r, s], 1))
    return verts, np.concatenate([a, b])


def _halves(verts: np.ndarray, faces: np.ndarray) -> tuple[Surface, CutMesh]:
    surface = Surface.of(verts, faces)
    right = verts[faces].mean(1)[:, 0] > 0
    return surface, CutMesh.of(surface.edges, surface.edges.seams_of_labels(right.astype(int)))


def _atlas(crossed: int) -> Atlas:
    surface, cut = _halves(*_hill(crossed))
    atlas = first_atlas(surface, cut.seams)
    # a start that is not symmetric: the reflection has to make it so
    return atlas.moved(atlas.uv * np.where(atlas.cut.vert_chart == 1, 1.3, 1.0)[:, None])


def test_images_of_vertices_lie_on_the_other_side() -> None:
    surface, cut = _halves(*_hill())
    mates = chart_mates(surface, cut)
    assert mates.tolist() == [1, 0]
    image, follows = image_vertices(surface, cut, mates)
    assert follows.tolist() == [False, True]
    some = cut.vert_chart == 1
    assert (image[some] >= 0).all() and (image[~some] < 0).all()
    places = surface.verts[cut.origin]
    np.testing.assert_allclose(places[image[some]] * [-1, 1, 1], places[some], atol=1e-12)


def test_one_of_two_mirrored_charts_is_relaxed_and_reflected() -> None:
    atlas = _atlas(0)
    relaxed = atlas.relaxed(30)
    image = atlas._image[0]
    some = image >= 0
    np.testing.assert_array_equal(relaxed.uv[some], relaxed.uv[image[some]] * [-1.0, 1.0])
    assert (relaxed.density > -1e-9).all() and np.isfinite(relaxed.density).all()
    np.testing.assert_allclose(relaxed.chart_excess[0], relaxed.chart_excess[1], rtol=1e-9)
    assert (relaxed.chart_excess < atlas.chart_excess).all()


@pytest.mark.parametrize("crossed", [1, 4])
def test_faces_without_an_image_are_laid_out_too(crossed: int) -> None:
    atlas = _atlas(crossed)
    assert (atlas.surface.corner_image < 0).any() and atlas._image[1].tolist() == [False, True]
    relaxed = atlas.relaxed(30)
    assert np.isfinite(relaxed.density).all()
    assert relaxed.chart_excess[1] <= 1.06 * relaxed.chart_excess[0] + 1e-3


def test_a_chart_cut_otherwise_than_its_image_is_relaxed_alone() -> None:
    surface, cut = _halves(*_hill())
    slit = edge_index(surface.edges, np.array([[81, 82], [82, 83]]))
    torn = CutMesh.of(surface.edges, cut.seams | np.isin(np.arange(len(cut.seams)), slit))
    assert torn.num_charts == 2
    follows = image_vertices(surface, torn, chart_mates(surface, torn))[1]
    whole = CutMesh.of(surface.edges, cut.seams)
    assert image_vertices(surface, whole, chart_mates(surface, whole))[1][1] and not follows.any()


def test_unknown_vertices_are_placed_by_the_shapes_around_them() -> None:
    verts, faces = _hill()
    flat = verts * [1.0, 1.0, 0.0]
    surface = Surface.of(flat, faces)
    cut = CutMesh.of(surface.edges, ~surface.edges.joinable)
    known = np.ones(len(cut.origin), bool)
    known[cut.faces[:5]] = False
    true = flat[cut.origin][:, :2]
    found = extended(surface, cut, np.where(known[:, None], true, 7.0), known)
    np.testing.assert_allclose(found, true, atol=1e-12)


def test_a_path_near_the_plane_becomes_one_on_it() -> None:
    surface = Surface.of(*_hill())
    cut = CutMesh.of(surface.edges, ~surface.edges.joinable)
    middle = np.arange(6 * 9, 7 * 9)
    # a bulge to the right, one quad wide
    path = np.concatenate([middle[:5], middle[4:6] + 9, middle[5:]])
    some = edge_index(surface.edges, np.sort(np.stack([path[:-1], path[1:]], 1), 1))
    straight = edge_index(surface.edges, np.stack([middle[:-1], middle[1:]], 1))
    assert len(some) == len(straight) + 2
    assert symmetric_edges(surface, cut, some).tolist() == straight.tolist()


def test_a_path_on_one_side_is_mirrored_to_the_other() -> None:
    surface = Surface.of(*_hill())
    cut = CutMesh.of(surface.edges, ~surface.edges.joinable)
    right = np.arange(9 * 9, 10 * 9)
    some = edge_index(surface.edges, np.stack([right[:-1], right[1:]], 1))
    both = symmetric_edges(surface, cut, some)
    assert len(both) == 2 * len(some) and set(some) < set(both)
    x = surface.verts[surface.edges.verts[both]][..., 0]
    np.testing.assert_allclose(np.abs(x), 0.5)


def test_the_first_slit_of_a_closed_mesh_is_its_own_image() -> None:
    x, y = np.meshgrid(np.arange(16), np.arange(1, 12), indexing="ij")
    a, b = 2 * np.pi * (x + 0.5) / 16, np.pi * y / 12
    ring = np.stack([1.7 * np.sin(b) * np.cos(a), np.cos(b), np.sin(b) * np.sin(a)], -1)
    verts = np.concatenate([ring.reshape(-1, 3), [[0, 1.0, 0], [0, -1.0, 0]]])
    p, q = (x * 11 + y - 1)[:, :-1].reshape(-1), ((x + 1) % 16 * 11 + y - 1)[:, :-1].reshape(-1)
    top = np.stack([np.full(16, 176), (x[:, 0] + 1) % 16 * 11, x[:, 0] * 11], 1)
    end = np.stack([np.full(16, 177), x[:, 0] * 11 + 10, (x[:, 0] + 1) % 16 * 11 + 10], 1)
    faces = [np.stack([p, q, q + 1], 1), np.stack([p, q + 1, p + 1], 1), top, end]
    surface = Surface.of(verts, np.concatenate(faces))
    assert surface.edges.joinable.all()
    seams = symmetric_start(surface, ~surface.edges.joinable)
    assert seams.any()
    assert (CutMesh.of(surface.edges, seams).euler == 1).all()


def test_one_thread_gives_what_two_give(monkeypatch: pytest.MonkeyPatch) -> None:
    verts, faces = _hill(2)
    mesh = torch.from_numpy(verts), torch.from_numpy(faces)
    monkeypatch.setattr(uv_newton, "_GROUP", 40)
    options = {"size": 256, "target": 4.02, "chart_share": 0.3}
    two = unwrap(*mesh, **options)
    monkeypatch.setattr(uv_newton, "_THREADS", 1)
    one = unwrap(*mesh, **options)
    assert two.report.charts > 2
    assert torch.equal(one.corner_uv, two.corner_uv) and torch.equal(one.charts, two.charts)
