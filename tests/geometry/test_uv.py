"""Face-corner texture coordinates."""

import types

import pytest
import torch

from monopart.geometry.body import BodyModel
from monopart.geometry.uv import UVMap


def random_bary(*batch: int) -> torch.Tensor:
    bary = torch.rand(*batch, 3)
    return bary / bary.sum(-1, keepdim=True)


@pytest.mark.parametrize("batch", [(7,), (2, 3), (0,)])
def test_at_is_the_weighted_sum_of_the_corners_of_one_face(batch: tuple[int, ...]) -> None:
    uv = UVMap(torch.rand(5, 3, 2))
    face, bary = torch.randint(0, 5, batch), random_bary(*batch)
    found = uv.at(types.SimpleNamespace(face=face, bary=bary))
    assert found.shape == (*batch, 2)
    cases = (found.reshape(-1, 2), face.flatten(), bary.reshape(-1, 3))
    for out, f, b in zip(*cases, strict=True):
        expected = sum(b[c] * uv.corner_uv[f, c] for c in range(3))
        torch.testing.assert_close(out, expected)
    assert torch.equal(uv.at_faces(face, bary), found)


def test_seam_is_not_averaged() -> None:
    # two faces that share an edge in space, at opposite ends of the texture
    uv = UVMap(torch.tensor([[[0.9, 0], [1, 0], [1, 1]], [[0.0, 0], [0, 1], [0.1, 0]]]))
    edge = torch.tensor([[0.0, 0.5, 0.5], [0.5, 0.5, 0.0]])
    found = uv.at_faces(torch.tensor([0, 1]), edge)
    torch.testing.assert_close(found, torch.tensor([[1.0, 0.5], [0.0, 0.5]]))


def test_nothing_found_reads_a_finite_value() -> None:
    uv = UVMap(torch.rand(5, 3, 2))
    assert uv.at_faces(torch.tensor([-1]), torch.zeros(1, 3)).isfinite().all()


def test_gradients_in_bary_and_map() -> None:
    corner = torch.rand(4, 3, 2, dtype=torch.float64, requires_grad=True)
    bary = random_bary(6).double().requires_grad_()
    face = torch.tensor([0, 1, 1, 2, 0, 2])
    assert torch.autograd.gradcheck(lambda c, b: UVMap(c).at_faces(face, b), (corner, bary))


def test_default_body_has_a_map_within_the_unit_square() -> None:
    body = BodyModel.default()
    assert body.uv is not None
    assert body.uv.corner_uv.shape == (len(body.faces), 3, 2)
    assert body.uv.corner_uv.min() >= 0 and body.uv.corner_uv.max() <= 1
    assert body.uv.to(torch.zeros(1, dtype=torch.float64)).corner_uv.dtype == torch.float64
    # the body has seams: some vertex carries two coordinates
    flat_verts, flat_uv = body.faces.flatten(), body.uv.corner_uv.reshape(-1, 2)
    spread = torch.zeros(body.num_verts, 2).scatter_reduce(
        0, flat_verts[:, None].expand(-1, 2), flat_uv, "amax", include_self=False
    ) - torch.zeros(body.num_verts, 2).scatter_reduce(
        0, flat_verts[:, None].expand(-1, 2), flat_uv, "amin", include_self=False
    )
    assert (spread.amax(-1) > 0.01).any()
