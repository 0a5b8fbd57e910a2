"""From the texture back to the surface, and a map brought from mesh to mesh."""

import igl
import numpy as np
import pytest
import torch
from torch import Tensor

from monopart.geometry.body import BodyModel
from monopart.geometry.errors import InputError
from monopart.geometry.unwrap import UVLayout, unwrap
from monopart.geometry.uv import UVMap
from monopart.geometry.uv_lookup import UVIndex, transfer_uv
from monopart.geometry.uv_overlap import face_signs, overlapping_pairs


def ball(rounds: int) -> tuple[Tensor, Tensor]:
    verts, faces = igl.icosahedron()
    for _ in range(rounds):
        verts, faces = igl.upsample(verts, faces)
    verts = np.asarray(verts) / np.linalg.norm(verts, axis=1, keepdims=True)
    return torch.tensor(verts, dtype=torch.float32), torch.tensor(np.asarray(faces)).long()


@pytest.fixture(scope="module")
def layout() -> tuple[Tensor, Tensor, UVLayout]:
    verts, faces = ball(2)
    return verts, faces, unwrap(verts, faces, size=256, target=4.3)


def bary_of(count: int) -> Tensor:
    bary = torch.rand(count, 3, dtype=torch.float64) + 0.05
    return bary / bary.sum(-1, keepdim=True)


def strip() -> tuple[Tensor, Tensor, UVMap]:
    """A flat strip of 4 × 1 squares; its map is the plane times 0.2, cut at x = 2."""
    x, y = torch.meshgrid(torch.arange(5.0), torch.arange(2.0), indexing="ij")
    verts = torch.stack([x, y, 0 * x], -1).reshape(-1, 3)
    low = torch.arange(4) * 2
    faces = torch.cat(
        [torch.stack([low, low + 2, low + 3], 1), torch.stack([low, low + 3, low + 1], 1)]
    )
    corner = verts[faces][..., :2] * 0.2
    right = verts[faces].mean(1)[:, 0] > 2
    # the right half lies above the left one
    corner[right] += torch.tensor([-0.4, 0.5])
    return verts, faces, UVMap(corner)


def naive(corner: Tensor, point: Tensor) -> int:
    for face, (a, b, c) in enumerate(corner.double().tolist()):
        px, py = point.double().tolist()
        areas = [
            (q[0] - p[0]) * (py - p[1]) - (q[1] - p[1]) * (px - p[0])
            for p, q in ((a, b), (b, c), (c, a))
        ]
        if min(areas) > 0 or max(areas) < 0:
            return face
    return -1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_round_trip_on_the_default_body(dtype: torch.dtype) -> None:
    body = BodyModel.default()
    assert body.uv is not None
    uv = body.uv.to(torch.zeros(1, dtype=dtype))
    verts, corner = body.v_template.to(dtype), body.uv.corner_uv.double().numpy()
    good = np.ones(len(corner), bool)
    good[face_signs(corner) == 0] = False
    good[overlapping_pairs(corner).reshape(-1)] = False
    assert good.mean() > 0.99
    face = torch.from_numpy(np.flatnonzero(good))
    bary = bary_of(len(face)).to(dtype)
    hit = UVIndex(uv).locate(uv.at_faces(face, bary))
    assert hit.found.all() and torch.equal(hit.face, face)
    expected = (bary[..., None] * verts[body.faces[face]]).sum(-2)
    assert (hit.point(verts, body.faces) - expected).norm(dim=-1).max() <= 1e-5


def test_round_trip_on_an_unwrapped_mesh(layout: tuple[Tensor, Tensor, UVLayout]) -> None:
    verts, faces, found = layout
    face = torch.arange(len(faces))
    bary = bary_of(len(faces)).float()
    hit = UVIndex(found.uv).locate(found.uv.at_faces(face, bary))
    assert torch.equal(hit.face, face)
    expected = (bary[..., None] * verts[faces]).sum(-2)
    assert (hit.point(verts, faces) - expected).norm(dim=-1).max() <= 1e-5
    # and back to the texture
    points = torch.rand(500, 2)
    hit = UVIndex(found.uv).locate(points)
    assert 0.1 < hit.found.float().mean() < 1
    back = found.uv.at(hit)
    torch.testing.assert_close(back[hit.found], points[hit.found], rtol=0, atol=1e-6)


@pytest.mark.parametrize("cells", [None, 1, 3, 200])
def test_locate_is_the_search_through_all_faces(
    cells: int | None, layout: tuple[Tensor, Tensor, UVLayout]
) -> None:
    uv = layout[2].uv
    points = torch.rand(120, 2, dtype=torch.float64)
    hit = UVIndex(uv, cells).locate(points)
    assert hit.face.tolist() == [naive(uv.corner_uv, p) for p in points]
    assert torch.equal(hit.found, hit.face >= 0)
    assert (hit.bary[~hit.found] == 0).all()


def test_locate_many_points_goes_in_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    index, points = UVIndex(strip()[2]), torch.rand(50, 2)
    whole = index.locate(points).face
    monkeypatch.setattr("monopart.geometry.uv_lookup._CHUNK", 7)
    assert torch.equal(index.locate(points).face, whole)


def test_gradients_of_locate_in_points_and_map() -> None:
    corner = strip()[2].corner_uv.double().requires_grad_()
    points = torch.tensor([[0.1, 0.05], [0.33, 0.12], [0.05, 0.6], [0.95, 0.95]]).double()
    points.requires_grad_()

    def bary(p: Tensor, c: Tensor) -> Tensor:
        return UVIndex(UVMap(c)).locate(p).bary

    assert UVIndex(UVMap(corner)).locate(points).found.tolist() == [True, True, True, False]
    assert torch.autograd.gradcheck(bary, (points, corner))


def test_gradients_stay_finite_where_nothing_is_found() -> None:
    verts, faces, uv = strip()
    corner = uv.corner_uv.clone().requires_grad_()
    points = torch.tensor([[torch.nan, 0.5], [0.9, 0.9], [2.0, 2.0], [0.1, 0.05]])
    hit = UVIndex(UVMap(corner)).locate(points)
    assert hit.found.tolist() == [False, False, False, True]
    found = hit.point(verts, faces)
    assert (found[:3] == 0).all()
    found.sum().backward()
    assert corner.grad is not None and corner.grad.isfinite().all()


def test_faces_without_area_are_never_found() -> None:
    corner = torch.tensor([[[0.0, 0], [0.5, 0.5], [1, 1]], [[0.0, 0], [1, 0], [1, 1]]])
    hit = UVIndex(UVMap(corner)).locate(torch.tensor([[0.75, 0.5], [0.5, 0.5]]))
    assert hit.face.tolist() == [1, 1]


def test_nothing_to_look_up_or_to_look_up_in() -> None:
    index = UVIndex(strip()[2])
    none = index.locate(torch.zeros(0, 2))
    assert none.face.shape == (0,) and none.bary.shape == (0, 3)
    empty = UVIndex(UVMap(torch.zeros(0, 3, 2))).locate(torch.rand(3, 2))
    assert empty.face.tolist() == [-1] * 3 and not empty.found.any()
    assert empty.bary.shape == (3, 3)


def test_wrong_maps_are_named() -> None:
    with pytest.raises(InputError, match="finite"):
        UVIndex(UVMap(torch.full((1, 3, 2), torch.nan)))
    with pytest.raises(InputError, match="cells"):
        UVIndex(strip()[2], 0)


def test_transfer_to_the_same_mesh_changes_nothing(
    layout: tuple[Tensor, Tensor, UVLayout],
) -> None:
    verts, faces, found = layout
    again = transfer_uv(verts, faces, found.uv, verts, faces)
    torch.testing.assert_close(again.corner_uv, found.corner_uv, rtol=0, atol=1e-5)
    # another order of faces and corners
    order = torch.randperm(len(faces))
    turned = faces[order].roll(1, 1)
    again = transfer_uv(verts, faces, found.uv, verts, turned)
    expected = found.corner_uv[order].roll(1, 1)
    torch.testing.assert_close(again.corner_uv, expected, rtol=0, atol=1e-5)


def test_transfer_to_a_finer_mesh_keeps_to_charts(
    layout: tuple[Tensor, Tensor, UVLayout],
) -> None:
    verts, faces, found = layout
    fine, small = igl.upsample(verts.double().numpy(), faces.numpy())
    new = torch.tensor(np.asarray(fine)).float()
    new_faces = torch.tensor(np.asarray(small)).long()
    again = transfer_uv(verts, faces, found.uv, new, new_faces)
    # each small face lies in one large one, so its map is that of the large one
    at = UVIndex(found.uv).locate(again.corner_uv.mean(1))
    assert at.found.all()
    middle = new[new_faces].mean(1)
    assert (at.point(verts, faces) - middle).norm(dim=-1).max() < 1e-5
    assert (face_signs(again.corner_uv.double().numpy()) == 1).all()


def test_transfer_does_not_stretch_a_face_over_a_seam() -> None:
    verts, faces, uv = strip()
    # one large face, its middle left of the seam at x = 2, and one right of it
    new = torch.tensor([[0.0, 0, 0], [3, 0, 0], [0, 1, 0], [4, 0, 0], [4, 1, 0]])
    new_faces = torch.tensor([[0, 1, 2], [1, 3, 4]])
    found = transfer_uv(verts, faces, uv, new, new_faces).corner_uv
    expected = new[new_faces][..., :2] * 0.2
    expected[1] += torch.tensor([-0.4, 0.5])
    torch.testing.assert_close(found, expected)


def test_transfer_over_a_seam_of_a_chart_with_itself() -> None:
    # a tube cut open along one line is one chart that meets itself
    sides = 16
    turn = torch.arange(sides + 1) % sides * (2 * torch.pi / sides)
    ring = torch.stack([turn.cos(), turn.sin()], -1)[:sides]
    verts = torch.cat([torch.cat([ring, torch.full((sides, 1), z)], 1) for z in (0.0, 0.5)])
    i = torch.arange(sides)
    j = (i + 1) % sides
    faces = torch.cat(
        [torch.stack([i, j, j + sides], 1), torch.stack([i, j + sides, i + sides], 1)]
    )
    u, step = i / sides, 1 / sides
    low, high = torch.zeros(sides), torch.full((sides,), 0.4)
    quad = [torch.stack(p, -1) for p in ((u, low), (u + step, low), (u + step, high), (u, high))]
    corner = torch.cat([torch.stack([quad[k] for k in t], 1) for t in ((0, 1, 2), (0, 2, 3))])
    uv = UVMap(corner)
    same = transfer_uv(verts, faces, uv, verts, faces).corner_uv
    torch.testing.assert_close(same, corner, rtol=0, atol=1e-5)
    # turned by a third of a side, one square of the new mesh lies across the seam
    angle = torch.tensor(2 * torch.pi / sides / 3)
    spin = torch.tensor([[angle.cos(), -angle.sin(), 0], [angle.sin(), angle.cos(), 0], [0, 0, 1]])
    moved = transfer_uv(verts, faces, uv, verts @ spin.T, faces).corner_uv
    length = (moved.roll(1, 1) - moved).norm(dim=-1).amax(1)
    assert length.max() < 1.2 * (corner.roll(1, 1) - corner).norm(dim=-1).max()


def test_transfer_of_nothing_and_wrong_maps() -> None:
    verts, faces, uv = strip()
    none = transfer_uv(verts, faces, uv, verts, faces[:0])
    assert none.corner_uv.shape == (0, 3, 2)
    with pytest.raises(InputError, match="uv"):
        transfer_uv(verts, faces[1:], uv, verts, faces)
    with pytest.raises(InputError, match="faces"):
        transfer_uv(verts, faces[:0], UVMap(uv.corner_uv[:0]), verts, faces)
