"""Texels, gutters and look-up against plain loops."""

import math

import pytest
import torch
from torch import Tensor

from monopart.geometry.errors import InputError
from monopart.geometry.uv import UVMap
from monopart.geometry.uv_texture import fill_gutter, sample_texture, texel_map


def two_charts() -> UVMap:
    """A triangle in the left half of the texture and one in the right half."""
    return UVMap(
        torch.tensor(
            [[[0.05, 0.1], [0.45, 0.1], [0.05, 0.9]], [[0.55, 0.1], [0.95, 0.1], [0.95, 0.9]]]
        )
    )


def gutter_oracle(texture: Tensor, covered: Tensor, texels: int) -> Tensor:
    height, width, channels = texture.shape
    image = [[texture[i, j].tolist() for j in range(width)] for i in range(height)]
    known = covered.tolist()
    for _ in range(texels):
        before = [row[:] for row in known]
        old = [row[:] for row in image]
        for i in range(height):
            for j in range(width):
                near = [
                    old[a][b]
                    for a in range(max(0, i - 1), min(height, i + 2))
                    for b in range(max(0, j - 1), min(width, j + 2))
                    if before[a][b]
                ]
                if not before[i][j] and near:
                    image[i][j] = [sum(n[c] for n in near) / len(near) for c in range(channels)]
                    known[i][j] = True
    out = torch.zeros_like(texture)
    for i in range(height):
        for j in range(width):
            if known[i][j]:
                out[i, j] = torch.tensor(image[i][j], dtype=texture.dtype)
    return out


@pytest.mark.parametrize("texels", [0, 1, 3])
@pytest.mark.parametrize("shape", [(9, 7, 3), (1, 6, 1), (5, 1, 2)])
def test_gutter_is_that_of_a_plain_loop(shape: tuple[int, int, int], texels: int) -> None:
    texture = torch.rand(shape, dtype=torch.float64)
    covered = torch.rand(shape[:2]) < 0.2
    texture[~covered] = torch.nan  # what is not covered must not be read
    found = fill_gutter(texture, covered, texels)
    torch.testing.assert_close(found, gutter_oracle(texture, covered, texels))
    assert torch.equal(found[covered], texture[covered])


def test_gutter_gradients() -> None:
    covered = torch.tensor([[True, False, False], [False, False, False], [False, False, True]])
    texture = torch.rand(3, 3, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda t: fill_gutter(t, covered, 2), texture)


def test_gutter_of_nothing_and_wrong_sizes() -> None:
    assert fill_gutter(torch.zeros(0, 4, 3), torch.zeros(0, 4, dtype=torch.bool), 2).shape == (
        0,
        4,
        3,
    )
    none = torch.zeros(3, 3, dtype=torch.bool)
    assert (fill_gutter(torch.rand(3, 3, 1), none, 4) == 0).all()
    with pytest.raises(InputError, match="covered"):
        fill_gutter(torch.zeros(2, 2, 1), none, 1)
    with pytest.raises(InputError, match="texels"):
        fill_gutter(torch.zeros(3, 3, 1), none, -1)


def test_texels_show_the_point_at_their_middle() -> None:
    uv, size = two_charts(), 16
    texels = texel_map(uv, size)
    assert set(texels.face.unique().tolist()) == {-1, 0, 1}
    assert torch.equal(texels.covered, texels.face >= 0)
    assert abs(texels.covered.float().mean() - 0.32) < 0.05
    row, column = torch.nonzero(texels.covered, as_tuple=True)
    middle = torch.stack([column + 0.5, row + 0.5], -1) / size
    found = uv.at_faces(texels.face[row, column], texels.bary[row, column])
    torch.testing.assert_close(found, middle)
    # the same as a texture: row 0 is at v = 0
    image = texels.of_corners(uv.corner_uv)
    torch.testing.assert_close(image[row, column], middle)
    assert (image[~texels.covered] == 0).all()


def test_texture_of_corner_values_has_gradients() -> None:
    texels = texel_map(UVMap(two_charts().corner_uv.double()), 5)
    values = torch.rand(2, 3, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(texels.of_corners, values)


def test_a_texture_without_texels_or_faces() -> None:
    with pytest.raises(InputError, match="size"):
        texel_map(two_charts(), 0)
    assert (texel_map(UVMap(torch.zeros(0, 3, 2)), 3).face == -1).all()


def sample_oracle(texture: Tensor, uv: Tensor, chart: Tensor, texel_chart: Tensor) -> Tensor:
    height, width, channels = texture.shape
    out = torch.zeros(len(uv), channels, dtype=texture.dtype)
    for n, (u, v) in enumerate(uv.tolist()):
        x, y = u * width - 0.5, v * height - 0.5
        total, weight = torch.zeros(channels, dtype=texture.dtype), 0.0
        for i in (math.floor(y), math.floor(y) + 1):
            for j in (math.floor(x), math.floor(x) + 1):
                row, column = min(max(i, 0), height - 1), min(max(j, 0), width - 1)
                if texel_chart[row, column] == chart[n] and chart[n] >= 0:
                    share = (1 - abs(x - j)) * (1 - abs(y - i))
                    total, weight = total + share * texture[row, column], weight + share
        if weight > 0:
            out[n] = total / weight
    return out


def test_look_up_is_that_of_a_plain_loop() -> None:
    texture = torch.rand(6, 5, 3, dtype=torch.float64)
    texel_chart = torch.randint(-1, 2, (6, 5))
    uv = torch.rand(200, 2, dtype=torch.float64)
    uv[:4] = torch.tensor([[0.0, 0], [1, 1], [0, 1], [1, 0]])
    chart = torch.randint(-1, 2, (200,))
    found = sample_texture(texture, uv, chart, texel_chart)
    torch.testing.assert_close(found, sample_oracle(texture, uv, chart, texel_chart))
    assert (found[chart < 0] == 0).all()


def test_look_up_and_its_gradient_do_not_blend_charts() -> None:
    # chart 0 left, chart 1 right, without a gap
    texel_chart = torch.tensor([[0, 0, 1, 1]] * 4)
    texture = torch.where(texel_chart == 0, 1.0, 100.0)[..., None].double().requires_grad_()
    uv = torch.tensor([[0.49, 0.5], [0.51, 0.5]], dtype=torch.float64, requires_grad=True)
    found = sample_texture(texture, uv, torch.tensor([0, 1]), texel_chart)
    torch.testing.assert_close(found[:, 0], torch.tensor([1.0, 100.0]).double())
    found[0].sum().backward()
    assert texture.grad is not None and uv.grad is not None
    assert (texture.grad[texel_chart == 1] == 0).all()
    assert texture.grad[texel_chart == 0].sum().item() == pytest.approx(1.0)
    assert (uv.grad.abs() < 1e-9).all()  # nothing of the jump of 99 at the seam


def test_look_up_gradients() -> None:
    texel_chart = torch.tensor([[0, 0, 1], [0, 1, 1], [0, 0, 1]])
    texture = torch.rand(3, 3, 2, dtype=torch.float64, requires_grad=True)
    uv = (torch.rand(12, 2, dtype=torch.float64) * 0.9 + 0.03).requires_grad_()
    chart = torch.arange(12) % 2
    assert torch.autograd.gradcheck(
        lambda t, p: sample_texture(t, p, chart, texel_chart), (texture, uv)
    )


def test_a_smooth_texture_comes_back_across_the_whole_chart() -> None:
    uv, size = UVMap(two_charts().corner_uv.double()), 32
    texels = texel_map(uv, size)
    values = uv.corner_uv.clone()
    values[1] = 5 - values[1]  # the charts disagree
    image = texels.of_corners(values)
    bary = torch.rand(60, 3, dtype=torch.float64) + 0.2
    bary = bary / bary.sum(-1, keepdim=True)
    face = torch.arange(60) % 2
    found = sample_texture(image, uv.at_faces(face, bary), face, texels.face)
    torch.testing.assert_close(found, UVMap(values).at_faces(face, bary))


def test_look_up_of_nothing_and_wrong_sizes() -> None:
    texture, charts = torch.rand(2, 2, 3), torch.zeros(2, 2, dtype=torch.int64)
    none = torch.zeros(0, dtype=torch.int64)
    assert sample_texture(texture, torch.zeros(0, 2), none, charts).shape == (0, 3)
    with pytest.raises(InputError, match="texel_chart"):
        sample_texture(texture, torch.zeros(0, 2), none, charts[:1])
    with pytest.raises(InputError, match="texture"):
        sample_texture(texture[:0], torch.zeros(0, 2), none, charts[:0])
