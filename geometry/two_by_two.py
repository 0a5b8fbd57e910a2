"""Linear systems of two equations, batched, without a library call per system."""

import torch
from jaxtyping import Float
from torch import Tensor


def solve_two_by_two(
    matrix: Float[Tensor, "*b 2 2"], right: Float[Tensor, "*b 2"]
) -> Float[Tensor, "*b 2"]:
    """Solves matrix · x = right by Cramer's rule.

    Args:
        matrix: *b 2 2.
        right: *b 2.

    Returns:
        x, *b 2, differentiable in both; finite, without meaning, where the matrix is singular.

    >>> solve_two_by_two(torch.tensor([[2.0, 0.0], [0.0, 4.0]]), torch.ones(2)).tolist()
    [0.5, 0.25]
    """
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    x, y = right.unbind(-1)
    det = a * d - b * c
    tiny = torch.finfo(matrix.dtype).eps ** 2
    safe = torch.where(det.abs() > tiny, det, torch.full_like(det, tiny))
    return torch.stack([d * x - b * y, a * y - c * x], -1) / safe[..., None]
