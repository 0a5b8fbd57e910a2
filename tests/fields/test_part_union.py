"""The union of parts against a loop."""

import pytest
import torch

from monopart.fields.part_union import union_by_density


def loop(
    sigma: list[float], sample: list[int], part: list[int], samples: int, parts: int
) -> tuple[list[float], list[int], tuple[int, ...]]:
    """Per sample the first of the densest pairs, in the order of parts."""
    total, winners = [0.0] * samples, []
    for s in range(samples):
        rows = sorted((r for r in range(len(sigma)) if sample[r] == s), key=lambda r: part[r])
        if rows:
            best = rows[0]
            for row in rows[1:]:
                if sigma[row] > sigma[best]:
                    best = row
            total[s] = sigma[best]
            winners.append(best)
    winners.sort()
    counts = tuple(sum(part[w] == k for w in winners) for k in range(parts))
    return total, winners, counts


def random_pairs(samples: int, parts: int, share: float) -> tuple[torch.Tensor, torch.Tensor]:
    part, sample = torch.nonzero(torch.rand(parts, samples) < share, as_tuple=True)
    return sample, part


@pytest.mark.parametrize("parts", [1, 2, 5])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("levels", [3, 10**6])  # few levels: many ties, zeros among them
def test_against_the_loop(parts: int, share: float, levels: int) -> None:
    sample, part = random_pairs(60, parts, share)
    sigma = torch.randint(levels, (len(part),)).double() / levels
    found = union_by_density(sigma, sample, part, 60, parts)
    total, winners, counts = loop(sigma.tolist(), sample.tolist(), part.tolist(), 60, parts)
    assert found.sigma.tolist() == total
    assert found.winner.tolist() == winners
    assert found.counts == counts
    assert found.sigma.dtype == torch.float64 and found.winner.dtype == torch.int64


def test_equal_densities_go_to_the_first_part() -> None:
    sample, part = torch.tensor([0, 0, 0]), torch.tensor([1, 2, 4])
    found = union_by_density(torch.tensor([2.0, 2.0, 2.0]), sample, part, 1, 5)
    assert found.winner.tolist() == [0] and found.counts == (0, 1, 0, 0, 0)
    zero = union_by_density(torch.zeros(3), sample, part, 1, 5)
    assert zero.winner.tolist() == [0] and zero.sigma.tolist() == [0.0]


def test_no_pairs_and_no_samples() -> None:
    none = torch.zeros(0, dtype=torch.int64)
    found = union_by_density(torch.zeros(0), none, none, 4, 3)
    assert found.sigma.tolist() == [0.0] * 4 and found.counts == (0, 0, 0)
    assert union_by_density(torch.zeros(0), none, none, 0, 3).sigma.shape == (0,)


def test_only_winners_get_a_gradient() -> None:
    sample, part = random_pairs(40, 4, 0.6)
    sigma = torch.rand(len(part), requires_grad=True)
    found = union_by_density(sigma, sample, part, 40, 4)
    weight = torch.rand(40)
    (found.sigma * weight).sum().backward()
    expected = torch.zeros(len(part))
    expected[found.winner] = weight[sample[found.winner]]
    assert sigma.grad is not None
    assert torch.equal(sigma.grad, expected)
    assert 0 < len(found.winner) < len(part)


@pytest.mark.parametrize("row", [0, 1, 2])
def test_a_density_that_is_not_a_number_is_not_lost(row: int) -> None:
    sigma = torch.tensor([1.0, 2.0, 3.0])
    sigma[row] = torch.nan
    sample, part = torch.tensor([0, 0, 0]), torch.tensor([0, 2, 3])
    found = union_by_density(sigma, sample, part, 2, 5)
    assert found.sigma[0].isnan() and found.sigma[1] == 0
    assert found.winner.tolist() == [row]
