"""The union of parts: at every sample the part of largest density speaks (MonoPartNeRF, eq. 8)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from monopart.geometry.parts import rows_of_parts


@dataclass(frozen=True)
class Union:
    """Density of samples and the pairs that own them.

    Attributes:
        sigma: [N] density, 1/m; 0 for a sample without a pair.
        winner: [W] int64 rows of the pairs that won, ascending: the parts stay sorted.
        counts: winners of each part.
    """

    sigma: Float[Tensor, "n"]
    winner: Int[Tensor, "w"]
    counts: tuple[int, ...]


def union_by_density(
    sigma: Float[Tensor, "m"],
    sample: Int[Tensor, "m"],
    part: Int[Tensor, "m"],
    num_samples: int,
    num_parts: int,
) -> Union:
    """Keep the densest part of each sample; equal densities go to the first part.

    Only winners need a colour: skipping the others is exact.

    Args:
        sigma: density of each (sample, part) pair, 1/m.
        sample: sample of each pair.
        part: part of each pair, ascending; a (sample, part) occurs once.
        num_samples: number of samples.
        num_parts: number of parts.

    Returns:
        The union, differentiable in sigma; NaN where a density of the sample is NaN.

    >>> s = torch.tensor([1.0, 5.0, 3.0])
    >>> out = union_by_density(s, torch.tensor([0, 1, 0]), torch.tensor([0, 0, 1]), 3, 2)
    >>> out.sigma.tolist(), out.winner.tolist()
    ([3.0, 5.0, 0.0], [1, 2])
    """
    rows = torch.arange(len(sigma), device=sigma.device)
    with torch.no_grad():
        table = torch.full((num_parts, num_samples), -1.0, dtype=sigma.dtype, device=sigma.device)
        table[part, sample] = sigma
        best, value = sample.new_zeros(num_samples), table[0]
        for k in range(1, num_parts):  # K passes beat argmax over a short leading axis
            better = ~(table[k] <= value) & ~value.isnan()  # the first of equals; NaN is kept
            best = torch.where(better, k, best)
            value = torch.where(better, table[k], value)
        won = best[sample] == part
    winner = rows[won]
    total = torch.zeros(num_samples, dtype=sigma.dtype, device=sigma.device)
    total = total.index_copy(0, sample[winner], sigma[winner])
    return Union(total, winner, rows_of_parts(part[winner], num_parts))
