"""Stress of part fields, pose banks, the attention over codes, Adam by rows and occupancy."""

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.func import functional_call

from monopart.fields.fusion import attend
from monopart.fields.occupancy import PartOccupancy
from monopart.fields.part_field import PartField, PartFieldSpec
from monopart.fields.pose_bank import PoseBank
from monopart.fields.row_adam import AdamRule, RowMoments, row_adam

from .stability_cases import DOUBLE, Backend, Family, Inputs, Stress, Way, kinds_of
from .stability_fields import Nets, exact_grid, exact_layers
from .stability_rotations import Make

# --- density and colour of a part --------------------------------------------------------------


def _in_box(kind: str, prior: float) -> Make:
    """Points of the unit cube or beside it, and what is added before the softplus."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        points = torch.rand(count, 3, generator=generator, dtype=DOUBLE)
        if kind == "outside":
            points = 20 * points - 10
        elif kind == "infinite":
            points = torch.where(points > 0.5, torch.inf, -torch.inf).double()
        return points, torch.full((count,), prior, dtype=DOUBLE)

    return make


def exact_field(nets: Nets, points: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Density and colour by loops over levels, corners and layers."""
    field = nets.double
    encoded = exact_grid(field.grid, points, field.grid.table.detach().numpy())
    out = exact_layers(field.density_mlp, encoded)
    sigma = field.spec.sharpness * np.logaddexp(0.0, out[:, 0] + prior)
    color = exact_layers(field.color_mlp, np.concatenate((encoded, out[:, 1:]), 1))
    return np.concatenate((sigma[:, None], 0.5 + 0.5 * np.tanh(color / 2)), 1)


def _part_field() -> Stress:
    spec = PartFieldSpec(levels=4, log2_size=12, base=4, finest=0.05, hidden=32)
    nets = Nets.of(lambda: PartField(torch.zeros(1, 3), torch.ones(1, 3), spec))
    shapes = (
        *(("inside", "inside", 0.0), ("outside", "outside", 0.0), ("infinite", "infinite", 0.0)),
        *(("prior 50", "inside", 50.0), ("prior -50", "inside", -50.0)),
        *(("prior 1e4", "inside", 1e4), ("prior -1e4", "inside", -1e4)),
        ("prior 1e30", "inside", 1e30),
    )
    families = [
        Family(n, _in_box(k, p), extra=nets, smooth=n == "inside", step=1e-9) for n, k, p in shapes
    ]

    def run(nets: Nets, points: Tensor, prior: Tensor) -> Tensor:
        field, counts = nets.like(points), (len(points),)
        encoded = field.encode(points, torch.zeros(len(points), dtype=torch.long))
        sigma, geometry = field.density(encoded, counts, prior)
        return torch.cat((sigma[:, None], field.color(encoded, geometry, None, counts)), 1)

    return Stress(
        name="part_field",
        title="density and colour of a part",
        domain="any point that is not NaN: outside its box it is clamped; any finite prior; the "
        "gradient in the points jumps at cell borders; a box without extent is an error",
        error="the sharpness (100/m) times the cells of the finest level, and the density",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=exact_field,
        scale=lambda nets, exact, points, prior: np.maximum(100.0 * 20, exact[:, 0]),
        wrt=(0, 1),
    )


# --- lines of key poses ------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Bank:
    """One bank in both precisions, of one part whose box is not a cube."""

    nets: Nets
    poses: int

    @classmethod
    def of(cls, poses: int, knots: int) -> "Bank":
        """A bank of so many key poses and knots."""
        lo, hi = torch.tensor([[-1.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.5, 3.0]])
        return cls(Nets.of(lambda: PoseBank(lo, hi, poses, knots, 4)), poses)


def _on_lines(bank: Bank, kind: str) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        lines = torch.randn(bank.nets.double.lines.shape, generator=generator, dtype=DOUBLE)
        share = torch.rand(count, 3, generator=generator, dtype=DOUBLE)
        last = lines.shape[3] - 1
        if kind == "knots":
            share = (share * last).round() / last
        elif kind == "outside":
            share = 20 * share - 10
        points = bank.nets.double.lo + share * bank.nets.double.extent
        if kind in ("infinite", "1e30 m off"):
            points = (share - 0.5).sign() * (torch.inf if kind == "infinite" else 1e30)
        weights = torch.rand(1, 1, bank.poses, generator=generator, dtype=DOUBLE)
        if kind == "a weight of 0":
            weights[..., 0] = 0
        elif kind == "weights of 1e-30":
            weights[..., 1:] = 1e-30
        return points, lines, weights / weights.sum()

    return make


def exact_bank(
    bank: Bank, points: np.ndarray, lines: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Blend the lines, then look every axis up by linear interpolation."""
    blended = np.einsum("q,qakc->akc", weights[0, 0], lines[0])
    lo, extent = bank.nets.double.lo[0].numpy(), bank.nets.double.extent[0].numpy()
    last, out = lines.shape[3] - 1, []
    for axis in range(3):
        place = np.clip((points[:, axis] - lo[axis]) / extent[axis], 0.0, 1.0) * last
        knots = np.arange(last + 1)
        own = blended[axis]
        out.append(np.stack([np.interp(place, knots, own[:, c]) for c in range(own.shape[1])], 1))
    return np.concatenate(out, 1)


def _bank_way(backend: Backend) -> Way:
    def run(bank: Bank, points: Tensor, lines: Tensor, weights: Tensor) -> Tensor:
        part = torch.zeros(len(points), dtype=torch.long)
        rows = torch.arange(bank.poses)[None, None]
        inputs = (points, part, None, rows, weights, backend)
        return functional_call(bank.nets.like(points), {"lines": lines}, inputs)

    return Way(f"monopart {backend}", run, True, kinds_of(backend))


def _pose_bank() -> Stress:
    usual = Bank.of(4, 16)
    kinds = ("inside", "knots", "outside", "1e30 m off", "infinite", "a weight of 0")
    kinds = (*kinds, "weights of 1e-30")
    families = [Family(k, _on_lines(usual, k), extra=usual) for k in kinds]
    for name, bank in (
        ("one key pose", Bank.of(1, 16)),
        ("two knots", Bank.of(4, 2)),
        ("4096 knots", Bank.of(4, 4096)),
    ):
        families.append(Family(name, _on_lines(bank, "inside"), extra=bank))
    return Stress(
        name="pose_bank",
        title="pose bank",
        domain="any point that is not NaN: outside its box the ends of the lines go on; any finite "
        "weights; one key pose; a box without extent is an error",
        error="largest feature times the knots of a line: the slope of the look-up",
        families=tuple(families),
        ways=(_bank_way("torch"), _bank_way("warp")),
        exact=exact_bank,
        scale=lambda bank, exact, p, lines, w: float(np.abs(lines).max() * lines.shape[3]),
        wrt=(1,),
    )


# --- attention over the codes of a part --------------------------------------------------------


def _asked(codes: int, query: float, key: float = 1.0, shift: float = 0.0) -> Make:
    """Queries, keys and values of a size; a shift along the first axis moves all scores alike."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        q = query * torch.randn(count, 2, 8, generator=generator, dtype=DOUBLE)
        k, v = torch.randn(2, 1, codes, 2, 8, generator=generator, dtype=DOUBLE)
        k = key * k
        if shift:
            q[..., 0], k[..., 0] = 1.0, shift
        return q, k, v

    return make


def exact_attention(
    extra: None, query: np.ndarray, keys: np.ndarray, values: np.ndarray
) -> np.ndarray:
    """Softmax of scores relative to the largest, by a loop over samples and heads."""
    out = np.zeros_like(query)
    for (i, h), _ in np.ndenumerate(out[..., 0]):
        score = keys[0, :, h] @ query[i, h] / math.sqrt(query.shape[-1])
        share = np.exp(score - score.max())
        out[i, h] = share @ values[0, :, h] / share.sum()
    return out


def _attention_way(backend: Backend) -> Way:
    def run(extra: None, query: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        return attend(query, keys, values, (len(query),), backend)

    return Way(f"monopart {backend}", run, True, kinds_of(backend))


def _attention() -> Stress:
    shapes = (
        *(("usual", _asked(100, 1.0)), ("one code", _asked(1, 1.0)), ("17 codes", _asked(17, 1.0))),
        *(("queries of 0", _asked(100, 0.0)), ("queries of 1e-30", _asked(100, 1e-30))),
        *(("equal keys", _asked(100, 1.0, 0.0)), ("scores of 100", _asked(100, 100.0))),
        ("scores of 1e4", _asked(100, 1e4)),
        ("scores of 1e15", _asked(100, 1e8, 1e7)),
        ("all scores + 1e4", _asked(100, 1.0, 1.0, 3e4)),
        ("all scores - 1e4", _asked(100, 1.0, 1.0, -3e4)),
    )
    families = [
        # where scores are a hundred apart one code has all the weight but 1e-5: what is left of the
        # gradient is a difference of values that agree so far, in torch's softmax as in ours
        Family(n, make, smooth=not n.startswith("scores"), step=1e-7)
        for n, make in shapes
    ]

    def scale(extra: None, exact: np.ndarray, q: np.ndarray, k: np.ndarray, v: np.ndarray) -> Any:
        # a score is as good as its largest terms: weights move by as many last places
        terms = np.abs(q).sum(2).max(1) * np.abs(k).max() / math.sqrt(q.shape[-1])
        return np.abs(v).max() * np.maximum(1.0, terms)

    return Stress(
        name="attention",
        title="attention over codes",
        domain="scores below 1e29 in size, one code too; weights are as good as the last place of "
        "their scores",
        error="largest value, times the largest sum of terms of a score where that is above 1",
        families=tuple(families),
        ways=(_attention_way("torch"), _attention_way("warp")),
        exact=exact_attention,
        scale=scale,
        wrt=(0, 1, 2),
        rows_apart=False,
        cases=64,
    )


# --- Adam by rows ------------------------------------------------------------------------------

_RATE = 0.01


@dataclasses.dataclass(frozen=True)
class _Course:
    """Numbers of the steps that touch the table, and the factor of the gradient at each."""

    steps: tuple[int, ...]
    factors: tuple[float, ...] = (1.0, -0.5, 2.0)

    def __iter__(self) -> Any:
        return iter(zip(self.steps, itertools.cycle(self.factors), strict=False))


def _table(size: float, zeros: bool = False) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        table, grad = torch.randn(2, count, 2, generator=generator, dtype=DOUBLE)
        grad[:: 3 if zeros else count + 1] = 0
        return table, size * grad

    return make


def exact_adam(course: Any, table: np.ndarray, grad: np.ndarray) -> np.ndarray:
    """Adam in float64 for each number; missed movements are added one by one."""
    (first, second), eps = AdamRule().betas, AdamRule().eps
    out = table.copy()
    for at, start in np.ndenumerate(table):
        row, value, mean, square, seen = at[0], start, 0.0, 0.0, 0
        if not grad[row].any():
            continue
        for now, factor in course:
            rate, root = _RATE / (1 - first**now), 1 / math.sqrt(1 - second**now)
            missed = sum((first / math.sqrt(second)) ** k for k in range(1, min(now - seen, 2048)))
            value -= rate * missed * mean / (math.sqrt(square) * root + eps)
            gap = now - 1 - seen
            mean = first * first**gap * mean + (1 - first) * factor * grad[at]
            square = second * second**gap * square + (1 - second) * (factor * grad[at]) ** 2
            value, seen = value - rate * mean / (math.sqrt(square) * root + eps), now
        out[at] = value
    return out


def _adam_way(backend: Backend) -> Way:
    def run(course: _Course, table: Tensor, grad: Tensor) -> Tensor:
        table, seen = table.clone(), torch.zeros(len(table), dtype=torch.int32)
        moments = RowMoments(torch.zeros_like(table), torch.zeros_like(table), seen)
        for now, factor in course:
            row_adam(table, factor * grad, moments, now, _RATE, AdamRule(), backend)
        return table

    return Way(f"monopart {backend}", run, True, kinds_of(backend), differentiable=False)


def _adam() -> Stress:
    every, once = _Course(tuple(range(1, 31))), _Course((1,))
    shapes = (
        *(("usual", 1.0, every), ("gradients 1e-10", 1e-10, every), ("1e-15", 1e-15, every)),
        *(("1e-30", 1e-30, every), ("1e15", 1e15, every), ("first step", 1.0, once)),
        ("first touch at 1e6", 1.0, _Course((1_000_000, 1_000_001))),
        ("rests of 3000", 1.0, _Course((1, 2, 3002, 6002))),
        ("rests of 7", 1.0, _Course(tuple(range(3, 60, 8)))),
    )
    families = [Family(n, _table(size), extra=course) for n, size, course in shapes]
    families.append(Family("rows of zeros", _table(1.0, zeros=True), extra=every))
    families.append(Family("gradients 1e25", _table(1e25), extra=every, inside=False))
    return Stress(
        name="row_adam",
        title="Adam by rows",
        domain="gradients below 1e15, whose squares float32 holds (a training leaves larger ones "
        "out); a row of zeros is not touched; β₁ > √β₂, whose series grows, is an error",
        error="largest number of the table, at least 1",
        families=tuple(families),
        ways=(_adam_way("torch"), _adam_way("warp")),
        exact=exact_adam,
        scale=lambda course, exact, table, grad: max(1.0, np.abs(table).max()),
        wrt=(),
        cases=32,
        limit=2e-6,
        double=1e-10,  # moments of a row that rests longer than 2047 steps
    )


# --- what was seen of cells --------------------------------------------------------------------

_LARGE = 2.0**126  # an infinite density, as a number that can be compared


def _seen(value: float | None) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        share = 100 * torch.rand(count, generator=generator, dtype=DOUBLE)
        return (share if value is None else torch.where(share > 50, value, share).double(),)

    return make


def exact_memory(extra: None, sigma: np.ndarray) -> np.ndarray:
    """Maximum and minimum of each of 8 cells that are seen three times, by a loop."""
    peak, floor = [math.inf] * 8, [0.0] * 8
    for _ in range(3):
        for cell in range(8):
            own = sigma[cell::8]
            if len(own) == 0:
                continue
            high = max(s if math.isfinite(s) else math.inf for s in own)
            low = min(s if math.isfinite(s) else 0.0 for s in own)
            first = math.isinf(peak[cell])
            peak[cell] = high if first else max(high, 0.9 * peak[cell])
            floor[cell] = low if first else min(low, 1.05 * floor[cell])
    return np.minimum(np.array([peak, floor]).T, _LARGE)


def _memory() -> Stress:
    def run(extra: None, sigma: Tensor) -> Tensor:
        occupancy = PartOccupancy(torch.zeros(1, 3), torch.ones(1), 2).to(sigma)
        for _ in range(3):
            occupancy.see(torch.arange(len(sigma)) % 8, sigma)
        return torch.stack((occupancy.peak, occupancy.floor), 1).clamp(max=_LARGE)

    shapes = (("usual", None), ("0", 0.0), ("1e-38", 1e-38), ("1e30", 1e30), ("∞", math.inf))
    families = [Family(name, _seen(value)) for name, value in (*shapes, ("NaN", math.nan))]
    return Stress(
        name="occupancy_memory",
        title="densities remembered by cell",
        domain="any density: one that is not finite may be dense or empty, so that its cell is "
        "neither skipped nor a wall",
        error="the density remembered, at least 1",
        families=tuple(families),
        ways=(Way("monopart", run, True, differentiable=False),),
        exact=exact_memory,
        scale=lambda extra, exact, sigma: np.maximum(1.0, np.abs(exact).max(1)),
        wrt=(),
    )


def stresses() -> list[Stress]:
    """Operations that learn."""
    return [_part_field(), _pose_bank(), _attention(), _adam(), _memory()]
