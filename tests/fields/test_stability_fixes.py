"""What the stress of `monopart-bench stability` found in fields and memories stays mended."""

import pytest
import torch

from monopart.fields.fusion import attend
from monopart.fields.occupancy import visible_samples
from monopart.fields.part_field import PartField, PartFieldSpec
from monopart.fields.volume import composite
from monopart.geometry.errors import InputError
from monopart.geometry.parts import PartMap
from monopart.toolkit.memory import PoseMemory


def test_thousands_of_thin_samples_keep_their_digits() -> None:
    generator = torch.Generator().manual_seed(3)
    share = torch.rand(5, 4096, generator=generator)
    start = torch.tensor([0, 4096])
    found = []
    for kind, backend in ((torch.float32, "warp"), (torch.float64, "torch")):
        sigma = share[0].to(kind).requires_grad_()
        seen = composite(
            sigma, share[1:4].mT.to(kind), 1e-3 * share[4].to(kind), start, None, backend
        )
        (slope,) = torch.autograd.grad(seen.color[0, 0] - seen.color[0, 1], sigma)
        found.append((seen.opacity.detach().double(), slope.double()))
    (opacity, slope), (wanted, wanted_slope) = found
    assert float((opacity - wanted).abs().max()) < 1e-7
    assert float((slope - wanted_slope).abs().max() / wanted_slope.abs().max()) < 1e-5


def test_attention_is_the_same_where_all_scores_move_alike() -> None:
    generator = torch.Generator().manual_seed(4)
    query = torch.randn(8, 1, 4, generator=generator)
    keys, values = torch.randn(2, 1, 20, 1, 4, generator=generator)
    query[..., 0], keys[..., 0] = 1.0, 2.0**15
    leaves = [query.requires_grad_(), keys.requires_grad_(), values.requires_grad_()]
    found = []
    for kind, backend in ((torch.float32, "warp"), (torch.float64, "torch")):
        result = attend(*(x.to(kind) for x in leaves), (8,), backend)
        found.append(torch.autograd.grad(result[..., 1].sum(), leaves))
    for ours, wanted in zip(*found, strict=True):
        size = wanted[..., 1:].abs().max()
        assert float((ours - wanted)[..., 1:].abs().max() / size) < 2e-2


def test_attention_over_one_code_has_no_gradient_in_query_and_key() -> None:
    query, keys, values = torch.randn(5, 2, 8), torch.randn(1, 1, 2, 8), torch.randn(1, 1, 2, 8)
    leaves = [query.requires_grad_(), keys.requires_grad_(), values.requires_grad_()]
    result = attend(*leaves, (5,), "warp")
    of_query, of_keys, _ = torch.autograd.grad((result * torch.randn(5, 2, 8)).sum(), leaves)
    assert not of_query.any() and not of_keys.any()


def test_a_part_without_extent_is_refused() -> None:
    lo = torch.zeros(2, 3)
    with pytest.raises(InputError, match="extent"):
        PartField(lo, torch.tensor([[1.0, 1, 1], [0, 0, 0]]), PartFieldSpec())


def test_an_infinite_wall_hides_its_own_ray_alone() -> None:
    wall, ray = torch.tensor([torch.inf, 1.0, 1.0, torch.nan, 1.0]), torch.tensor([0, 0, 1, 1, 1])
    seen = visible_samples(wall, torch.tensor([0, 2, 5]), ray, 10.0)
    assert seen.tolist() == [True, False, True, True, True]


@pytest.mark.parametrize("by_part", [False, True])
def test_the_weights_of_a_pose_that_is_a_key_have_a_gradient(by_part: bool) -> None:
    poses = 0.3 * torch.randn(4, 24, 3, generator=torch.Generator().manual_seed(5))
    memory = PoseMemory.build((0, 1, 2, 3), poses, PartMap.default())
    pose = poses[2].clone().requires_grad_()
    weights = memory.parts.of_pose(None, pose)[1] if by_part else memory.weights(None, pose)[1]
    (gradient,) = torch.autograd.grad(weights.square().sum(), pose)
    assert gradient.isfinite().all()
