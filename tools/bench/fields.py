"""``monopart-bench fields``: hash grid, networks, compositing against eager and compiled torch."""

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from monopart.fields.hash_grid import PRIMES, GridSpec, HashGrid
from monopart.fields.mlp import PartMLP
from monopart.fields.volume import composite, composite_dense

from .registry import Method, Operation, Problem, Settings
from .skinning_methods import no_compiler

POINTS = 32_768
GRIDS = {rows: GridSpec(16, 2, rows, base=16, growth=1.38) for rows in (16, 19)}
"""Sixteen levels of at most 2^16 rows (7 MB: caches hold it) and 2^19 (49 MB: they do not)."""
SMALL = GridSpec(levels=4, features=2, log2_size=10, base=4, growth=1.5)
PARTS = 5

Outcome = tuple[Tensor, Tensor | None]
"""Value, and a gradient where the problem asks for one."""


@dataclass(eq=False)
class Case:
    """A function of float tensors of which the last ones are differentiated."""

    function: Any
    """Called with a back end and the tensors; returns one tensor."""
    tensors: tuple[Tensor, ...]
    """Single precision."""
    watched: Tensor
    """The tensor whose gradient is compared, or read by the function itself."""
    backward: bool

    @cached_property
    def exact(self) -> Outcome:
        """In double precision, by the torch back end."""
        return self.function.double_outcome(self)


@dataclass(eq=False)
class _Grid:
    """Hash grid look-up; differentiated in the table."""

    grid: HashGrid

    def __call__(self, backend: Any, points: Tensor) -> Tensor:
        if backend == "levels":
            return self._levels(points)
        return self.grid(points, None, backend=backend)

    def _levels(self, points: Tensor) -> Tensor:
        """What a first version does: one level after the other, each an embedding."""
        spec = self.grid.specs[0]
        bits = torch.tensor([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])
        tables, out = self.grid.table.split(list(spec.sizes)), []
        for cells, size, dense, table in zip(
            spec.resolutions, spec.sizes, spec.dense, tables, strict=True
        ):
            place = points * cells
            cell = place.detach().long().clamp(max=cells - 1)
            x, y, z = (cell[:, None] + bits).unbind(-1)
            if dense:
                row = x + (cells + 1) * (y + (cells + 1) * z)
            else:
                row = ((x * PRIMES[0]) ^ (y * PRIMES[1]) ^ (z * PRIMES[2])) & (size - 1)
            inside = (place - cell)[:, None]
            share = torch.where(bits == 1, inside, 1 - inside).prod(-1, keepdim=True)
            out.append((torch.nn.functional.embedding(row, table) * share).sum(1))
        return torch.cat(out, -1)

    def double_outcome(self, case: Case) -> Outcome:
        """The same table in double precision."""
        exact = HashGrid(self.grid.specs).double()
        exact.load_state_dict(self.grid.state_dict())
        out = exact(case.tensors[0].double(), None, backend="torch")
        if not case.backward:
            return out.detach(), None
        return out.detach(), torch.autograd.grad(out.square().sum(), exact.table)[0]


@dataclass(eq=False)
class _Volume:
    """Compositing of packed samples; differentiated in the density."""

    ray_start: Tensor
    index: tuple[Tensor, Tensor]
    """Row and column of every sample in a padded table."""
    longest: int
    """Samples of the longest ray."""

    def __call__(self, backend: Any, sigma: Tensor, color: Tensor, delta: Tensor) -> Tensor:
        if backend == "dense":
            return self._dense(sigma, color, delta)
        return composite(sigma, color, delta, self.ray_start, backend=backend).color

    def _dense(self, sigma: Tensor, color: Tensor, delta: Tensor) -> Tensor:
        """Padded, without a check that would break a compiled graph."""
        shape = (len(self.ray_start) - 1, self.longest)

        def pad(values: Tensor) -> Tensor:
            return values.new_zeros(*shape, *values.shape[1:]).index_put(self.index, values)

        return composite_dense(pad(sigma), pad(color), pad(delta)).color

    def double_outcome(self, case: Case) -> Outcome:
        """Padded, in double precision."""
        sigma, color, delta = (t.detach().double() for t in case.tensors)
        sigma.requires_grad_(case.backward)
        out = self("torch", sigma, color, delta)
        if not case.backward:
            return out.detach(), None
        return out.detach(), torch.autograd.grad(out.square().sum(), sigma)[0]


@dataclass(eq=False)
class _Networks:
    """One network per part; differentiated in the first weights."""

    mlp: PartMLP
    counts: tuple[int, ...]

    def __call__(self, backend: Any, x: Tensor) -> Tensor:
        if backend == "loop over masks":
            return self._masked(x)
        if backend == "padded bmm":
            return self._padded(x)
        return self.mlp(x, self.counts)

    def _layers(self) -> list[tuple[Tensor, Tensor]]:
        return list(zip(self.mlp.weights, self.mlp.biases, strict=True))

    def _masked(self, x: Tensor) -> Tensor:
        """What a first version does: select the rows of each part, write them back."""
        part = torch.repeat_interleave(torch.arange(len(self.counts)), torch.tensor(self.counts))
        out = x.new_zeros(len(x), self.mlp.widths[-1])
        for k in range(len(self.counts)):
            rows = part == k
            y = x[rows]
            for i, (weight, bias) in enumerate(self._layers()):
                y = torch.nn.functional.linear(y, weight[k], bias[k])
                y = y.relu() if i + 1 < len(self.mlp.weights) else y
            out[rows] = y
        return out

    def _padded(self, x: Tensor) -> Tensor:
        """All parts in one product, padded to the largest."""
        padded = torch.nn.utils.rnn.pad_sequence(list(x.split(list(self.counts))), True)
        for i, (weight, bias) in enumerate(self._layers()):
            padded = torch.baddbmm(bias[:, None], padded, weight.mT)
            padded = padded.relu() if i + 1 < len(self.mlp.weights) else padded
        return torch.cat([rows[:n] for rows, n in zip(padded, self.counts, strict=True)])

    def double_outcome(self, case: Case) -> Outcome:
        """The same networks in double precision."""
        exact = PartMLP(self.mlp.parts, self.mlp.widths).double()
        exact.load_state_dict(self.mlp.state_dict())
        out = exact(case.tensors[0].double(), self.counts)
        if not case.backward:
            return out.detach(), None
        return out.detach(), torch.autograd.grad(out.square().sum(), exact.weights[0])[0]


def _run(backend: str, compiled: bool = False) -> Callable[[Any], Callable[[], Outcome]]:
    def prepare(case: Case) -> Callable[[], Outcome]:
        def plain(*tensors: Tensor) -> Tensor:
            return case.function(backend, *tensors)

        function: Any = torch.compile(plain, dynamic=False) if compiled else plain

        def forward() -> Outcome:
            with torch.no_grad():
                return function(*case.tensors), None

        def both() -> Outcome:
            out = function(*case.tensors)
            return out.detach(), torch.autograd.grad(out.square().sum(), case.watched)[0]

        return both if case.backward else forward

    return prepare


def kernel_methods(compiled: str = "torch") -> tuple[Method, ...]:
    """Back ends of one function; ``compiled`` is the one that torch.compile gets."""
    largest = POINTS  # compilation and eager steps take many seconds beyond
    plain = Method("torch, eager", _run("torch"), largest=largest)
    fast = Method(
        *("torch.compile", _run(compiled, True)),
        largest=largest,
        needs=no_compiler,
        slow_start=True,
    )
    return (Method("monopart (Warp)", _run("warp"), ours=True), plain, fast)


def grid_methods() -> tuple[Method, ...]:
    """Back ends of the hash grid, and eager torch as one writes it first."""
    plain = Method("torch, eager, level by level", _run("levels"), largest=POINTS)
    return (*kernel_methods(), plain)


def network_methods() -> tuple[Method, ...]:
    """Ways to run one small network per part."""
    return (
        Method("monopart (slices)", _run("slices"), ours=True),
        Method("loop over masks", _run("loop over masks")),
        Method("padded bmm", _run("padded bmm")),
    )


def judge(case: Case, outcome: Outcome) -> dict[str, float]:
    """Largest errors of value and gradient, relative to the largest value and gradient."""

    def off(a: Tensor, b: Tensor) -> float:
        return float((a.double() - b).abs().max() / b.abs().max().clamp(min=1e-300))

    figures = {"error": off(outcome[0], case.exact[0])}
    if outcome[1] is not None and case.exact[1] is not None:
        figures["gradient error"] = off(outcome[1], case.exact[1])
    return figures


def _grids(settings: Settings, backward: bool, rows: int) -> Iterator[Problem]:
    generator = torch.Generator().manual_seed(5)
    grid = HashGrid([SMALL if settings.quick else GRIDS[rows]], generator)
    for count in (256,) if settings.quick else (POINTS, 262_144):
        points = torch.rand(count, 3, generator=generator)
        yield Problem(count, "uniform", Case(_Grid(grid), (points,), grid.table, backward))


def _volumes(settings: Settings, backward: bool) -> Iterator[Problem]:
    generator = torch.Generator().manual_seed(6)
    for rays in (16,) if settings.quick else (8_192, 65_536):
        counts = torch.randint(0, 40, (rays,), generator=generator)
        start = torch.zeros(rays + 1, dtype=torch.int64)
        torch.cumsum(counts, 0, out=start[1:])
        total = int(start[-1])
        ray = torch.repeat_interleave(torch.arange(rays), counts)
        index = (ray, torch.arange(total) - start[ray])
        volume = _Volume(start, index, int(counts.max()))
        sigma = 40 * torch.rand(total, generator=generator)
        color = torch.rand(total, 3, generator=generator)
        sigma.requires_grad_(backward)
        tensors = (sigma, color, torch.full((total,), 0.0125))
        yield Problem(rays, "0–39 samples a ray", Case(volume, tensors, sigma, backward))


def _networks(settings: Settings, backward: bool) -> Iterator[Problem]:
    generator = torch.Generator().manual_seed(8)
    for count in (50,) if settings.quick else (POINTS, 131_072):
        mlp = PartMLP(PARTS, (32, 64, 64, 16), generator=generator)
        shares = (0.4, 0.3, 0.1, 0.1)
        counts = [int(count * share) for share in shares]
        counts.append(count - sum(counts))
        x = torch.randn(count, 32, generator=generator)
        case = Case(_Networks(mlp, tuple(counts)), (x,), mlp.weights[0], backward)
        yield Problem(count, "five parts", case)


_RELATIVE = "largest error relative to the largest value (float64 oracle)"


def operations() -> tuple[Operation, ...]:
    """All operations of the fields suite."""
    kinds = (
        (
            *("grid", "Hash grid, 16 levels × 2, 2^16 rows a level"),
            *(functools.partial(_grids, rows=16), grid_methods()),
        ),
        (
            *("grid_large", "Hash grid, 16 levels × 2, 2^19 rows a level"),
            *(functools.partial(_grids, rows=19), grid_methods()),
        ),
        ("composite", "Compositing", _volumes, kernel_methods("dense")),
        ("mlp", "One network 32-64-64-16 per part", _networks, network_methods()),
    )
    result = []
    for name, title, problems, methods in kinds:
        for backward in (False, True):
            what = "forward and backward" if backward else "forward"
            result.append(
                Operation(
                    f"{name}_backward" if backward else name,
                    f"{title}, {what}",
                    _RELATIVE,
                    methods,
                    _bound(problems, backward),
                    judge,
                )
            )
    return tuple(result)


def _bound(
    problems: Callable[[Settings, bool], Iterator[Problem]], backward: bool
) -> Callable[[Settings], Iterator[Problem]]:
    return lambda settings: problems(settings, backward)
