"""What a stress is made of: families of inputs, implementations, and what a run found."""

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

Inputs = tuple[Tensor, ...]
SINGLE, DOUBLE = torch.float32, torch.float64
HALVES = (torch.float16, torch.bfloat16)
Backend = Literal["warp", "torch"]


def kinds_of(backend: Backend) -> tuple[torch.dtype, ...]:
    """Precisions of a back end: kernels are made for float32."""
    return (SINGLE,) if backend == "warp" else (SINGLE, DOUBLE)


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
    large: bool = False
    """Only in exhaustive runs; ``extra`` is a function that makes it then."""
    halves: bool = True
    """Inside the range of float16 too."""


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
class Slopes:
    """What was found of gradients."""

    error: float | None = None
    """Largest error of the gradient: against float64, or of float64 against differences."""
    spread: float | None = None
    """The same of the exact gradient where each input is moved by one last place."""
    amplification: float | None = None
    """Largest |gradient| times |input| over |result|: what a relative error is multiplied by."""
    bad: int = 0
    """Rows (or entries) of gradients that are not finite."""


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
    slopes: Slopes
    """Of the gradients."""
    bad_values: int
    """Rows that are not finite and not masked."""
    raised: str = ""
    """The error that stopped it, if any."""

    @property
    def gradient(self) -> float | None:
        """Largest error of the gradient."""
        return self.slopes.error

    @property
    def bad_gradients(self) -> int:
        """Gradients that are not finite."""
        return self.slopes.bad

    @property
    def kind(self) -> torch.dtype:
        """The precision."""
        return getattr(torch, self.dtype)

    @property
    def ulp(self) -> float | None:
        """The value error in units of the last place of the scale."""
        return None if self.value is None else self.value / torch.finfo(self.kind).eps

    def as_dict(self) -> dict[str, Any]:
        """All figures, flat, as JSON takes them."""
        slopes = {"gradient": self.gradient, "gradient_spread": self.slopes.spread}
        slopes |= {"amplification": self.slopes.amplification, "bad_gradients": self.slopes.bad}
        kept = {k: v for k, v in vars(self).items() if k != "slopes"}
        return kept | slopes | {"ulp": self.ulp}


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
