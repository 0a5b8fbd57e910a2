"""How far round trips end from where they began, over a training: figures and histograms."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

EDGES_MM = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 14.0, 20.0, 30.0, 50.0, 100.0)
"""Lower edges of the bins, millimetres; the last bin has no end."""
QUANTILES = {"median": 0.5, "p90": 0.9, "p99": 0.99}
MOMENTS = 5  # histograms of a run, beside the one at its end


def figures(distance: Float[Tensor, "n"], threshold: float) -> dict[str, Any]:
    """Share of round trips that the consistency loss acts on, and quantiles of their distances.

    Args:
        distance: round-trip distances, metres.
        threshold: distances that cost nothing, metres.

    Returns:
        "share", and the "median", "p90" and "p99" in metres; None of no distance.

    >>> figures(torch.tensor([0.0, 0.02]), 0.01)["share"]
    0.5
    """
    if not len(distance):
        return {"share": None, **dict.fromkeys(QUANTILES)}
    known = distance.detach().double()
    at = torch.quantile(known, known.new_tensor(list(QUANTILES.values()))).tolist()
    share = float((known > threshold).double().mean())
    return {"share": share, **dict(zip(QUANTILES, at, strict=True))}


def histogram(distance: Float[Tensor, "n"]) -> list[float]:
    """Part of the distances in each bin of `EDGES_MM`.

    Args:
        distance: round-trip distances, metres.

    Returns:
        Numbers that sum to 1; zeros of no distance.
    """
    edges = distance.new_tensor(EDGES_MM[1:]) / 1e3
    bins = torch.bucketize(distance.detach(), edges, right=True)
    counts = torch.bincount(bins, minlength=len(EDGES_MM)).double()
    return (counts / max(len(distance), 1)).tolist()


def moment(distance: Float[Tensor, "n"], threshold: float, iteration: int) -> dict[str, Any]:
    """One entry of a run's record.

    Args:
        distance: round-trip distances of a step, metres.
        threshold: see :func:`figures`.
        iteration: steps taken.
    """
    return {
        "iteration": iteration,
        **figures(distance, threshold),
        "histogram": histogram(distance),
    }
