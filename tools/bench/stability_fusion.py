"""Stress of the attention over codes as a whole, of pose banks in their weights, and of RowAdam."""

import dataclasses
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.func import functional_call

from monopart.fields.fusion import CodeFusion
from monopart.fields.occupancy import PartOccupancy
from monopart.fields.pose_bank import PoseBank
from monopart.fields.row_adam import RowAdam

from .stability_cases import DOUBLE, Backend, Family, Inputs, Stress, Way, kinds_of
from .stability_fields import Nets, exact_layers
from .stability_learned import Bank, exact_adam, exact_attention, exact_bank
from .stability_rotations import Make

_RATE = 0.01

# --- features, queries, attention, features ----------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Fusion:
    """One module of several parts in both precisions, and the share of rows of each part."""

    nets: Nets
    shares: tuple[float, ...]

    @classmethod
    def of(cls, codes: int, shares: tuple[float, ...] = (1.0,), **sizes: int) -> "_Fusion":
        return cls(Nets.of(lambda: CodeFusion(len(shares), 12, codes, **sizes)), shares)

    def counts(self, rows: int) -> tuple[int, ...]:
        """Rows of each part; the last takes what is left."""
        first = [int(rows * share) for share in self.shares[:-1]]
        return (*first, rows - sum(first))


def _features(fusion: _Fusion, size: float, code: float, equal: bool = False) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        pose = size * torch.randn(count, 12, generator=generator, dtype=DOUBLE)
        shape = fusion.nets.double.codes.shape
        codes = code * torch.randn(shape, generator=generator, dtype=DOUBLE)
        return pose, codes[:, :1].expand(shape).contiguous() if equal else codes

    return make


@dataclasses.dataclass(frozen=True)
class _OfPart:
    """Weights of one part of a network, as `exact_layers` reads them."""

    mlp: Any
    part: int

    @property
    def weights(self) -> list[Tensor]:
        """Matrices of the layers."""
        return [w[self.part : self.part + 1] for w in self.mlp.weights]

    @property
    def biases(self) -> list[Tensor]:
        """Their constants."""
        return [b[self.part : self.part + 1] for b in self.mlp.biases]


def exact_fusion(fusion: _Fusion, pose: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Part by part: queries, keys and values, a softmax by loops, features."""
    net, out, first = fusion.nets.double, [], 0
    for part, rows in enumerate(fusion.counts(len(pose))):
        own = pose[first : first + rows]
        first += rows
        wide = net.to_keys.shape[2] // net.heads
        query = exact_layers(_OfPart(net.query, part), own).reshape(rows, net.heads, wide)
        keys, values = (
            (codes[part] @ m[part].detach().numpy()).reshape(1, len(codes[part]), net.heads, wide)
            for m in (net.to_keys, net.to_values)
        )
        found = exact_attention(None, query, keys, values).reshape(
            rows, -1 if rows else net.heads * wide
        )
        out.append(exact_layers(_OfPart(net.out, part), found))
    return np.concatenate(out)


def _scores(fusion: _Fusion, pose: np.ndarray, codes: np.ndarray) -> float:
    """Largest sum of the sizes of the terms of a score: as good as its last place is a weight."""
    net = fusion.nets.double
    low, high = (
        max(float(m.detach().abs().sum(axis).max()) for m in mats)
        for mats, axis in (((net.query.weights[0],), 2), ((net.to_keys,), 1))
    )
    bias = float(net.query.biases[0].detach().abs().max())
    width = net.to_keys.shape[2] // net.heads
    return (low * np.abs(pose).max() + bias) * high * np.abs(codes).max() * width**0.5


def _code_fusion() -> Stress:
    def run(fusion: _Fusion, pose: Tensor, codes: Tensor) -> Tensor:
        module = fusion.nets.like(pose)
        return functional_call(module, {"codes": codes}, (pose, fusion.counts(len(pose))))

    def scale(fusion: _Fusion, exact: np.ndarray, pose: np.ndarray, codes: np.ndarray) -> float:
        return max(1.0, float(np.abs(codes).max())) * max(1.0, _scores(fusion, pose, codes))

    usual, empty = _Fusion.of(100, (0.5, 0.3, 0.2)), _Fusion.of(100, (0.0, 1.0, 0.0))
    shapes = (
        *(("usual", usual, 1.0, 1.0), ("parts without rows", empty, 1.0, 1.0)),
        *(("one code", _Fusion.of(1), 1.0, 1.0), ("17 codes", _Fusion.of(17), 1.0, 1.0)),
        *(("codes of length 1", _Fusion.of(100, length=1), 1.0, 1.0),),
        *(("one head", _Fusion.of(100, heads=1), 1.0, 1.0), ("pose of 0", usual, 0.0, 1.0)),
        *(("pose 1e-30", usual, 1e-30, 1.0), ("codes of 0", usual, 1.0, 0.0)),
        *(("codes 1e-12", usual, 1.0, 1e-12), ("pose 1e4", usual, 1e4, 1.0)),
        *(("codes 1e4", usual, 1.0, 1e4), ("pose and codes 1e8", usual, 1e8, 1e8)),
    )
    families = [
        Family(n, _features(f, p, c), extra=f, step=1e-7, smooth="1e4" not in n and "1e8" not in n)
        for n, f, p, c in shapes
    ]
    # the gradient in the pose is 0, in every precision up to what its sums round to
    same = _features(usual, 1.0, 1.0, True)
    families.append(Family("equal codes", same, extra=usual, smooth=False))
    return Stress(
        name="code_fusion",
        title="pose features that ask codes",
        domain="pose features and codes whose scores stay below 1e29, one code, equal codes, parts "
        "without rows; weights are as good as the last place of their scores",
        error="largest code, at least 1, times the largest sum of terms of a score where above 1",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=exact_fusion,
        scale=scale,
        wrt=(0, 1),
        rows_apart=False,
        cases=32,
    )


# --- pose banks: gradients in the weights of the key poses -------------------------------------


def _weighted(bank: Bank, kind: str) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        net = bank.nets.double
        lines = torch.randn(net.lines.shape, generator=generator, dtype=DOUBLE)
        if kind == "equal key poses":
            lines = lines[:, :1].expand_as(lines).contiguous()
        points = net.lo + torch.rand(count, 3, generator=generator, dtype=DOUBLE) * net.extent
        weights = torch.rand(1, 1, bank.poses, generator=generator, dtype=DOUBLE)
        if kind == "one weight of 1":
            weights = torch.eye(bank.poses, dtype=DOUBLE)[None, :1]
        elif kind == "weights of 0":
            weights = torch.zeros_like(weights)
        elif kind == "weights of 1e-30":
            weights = 1e-30 * weights
        elif kind == "weights of 1e30":
            weights = 1e30 * weights
        elif kind == "weights that cancel":
            weights = weights - weights.mean()
        return points, lines, weights

    return make


def _bank_scale(bank: Bank, exact: np.ndarray, p: Any, lines: np.ndarray, w: np.ndarray) -> float:
    return float(np.abs(lines).max() * lines.shape[3] * max(np.abs(w).sum(), 1e-30))


def _bank_weights() -> list[Stress]:
    def run(bank: Bank, points: Tensor, lines: Tensor, weights: Tensor) -> Tensor:
        part = torch.zeros(len(points), dtype=torch.long)
        rows = torch.arange(bank.poses)[None, None]
        return functional_call(
            bank.nets.like(points), {"lines": lines}, (points, part, None, rows, weights, "torch")
        )

    def blend(bank: Bank, points: Tensor, lines: Tensor, weights: Tensor) -> Tensor:
        module = _WithLines(bank.nets.like(points), lines)
        # every key pose twice: their shares add up
        rows = torch.arange(bank.poses).repeat(2)[None, None]
        twice = torch.cat((0.25 * weights, 0.75 * weights), 2)
        return module.blend(rows, twice)[0, 0].flatten(0, 1)

    def exact_blend(bank: Any, points: Any, lines: np.ndarray, weights: np.ndarray) -> np.ndarray:
        out = np.zeros(lines.shape[2:])
        for pose, weight in enumerate(weights[0, 0]):
            out += weight * lines[0, pose]
        return out.reshape(-1, lines.shape[-1])

    usual = Bank.of(5, 16)
    kinds = ("usual", "one weight of 1", "weights of 0", "weights of 1e-30", "weights of 1e30")
    kinds = (*kinds, "weights that cancel", "equal key poses")
    families = [
        Family(k, _weighted(usual, k), extra=usual, step=1e-7, smooth="1e" not in k) for k in kinds
    ]
    one, many = Bank.of(1, 2), Bank.of(300, 8)
    families.append(Family("one key pose", _weighted(one, "usual"), extra=one, step=1e-7))
    families.append(Family("300 key poses", _weighted(many, "usual"), extra=many, step=1e-7))
    stress = Stress(
        name="pose_bank_weights",
        title="pose bank, in the weights of its key poses",
        domain="any finite weights, of any sum and sign, whose products are finite",
        error="largest feature times the knots of a line and the sum of the weights' sizes",
        families=tuple(families),
        ways=(Way("monopart torch", run, True),),
        exact=exact_bank,
        scale=_bank_scale,
        wrt=(1, 2),
        rows_apart=False,
        cases=64,
    )
    mixed = dataclasses.replace(
        stress,
        name="pose_bank_blend",
        title="lines of blended key poses",
        error="largest feature times the sum of the weights' sizes",
        ways=(Way("monopart", blend, True),),
        exact=exact_blend,
        scale=lambda bank, exact, p, lines, w: float(
            np.abs(lines).max() * max(np.abs(w).sum(), 1e-30)
        ),
        cases=8,
    )
    return [stress, mixed]


class _WithLines:
    """A bank with given lines, for a method that `functional_call` does not reach."""

    def __init__(self, bank: PoseBank, lines: Tensor) -> None:
        self.lines = lines

    blend = PoseBank.blend


# --- the optimiser as torch calls it -----------------------------------------------------------


def _optimiser(backend: Backend) -> Way:
    """Steps of `RowAdam`: gradients set on the parameter, two groups of its state."""

    def run(steps: int, table: Tensor, grad: Tensor) -> Tensor:
        own = torch.nn.Parameter(table.clone())
        optimiser = RowAdam([own], lr=_RATE)
        for number in range(steps):
            own.grad = grad * (1.0, -0.5, 2.0)[number % 3]
            if number == steps // 2:  # a checkpoint in between changes nothing
                state = optimiser.state_dict()
                optimiser = RowAdam([own], lr=_RATE)
                optimiser.load_state_dict(state)
            optimiser.step()
            optimiser.zero_grad()
        return own.detach()

    kinds = kinds_of(backend)
    return Way("monopart", run, True, kinds, differentiable=False)


def _row_adam() -> Stress:
    def rows(size: float, zeros: bool = False) -> Make:
        def make(generator: torch.Generator, count: int) -> Inputs:
            table, grad = torch.randn(2, count, 2, generator=generator, dtype=DOUBLE)
            grad[:: 3 if zeros else count + 1] = 0
            return table, size * grad

        return make

    def exact(steps: int, table: np.ndarray, grad: np.ndarray) -> np.ndarray:
        factors = [(n + 1, (1.0, -0.5, 2.0)[n % 3]) for n in range(steps)]
        return exact_adam(factors, table, grad)

    shapes = (
        *(("20 steps", rows(1.0), 20), ("one step", rows(1.0), 1)),
        *(("gradients 1e-15", rows(1e-15), 20), ("gradients 1e15", rows(1e15), 20)),
        ("rows of zeros", rows(1.0, True), 20),
    )
    return Stress(
        name="row_adam_steps",
        title="steps of the optimiser by rows",
        domain="as Adam by rows; a state that is saved and loaded goes on as if it had not been",
        error="largest number of the table, at least 1",
        families=tuple(Family(n, m, extra=steps) for n, m, steps in shapes),
        ways=(_optimiser("torch"),),
        exact=exact,
        scale=lambda steps, exact, table, grad: max(1.0, np.abs(table).max()),
        wrt=(),
        cases=32,
        limit=2e-6,
        double=1e-10,
    )


# --- cells that are kept -----------------------------------------------------------------------


def _kept() -> Stress:
    """Cells that have seen a density, against the threshold: 1 where a point there is kept."""
    level = 1.0

    def run(extra: None, sigma: Tensor) -> Tensor:
        occupancy = PartOccupancy(torch.zeros(1, 3), torch.ones(1), 4).to(sigma)
        cell = torch.arange(len(sigma)) % 60  # four cells at the end are never seen
        occupancy.see(cell, sigma)
        return occupancy.keep(torch.arange(64), level)[:, None].to(sigma)

    def exact(extra: None, sigma: np.ndarray) -> np.ndarray:
        out = np.ones((64, 1))
        for cell in range(60):
            own = [s if np.isfinite(s) else np.inf for s in sigma[cell::60].tolist()]
            out[cell] = not own or max(own) > level
        return out

    def densities(value: float | None) -> Make:
        def make(generator: torch.Generator, count: int) -> Inputs:
            share = 2 * torch.rand(count, generator=generator, dtype=DOUBLE)
            some = torch.rand(count, generator=generator, dtype=DOUBLE) > 0.5
            return (share if value is None else torch.where(some, value, share).double(),)

        return make

    shapes = (("usual", None), ("0", 0.0), ("1e-38", 1e-38), ("the threshold", 1.0))
    shapes = (*shapes, ("1e30", 1e30), ("infinite", torch.inf), ("NaN", torch.nan))
    return Stress(
        name="occupancy_keep",
        title="cells that are not skipped",
        domain="any density; a cell never seen, or seen with one that is not finite, is kept",
        error="right or wrong",
        families=tuple(Family(n, densities(v)) for n, v in shapes),
        ways=(Way("monopart", run, True, differentiable=False),),
        exact=exact,
        wrt=(),
        cases=128,
    )


def stresses() -> list[Stress]:
    """Modules that learn, as a whole."""
    return [_code_fusion(), *_bank_weights(), _row_adam(), _kept()]
