"""``monopart-bench stability``: every operation on inputs that break float arithmetic.

An operation is run on families of designed inputs, in every precision that it takes. Its values are
compared with an oracle that gets the same rounded inputs, so an error is the operation's own;
gradients with those in float64, and those in float64 with central differences.
"""

import dataclasses
import importlib
import importlib.util
import json
import math
import sys
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.errors import InputError

Inputs = tuple[Tensor, ...]
SINGLE, DOUBLE = torch.float32, torch.float64
HALVES = (torch.float16, torch.bfloat16)
SCHEMA = 1
_FLOOR = 1e-3  # gradients below this share of the largest of their family are compared with it


@dataclass(frozen=True)
class Family:
    """Inputs of one kind."""

    name: str
    """Shown in tables."""
    make: Callable[[torch.Generator, int], Inputs]
    """Inputs in float64 of about a given number of cases: the rows of the result."""
    inside: bool = True
    """Inside the stated domain; outside it only the outcome is reported."""
    smooth: bool = True
    """The gradient is continuous here, so that it can be compared; else it must be finite."""
    step: float = 1e-5
    """Step of the central differences, in the unit of the inputs."""
    extra: Any = None
    """What is not a float: faces, a tree, a camera."""
    cases: int | None = None
    """Largest number of cases."""
    halves: bool = True
    """Inside the range of float16 too."""
    slope: float = 1e-4
    """Largest relative error of a float32 gradient; the tests hold it."""


@dataclass(frozen=True)
class Way:
    """One implementation."""

    name: str
    """Shown in tables."""
    run: Callable[..., Tensor | tuple[Tensor, Tensor]]
    """(extra, *inputs) to results, one row a case, and the mask of valid rows where it has one."""
    ours: bool = False
    """Whether it is part of monopart."""
    dtypes: tuple[torch.dtype, ...] = (SINGLE, DOUBLE)
    """Precisions that it takes."""
    modules: tuple[str, ...] = ()
    """What must be importable."""
    differentiable: bool = True
    """Whether it has gradients."""
    serves: Callable[[Family], bool] = lambda family: True
    """Families that it is made for."""
    limit: float | None = None
    """Largest relative error in float32, where it is not that of the operation."""
    double: float | None = None
    """The same in float64."""

    def absent(self) -> str | None:
        """The first module that is not installed, or None."""
        return next((m for m in self.modules if importlib.util.find_spec(m) is None), None)


@dataclass(frozen=True)
class Stress:
    """An operation, its domain, its families and its implementations."""

    name: str
    """For the command line."""
    title: str
    """For people."""
    domain: str
    """Where it is promised to hold, and what happens outside."""
    error: str
    """What the error is relative to."""
    families: tuple[Family, ...]
    """Kinds of input."""
    ways: tuple[Way, ...]
    """Ours first."""
    exact: Callable[..., np.ndarray]
    """(extra, *inputs as float64 arrays) to exact results."""
    scale: Callable[..., np.ndarray | float] = lambda extra, exact, *inputs: 1.0
    """(extra, exact, *inputs) to the size, per row, that errors are relative to."""
    off: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    """(result, exact) to the error of each row; None is the largest entry of the difference."""
    wrt: tuple[int, ...] = (0,)
    """Inputs that gradients are taken in."""
    cases: int = 256
    """Cases of a family."""
    rows_apart: bool = True
    """A row of the result depends on the same row of the inputs only, where they have as many."""
    limit: float = 1e-6
    """Largest relative error in float32 inside the domain; the tests hold it."""
    double: float = 1e-13
    """The same in float64."""


@dataclass(frozen=True)
class Cell:
    """One implementation on one family in one precision."""

    operation: str
    family: str
    way: str
    ours: bool
    dtype: str
    inside: bool
    cases: int
    """Rows of the result."""
    masked: int
    """Rows that the operation itself declared to have no answer."""
    value: float | None
    """Largest error relative to the scale."""
    absolute: float | None
    """Largest error in the unit of the result."""
    gradient: float | None
    """Largest error of the gradient: against float64, or of float64 against differences."""
    amplification: float | None
    """Largest |gradient| times |input| over |result|: a bound on what rounding can do."""
    bad_values: int
    """Rows that are not finite and not masked."""
    bad_gradients: int
    """Rows (or entries) of gradients that are not finite."""
    raised: str = ""
    """The error that stopped it, if any."""

    @property
    def kind(self) -> torch.dtype:
        """The precision."""
        return getattr(torch, self.dtype)

    @property
    def ulp(self) -> float | None:
        """The value error in units of the last place of the scale."""
        return None if self.value is None else self.value / torch.finfo(self.kind).eps


@dataclass
class Outcome:
    """All cells of a run, with the operations they belong to."""

    cells: list[Cell] = field(default_factory=list)
    absent: dict[str, str] = field(default_factory=dict)
    """Implementations that are not installed, with the missing module."""

    @property
    def cases(self) -> int:
        """Cases over everything that ran."""
        return sum(cell.cases for cell in self.cells)


def _as_rows(values: np.ndarray) -> np.ndarray:
    return values.reshape(len(values), math.prod(values.shape[1:]))


def _flat(values: Tensor) -> Tensor:
    return values.reshape(len(values), math.prod(values.shape[1:]))


def _worst(rows: np.ndarray) -> float | None:
    """The largest finite entry, None where there is none: non-finite ones are counted apart."""
    kept = rows[np.isfinite(rows)]
    return float(kept.max()) if kept.size else None


def _apply(way: Way, family: Family, inputs: Inputs) -> tuple[Tensor, Tensor]:
    """Result and mask, all True where there is none."""
    result = way.run(family.extra, *inputs)
    if isinstance(result, tuple):
        return result
    return result, torch.ones(len(result), dtype=torch.bool)


def _gradients(
    way: Way, family: Family, inputs: Inputs, wrt: tuple[int, ...]
) -> tuple[list[Tensor], Tensor]:
    """Gradients, in some inputs, of a fixed random projection of the valid rows; and that mask."""
    leaves = [x.detach().clone().requires_grad_(i in wrt) for i, x in enumerate(inputs)]
    result, valid = _apply(way, family, tuple(leaves))
    weights = _cotangent(result)
    rows = _flat(result * weights).sum(1)
    total = torch.where(valid, rows, torch.zeros_like(rows)).sum()
    wanted = [leaves[i] for i in wrt]
    found = torch.autograd.grad(total, wanted, allow_unused=True)
    zeros = [torch.zeros_like(x) for x in wanted]
    return [z if g is None else g for g, z in zip(found, zeros, strict=True)], valid


def _cotangent(result: Tensor) -> Tensor:
    """Numbers of size one that depend on the shape only."""
    generator = torch.Generator().manual_seed(result.numel() + 17)
    return torch.randn(result.shape, generator=generator, dtype=DOUBLE).to(result.dtype)


def _differences(
    stress: Stress, way: Way, family: Family, inputs: Inputs, gradients: list[Tensor]
) -> float | None:
    """Relative error of float64 gradients against central differences along a random direction."""
    generator, wrt = torch.Generator().manual_seed(23), stress.wrt
    along = [torch.randn(inputs[i].shape, generator=generator, dtype=DOUBLE) for i in wrt]
    sums = []
    for sign in (1.0, -1.0):
        moved = list(inputs)
        for i, direction in zip(wrt, along, strict=True):
            moved[i] = inputs[i] + sign * family.step * direction
        result, valid = _apply(way, family, tuple(moved))
        rows = _flat(result * _cotangent(result)).sum(1)
        sums.append(torch.where(valid, rows, torch.zeros_like(rows)))
    slope = (sums[0] - sums[1]) / (2 * family.step)
    count = len(slope)
    parts = [(g * d, g, d) for g, d in zip(gradients, along, strict=True)]
    if stress.rows_apart and all(len(g) == count for g in gradients):
        told = torch.stack([_flat(p).sum(1) for p, _, _ in parts]).sum(0)
        size = torch.stack([_flat(g).norm(dim=1) for _, g, _ in parts]).norm(dim=0)
    else:
        told = torch.stack([p.sum() for p, _, _ in parts]).sum()[None]
        size = torch.stack([g.norm() for _, g, _ in parts]).norm()[None]
        slope = slope.sum()[None]
    size = torch.maximum(size, _FLOOR * size.max()).clamp_min(torch.finfo(DOUBLE).tiny)
    return _worst(((slope - told).abs() / size).detach().numpy())


def _largest(values: Tensor) -> Tensor:
    """Largest entry of each row; 0 where there is none."""
    return _flat(values).abs().amax(1) if values.numel() else torch.zeros(1)


def _gradient_error(found: list[Tensor], true: list[Tensor]) -> float | None:
    """Largest relative error over the rows of all inputs."""
    errors = []
    for g, t in zip(found, true, strict=True):
        gap = _largest(g.double() - t)
        size = _largest(t)
        size = torch.maximum(size, _FLOOR * size.max()).clamp_min(torch.finfo(DOUBLE).tiny)
        errors.append(_worst((gap / size).detach().numpy()))
    kept = [e for e in errors if e is not None]
    return max(kept) if kept else None


def _value_errors(
    stress: Stress, family: Family, inputs: Inputs, result: Tensor, valid: Tensor
) -> tuple[float | None, float | None, int, np.ndarray]:
    """Relative and absolute error, rows that are not finite, and the scale of each row."""
    arrays = [x.detach().double().numpy() for x in inputs]
    exact = np.asarray(stress.exact(family.extra, *arrays), np.float64)
    found = result.detach().double().numpy()
    keep = valid.numpy()
    sound = np.isfinite(_as_rows(found)).all(1)
    size = np.broadcast_to(stress.scale(family.extra, exact, *arrays), (len(found),))
    with np.errstate(all="ignore"):
        off = stress.off or (lambda a, b: np.abs(_as_rows(a) - _as_rows(b)).max(1, initial=0.0))
        gap = off(found, exact)[keep & sound]
        relative = gap / size[keep & sound]
    return _worst(relative), _worst(gap), int((keep & ~sound).sum()), size


def measure(stress: Stress, family: Family, way: Way, dtype: torch.dtype, cases: int) -> Cell:
    """Run one implementation on one family in one precision.

    Args:
        stress: the operation.
        family: the inputs.
        way: the implementation.
        dtype: the precision.
        cases: how many inputs are wanted.
    """
    generator = torch.Generator().manual_seed(zlib.crc32(family.name.encode()))
    # rounded to the precision first: the oracle and float64 see the same numbers
    inputs = tuple(x.to(dtype) for x in family.make(generator, min(cases, family.cases or cases)))
    head = (stress.name, family.name, way.name, way.ours, str(dtype).removeprefix("torch."))
    try:
        with torch.no_grad():
            result, valid = _apply(way, family, inputs)
        relative, gap, bad, size = _value_errors(stress, family, inputs, result, valid)
        slope, gain, bad_slopes = None, None, 0
        if way.differentiable and stress.wrt and len(result):
            slope, gain, bad_slopes = _slopes(stress, family, way, inputs, size)
    except (ImportError, RuntimeError, ValueError, IndexError, TypeError) as error:
        if way.ours:
            raise
        text = f"{type(error).__name__}: {' '.join(str(error).split())[:100]}"
        return Cell(*head, family.inside, 0, 0, None, None, None, None, 0, 0, text)
    masked = int((~valid).sum())
    counts = (len(result), masked)
    return Cell(*head, family.inside, *counts, relative, gap, slope, gain, bad, bad_slopes)


def _slopes(
    stress: Stress, family: Family, way: Way, inputs: Inputs, size: np.ndarray
) -> tuple[float | None, float | None, int]:
    """Error of the gradient, amplification, and how many gradients are not finite."""
    found, valid = _gradients(way, family, inputs, stress.wrt)
    bad = sum(int(_flat(~g.isfinite()).any(1).sum()) for g in found if g.numel())
    if not family.smooth or not family.inside:
        return None, None, bad
    exact_inputs = tuple(x.double() for x in inputs)
    if inputs[0].dtype == DOUBLE:
        error = _differences(stress, way, family, exact_inputs, found)
    elif (judge := _judge(stress, way)) is not None:
        true, true_valid = _gradients(judge, family, exact_inputs, stress.wrt)
        # a mask that flips by rounding changes the sum: nothing to compare then
        error = _gradient_error(found, true) if torch.equal(valid, true_valid) else None
    else:
        error = None
    gains = [
        float((g.double() * x.double()).abs().max()) / float(np.min(size))
        for g, x in zip(found, (inputs[i] for i in stress.wrt), strict=True)
        if g.numel()
    ]
    kept = [g for g in gains if np.isfinite(g)]
    return error, max(kept) if kept else None, bad


def _judge(stress: Stress, way: Way) -> Way | None:
    """Whose float64 gradient is the reference: its own, or that of our plain torch."""
    if DOUBLE in way.dtypes:
        return way
    return next((w for w in stress.ways if w.ours and way.ours and DOUBLE in w.dtypes), None)


ROOMS = {
    "rotations": "Rotations and affine maps",
    "skinning": "Kinematics, skinning, bodies",
    "surface": "Surfaces",
    "cameras": "Cameras and rays",
    "fields": "Encodings, networks, grids",
    "volume": "Compositing and parts",
}
"""Groups of operations, each a module ``stability_NAME`` and a heat map."""


def stresses() -> dict[str, list[Stress]]:
    """All operations, by room."""
    names = {room: f"{__package__}.stability_{room}" for room in ROOMS}
    return {room: importlib.import_module(name).stresses() for room, name in names.items()}


def run(
    which: Sequence[Stress],
    factor: float = 1.0,
    peers: bool = True,
    say: Callable[[str], None] = lambda text: print(text, file=sys.stderr, flush=True),
) -> Outcome:
    """Run operations on all their families.

    Args:
        which: the operations.
        factor: of the number of cases.
        peers: run other libraries too.
        say: told of the progress.
    """
    outcome = Outcome()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # peers warn of what is measured here
        for stress in which:
            say(f"{stress.name}: {stress.title}")
            for way in stress.ways:
                missing = way.absent()
                if missing is not None:
                    outcome.absent[way.name] = missing
                elif way.ours or peers:
                    outcome.cells += _cells(stress, way, factor)
    return outcome


def _cells(stress: Stress, way: Way, factor: float) -> Iterator[Cell]:
    cases = max(8, round(stress.cases * factor))
    for family in filter(way.serves, stress.families):
        for dtype in way.dtypes:
            if dtype in HALVES and not family.halves:
                continue
            yield measure(stress, family, way, dtype, cases)


def write_json(outcome: Outcome, path: Path) -> None:
    """Write all cells.

    Args:
        outcome: the run.
        path: the file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    cells = [dataclasses.asdict(c) | {"ulp": c.ulp} for c in outcome.cells]
    data = {"schema": SCHEMA, "cases": outcome.cases, "absent": outcome.absent, "cells": cells}
    path.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def chosen(names: Sequence[str]) -> dict[str, list[Stress]]:
    """The operations of the given names, all where none is given, by room.

    Raises:
        InputError: an unknown name.
    """
    rooms = stresses()
    every = [s.name for own in rooms.values() for s in own]
    for name in names:
        if name not in every:
            raise InputError(f"--only: expected one of {', '.join(every)}, found {name!r}")
    kept = {r: [s for s in own if not names or s.name in names] for r, own in rooms.items()}
    return {room: own for room, own in kept.items() if own}
