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
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.errors import InputError

from .stability_cases import (
    DOUBLE,
    HALVES,
    Cell,
    Family,
    Inputs,
    Outcome,
    Slopes,
    Stress,
    Way,
)

SCHEMA = 2
_FLOOR = 1e-3  # gradients below this share of the largest of their family are compared with it
_DRAWS = 3  # of inputs moved by one last place


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
    stress: Stress,
    family: Family,
    inputs: Inputs,
    result: Tensor,
    valid: Tensor,
    known: dict[tuple[str, torch.dtype], np.ndarray],
) -> tuple[float | None, float | None, int, np.ndarray]:
    """Relative and absolute error, rows that are not finite, and the scale of each row."""
    arrays = [x.detach().double().numpy() for x in inputs]
    key = (family.name, inputs[0].dtype)  # the inputs are the same for every implementation
    if key not in known:
        known[key] = np.asarray(stress.exact(family.extra, *arrays), np.float64)
    exact = known[key]
    found = result.detach().double().numpy()
    keep = valid.numpy()
    sound = np.isfinite(_as_rows(found)).all(1)
    size = np.broadcast_to(stress.scale(family.extra, exact, *arrays), (len(found),))
    with np.errstate(all="ignore"):
        off = stress.off or (lambda a, b: np.abs(_as_rows(a) - _as_rows(b)).max(1, initial=0.0))
        gap = off(found, exact)[keep & sound]
        relative = gap / size[keep & sound]
    return _worst(relative), _worst(gap), int((keep & ~sound).sum()), size


def measure(
    stress: Stress,
    family: Family,
    way: Way,
    dtype: torch.dtype,
    cases: int,
    known: dict[tuple[str, torch.dtype], np.ndarray],
) -> Cell:
    """Run one implementation on one family in one precision.

    Args:
        stress: the operation.
        family: the inputs.
        way: the implementation.
        dtype: the precision.
        cases: how many inputs are wanted.
        known: exact results of this operation, kept from one implementation to the next.
    """
    if family.large:
        family = dataclasses.replace(family, extra=family.extra())
    generator = torch.Generator().manual_seed(zlib.crc32(family.name.encode()))
    # rounded to the precision first: the oracle and float64 see the same numbers
    inputs = tuple(x.to(dtype) for x in family.make(generator, min(cases, family.cases or cases)))
    head = (stress.name, family.name, way.name, way.ours, str(dtype).removeprefix("torch."))
    try:
        with torch.no_grad():
            result, valid = _apply(way, family, inputs)
        relative, gap, bad, size = _value_errors(stress, family, inputs, result, valid, known)
        slopes = Slopes()
        if way.differentiable and stress.wrt and len(result):
            slopes = _slopes(stress, family, way, inputs, size)
    except (ImportError, RuntimeError, ValueError, IndexError, TypeError) as error:
        if way.ours:
            raise
        text = f"{type(error).__name__}: {' '.join(str(error).split())[:100]}"
        return Cell(*head, family.inside, 0, 0, None, None, Slopes(), 0, text)
    counts = (len(result), int((~valid).sum()))
    return Cell(*head, family.inside, *counts, relative, gap, slopes, bad)


def _slopes(stress: Stress, family: Family, way: Way, inputs: Inputs, size: np.ndarray) -> Slopes:
    """Error of the gradient, what it is allowed to be, amplification, and how many are bad."""
    found, valid = _gradients(way, family, inputs, stress.wrt)
    bad = sum(int(_flat(~g.isfinite()).any(1).sum()) for g in found if g.numel())
    if not family.smooth or not family.inside:
        return Slopes(bad=bad)
    error, spread = None, None
    exact_inputs = tuple(x.double() for x in inputs)
    if inputs[0].dtype == DOUBLE:
        error = _differences(stress, way, family, exact_inputs, found)
    elif (judge := _judge(stress, way)) is not None:
        true, true_valid = _gradients(judge, family, exact_inputs, stress.wrt)
        # a mask that flips by rounding changes the sum: nothing to compare then
        if torch.equal(valid, true_valid):
            error = _gradient_error(found, true)
            spread = _spread(stress, judge, family, inputs, (true, true_valid))
    gains = [
        float((g.double() * x.double()).abs().max()) / float(np.min(size))
        for g, x in zip(found, (inputs[i] for i in stress.wrt), strict=True)
        if g.numel()
    ]
    kept = [g for g in gains if np.isfinite(g)]
    return Slopes(error, spread, max(kept) if kept else None, bad)


def _spread(
    stress: Stress, judge: Way, family: Family, inputs: Inputs, true: tuple[list[Tensor], Tensor]
) -> float | None:
    """What one last place in the inputs does to the exact gradient: no float can do better.

    Every number is moved, up or down, by one last place of the largest of its row. The change is
    measured as an error would be.
    """
    generator, worst = torch.Generator().manual_seed(29), []
    for _ in range(_DRAWS):
        moved = []
        for x in inputs:
            up = torch.randint(0, 2, x.shape, generator=generator) * 2.0 - 1.0
            size = _largest(x.double()).reshape(-1, *[1] * (x.ndim - 1))
            moved.append(x.double() + torch.finfo(x.dtype).eps * size * up)
        found, valid = _gradients(judge, family, tuple(moved), stress.wrt)
        if torch.equal(valid, true[1]):
            worst.append(_gradient_error(found, true[0]))
    kept = [w for w in worst if w is not None]
    return max(kept) if kept else None


def _judge(stress: Stress, way: Way) -> Way | None:
    """Whose float64 gradient is the reference: its own, or that of our plain torch."""
    if DOUBLE in way.dtypes:
        return way
    return next((w for w in stress.ways if w.ours and way.ours and DOUBLE in w.dtypes), None)


ROOMS = {
    "rotations": "Rotations and affine maps",
    "skinning": "Kinematics, skinning, bodies",
    "surface": "Surfaces",
    "parts": "Signs, shells, parts, roots",
    "cameras": "Cameras and rays",
    "fields": "Encodings, networks, grids",
    "volume": "Compositing and parts",
    "losses": "Losses and retrieval",
    "atlas": "Textures and layouts",
    "graphs": "Meshes as arrays",
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
    large: bool = False,
    say: Callable[[str], None] = lambda text: print(text, file=sys.stderr, flush=True),
) -> Outcome:
    """Run operations on all their families.

    Args:
        which: the operations.
        factor: of the number of cases.
        peers: run other libraries too.
        large: run families that take long too.
        say: told of the progress.
    """
    outcome = Outcome()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # peers warn of what is measured here
        for stress in which:
            say(f"{stress.name}: {stress.title}")
            known: dict[tuple[str, torch.dtype], np.ndarray] = {}
            for way in stress.ways:
                missing = way.absent()
                if missing is not None:
                    outcome.absent[way.name] = missing
                elif way.ours or peers:
                    outcome.cells += _cells(stress, way, factor, large, known)
    return outcome


def _cells(
    stress: Stress,
    way: Way,
    factor: float,
    large: bool,
    known: dict[tuple[str, torch.dtype], np.ndarray],
) -> Iterator[Cell]:
    cases = max(8, round(stress.cases * factor))
    for family in filter(way.serves, stress.families):
        for dtype in way.dtypes:
            if (dtype in HALVES and not family.halves) or (family.large and not large):
                continue
            yield measure(stress, family, way, dtype, cases, known)


def write_json(outcome: Outcome, path: Path) -> None:
    """Write all cells.

    Args:
        outcome: the run.
        path: the file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    cells = [c.as_dict() for c in outcome.cells]
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
