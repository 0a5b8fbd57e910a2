"""The 8-wide face trees: every face has a place, and searches find what brute force finds."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from monopart.geometry.errors import InputError
from monopart.geometry.face_tree import FaceTrees
from monopart.geometry.surface import SurfaceIndex


def soup(faces: int, seed: int, spread: float = 1.0) -> tuple[Tensor, Tensor]:
    """Small triangles at random places."""
    generator = torch.Generator().manual_seed(seed)
    centre = spread * torch.randn(faces, 1, 3, generator=generator)
    corners = centre + 0.1 * spread * torch.randn(faces, 3, 3, generator=generator)
    return corners.reshape(-1, 3), torch.arange(3 * faces).reshape(-1, 3)


@pytest.mark.parametrize("count", [1, 7, 8, 9, 16, 17, 63, 65, 200, 513, 1025])
def test_every_face_has_one_place(count: int) -> None:
    verts, faces = soup(count, 0)
    tree = FaceTrees(verts[None], faces)
    slots = tree.slots[tree.slots >= 0]
    assert torch.equal(slots.sort().values, torch.arange(count, dtype=torch.int32))
    assert torch.equal(tree.slots[tree.places.long()], torch.arange(count, dtype=torch.int32))


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 300), st.integers(0, 10_000), st.sampled_from([1e-3, 1.0, 1e3]))
def test_the_search_is_exhaustive(count: int, seed: int, spread: float) -> None:
    verts, faces = soup(count, seed, spread)
    points = 1.5 * spread * torch.randn(50, 3, generator=torch.Generator().manual_seed(seed + 1))
    fast = SurfaceIndex(verts, faces, "warp").query(points)
    slow = SurfaceIndex(verts.double(), faces, "torch").query(points.double())
    assert (fast.distance - slow.distance).abs().max() <= 2e-6 * spread
    assert fast.found.all()


def test_without_and_with_gradients_the_hits_agree() -> None:
    verts, faces = soup(300, 3)
    index = SurfaceIndex(verts, faces, "warp")
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(4))
    plain = index.query(points, 0.3)
    traced = index.query(points.clone().requires_grad_(), 0.3)
    assert torch.equal(plain.found, traced.found)
    assert torch.equal(plain.face, traced.face)
    for name in ("bary", "point"):
        gap = (getattr(plain, name) - getattr(traced, name))[plain.found].abs().max()
        assert gap < 2e-5, name  # barycentrics of slivers; points agree far better
    assert (plain.point - traced.point)[plain.found].abs().max() < 1e-6
    assert (plain.distance - traced.distance)[plain.found].abs().max() < 1e-6
    assert plain.distance[~plain.found].isinf().all()


def test_refit_follows_the_vertices() -> None:
    verts, faces = soup(400, 5)
    moved = verts @ torch.linalg.qr(torch.randn(3, 3))[0] + 3.0
    index = SurfaceIndex(verts, faces, "warp")
    index.refit(moved)
    points = moved[::7] + 0.05
    fresh = SurfaceIndex(moved, faces, "warp").query(points)
    assert torch.equal(index.query(points).distance, fresh.distance)


def test_groups_and_bodies_have_trees_of_their_own() -> None:
    verts, faces = soup(120, 6)
    bodies = torch.stack([verts, verts + 10.0, verts * 0.5])
    group = torch.arange(120) % 3
    trees = FaceTrees(bodies, faces, group, num_groups=5)  # two groups have no face
    assert [n > 0 for n in trees.leaves] == [True, True, True, False, False]
    assert trees.layout[3:, 4].tolist() == [-1, -1]
    for k in range(3):
        first = int(trees.layout[k, 5])
        places = trees.slots[first : first + 8 * trees.leaves[k]]
        assert set(places[places >= 0].tolist()) == set(torch.nonzero(group == k)[:, 0].tolist())


def test_a_degenerate_face_alone_is_found() -> None:
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    hit = SurfaceIndex(verts, torch.tensor([[0, 1, 2]]), "warp").query(torch.tensor([[1.5, 1, 0]]))
    assert hit.found.all()
    assert torch.allclose(hit.distance, torch.ones(1))


def test_points_that_are_not_numbers_are_not_found() -> None:
    verts, faces = soup(30, 8)
    points = torch.tensor([[torch.nan, 0, 0], [torch.inf, 0, 0], [0, 0, 0]])
    hit = SurfaceIndex(verts, faces, "warp").query(points)
    assert hit.found.tolist() == [False, False, True]


def test_no_body_is_an_error() -> None:
    with pytest.raises(InputError, match="at least one body"):
        FaceTrees(torch.zeros(0, 3, 3), torch.tensor([[0, 1, 2]]))
