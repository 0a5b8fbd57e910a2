"""Lengths and directions that can be differentiated at zero, and taken of any finite vector."""

import math

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


def brought_to_one(vectors: Float[Tensor, "*b d"]) -> Float[Tensor, "*b d"]:
    """Vectors of the same direction and of a length near one, whose squares can be summed.

    Args:
        vectors: any vectors, along the last axis.

    Returns:
        The vectors times a power of two that is held, so that no digit changes and a function of
        the direction alone has its gradient; zero and what is not finite stay.

    >>> brought_to_one(torch.tensor([[3.0, -6.0], [0.0, 0.0]])).tolist()
    [[0.375, -0.75], [0.0, 0.0]]
    """
    largest = vectors.detach().abs().amax(-1, keepdim=True)
    usable = (largest > 0) & largest.isfinite()
    _, exponent = torch.frexp(torch.where(usable, largest, torch.ones_like(largest)))
    limit = math.frexp(torch.finfo(vectors.dtype).max)[1] - 3  # whose power of two is a number
    # torch.ldexp(vectors, …) itself has a wrong gradient for negative integers (torch 2.13)
    return vectors * torch.ldexp(torch.ones_like(largest), -exponent.clamp(-limit, limit))
