"""Small networks, one per part, over rows that are grouped by part."""

import itertools
import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from monopart.geometry.errors import InputError


class PartMLP(torch.nn.Module):
    """K independent MLPs with ReLU between the layers and none after the last.

    Rows are sorted by part, so that a part is one slice and one matrix product per layer.

    Attributes:
        weights: per layer [K, out, in].
        biases: per layer [K, out].
        compute: type in which the products are taken, such as ``torch.float16``; None is that of
            the parameters. The result has the type of the input.

    >>> mlp = PartMLP(2, (3, 16, 4), zero_last=True)
    >>> mlp(torch.rand(5, 3), (2, 3)).abs().max().item()
    0.0
    """

    def __init__(
        self,
        parts: int,
        widths: Sequence[int],
        zero_last: bool = False,
        generator: torch.Generator | None = None,
    ):
        """Make the layers, initialised like ``torch.nn.Linear``.

        Args:
            parts: number of parts, K.
            widths: input, hidden and output widths; at least two.
            zero_last: start with an output of exactly zero.
            generator: source of the initial values; the global one if None.

        Raises:
            InputError: no part, fewer than two widths or a width below 1.
        """
        super().__init__()
        widths = tuple(widths)
        if parts < 1 or len(widths) < 2 or min(widths) < 1:
            raise InputError(
                f"PartMLP: expected parts ≥ 1 and two or more widths ≥ 1, found {parts}, {widths}"
            )
        self.parts = parts
        self.widths = widths
        self.compute: torch.dtype | None = None
        self.weights = torch.nn.ParameterList()
        self.biases = torch.nn.ParameterList()
        for fan_in, fan_out in itertools.pairwise(widths):
            bound = 1 / math.sqrt(fan_in)
            for store, shape in (
                (self.weights, (parts, fan_out, fan_in)),
                (self.biases, (parts, fan_out)),
            ):
                values = torch.rand(shape, generator=generator)
                store.append(torch.nn.Parameter((values * 2 - 1) * bound))
        if zero_last:
            torch.nn.init.zeros_(self.weights[-1])
            torch.nn.init.zeros_(self.biases[-1])

    def extra_repr(self) -> str:
        """Sizes for ``print(module)``."""
        return f"parts={self.parts}, widths={self.widths}"

    def forward(
        self, x: Float[Tensor, "n in"], counts: Sequence[int] | None = None
    ) -> Float[Tensor, "n out"]:
        """Run each part's network on its rows.

        Args:
            x: [N, in] rows grouped by part, parts in ascending order.
            counts: rows of each part, K numbers that add up to N; None only for one part.

        Returns:
            [N, out]; differentiable in x and the parameters. A part without rows costs nothing
            and gets a gradient of zero.

        Raises:
            InputError: counts that do not fit.
        """
        counts = self._check_counts(x, counts)
        weights, biases, kind = list(self.weights), list(self.biases), x.dtype
        if self.compute is not None:
            x = x.to(self.compute)
            weights, biases = ([p.to(self.compute) for p in ps] for ps in (weights, biases))
        # unbind makes one gradient per layer, with zeros for the parts that took no rows
        layers = [
            (weight.transpose(1, 2).unbind(0), bias.unbind(0))
            for weight, bias in zip(weights, biases, strict=True)
        ]
        outputs = []
        for part, rows in enumerate(x.split(counts)):
            # with no rows at all, part 0 runs on none, so that gradients are zero, not None
            if counts[part] > 0 or (part == 0 and len(x) == 0):
                outputs.append(_run(rows, [(w[part], b[part]) for w, b in layers]))
        return (torch.cat(outputs) if len(outputs) > 1 else outputs[0]).to(kind)

    def _check_counts(self, x: Tensor, counts: Sequence[int] | None) -> list[int]:
        if x.shape[1] != self.widths[0]:
            raise InputError(f"PartMLP x: expected {self.widths[0]} columns, found {x.shape[1]}")
        if counts is None and self.parts == 1:
            return [len(x)]
        if counts is None:
            raise InputError(f"PartMLP counts: expected {self.parts} numbers, found None")
        counts = [int(count) for count in counts]
        if len(counts) != self.parts or sum(counts) != len(x) or min(counts) < 0:
            raise InputError(
                f"PartMLP counts: expected {self.parts} numbers that add up to {len(x)} rows, "
                f"found {counts}"
            )
        return counts


def _run(x: Tensor, layers: list[tuple[Tensor, Tensor]]) -> Tensor:
    for weight, bias in layers[:-1]:
        x = torch.addmm(bias, x, weight).relu_()  # in place: addmm does not need its result
    weight, bias = layers[-1]
    return torch.addmm(bias, x, weight)
