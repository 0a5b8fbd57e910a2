"""Lengths that can be differentiated at zero."""

import torch
from jaxtyping import Float
from torch import Tensor


def safe_norm(vectors: Float[Tensor, "*b d"]) -> Float[Tensor, "*b"]:
    """Length whose gradient at zero is zero instead of NaN; NaN stays NaN.

    Args:
        vectors: any vectors, along the last axis.

    Returns:
        Euclidean lengths in the unit of the vectors; differentiable.

    >>> safe_norm(torch.tensor([[3.0, 4.0], [0.0, 0.0]])).tolist()
    [5.0, 0.0]
    """
    square = vectors.square().sum(-1)
    zero = square == 0
    return torch.where(zero, 0.0, torch.where(zero, 1.0, square).sqrt())
