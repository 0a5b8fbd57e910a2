"""What a benchmark is made of: operations, the methods that carry them out, and their problems."""

import importlib
import importlib.util
import sys
import types
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .timing import Effort


@dataclass(frozen=True)
class Settings:
    """What the command line asked for."""

    quick: bool = False
    """Tiny problems, to see that everything runs; the figures mean nothing."""
    capture: Path | None = None
    """A capture whose body poses join the list of poses, or that is trained on."""
    run: Path | None = None
    """A trained run, for rendering."""
    only: tuple[str, ...] = ()
    """Names of the operations to run; empty for all."""
    presets: tuple[str, ...] = ()
    """Presets to train; empty for all."""
    poses: int = 20
    """Poses on which geometry is measured."""
    seconds: float = 240.0
    """Budget of each training, seconds."""
    cpu_budget: bool = False
    """Whether the budget is of CPU seconds, not of those of the clock."""
    seeds: tuple[int, ...] = (0,)
    """Seeds with which each preset is trained."""

    @property
    def effort(self) -> Effort:
        """How often methods are run."""
        return Effort(1, 1, 0.0) if self.quick else Effort()


@dataclass(frozen=True)
class Problem:
    """One input on which all methods of an operation are compared."""

    size: int
    """Number of points, bodies, rays or the like."""
    setting: str
    """What else tells the problem from others of the same size."""
    data: Any
    """What the methods read."""
    effort: Effort | None = None
    """How often methods are run, where it is not the settings' own."""
    thorough: bool = True
    """Whether methods that are marked as rare run, too."""


@dataclass(frozen=True)
class Method:
    """One way to carry out an operation; a peer says whether it is there and how to install it."""

    name: str
    """Shown in tables."""
    prepare: Callable[[Any], Callable[[], Any]]
    """Gets the data of a problem, does what is not timed and returns the timed call."""
    modules: tuple[str, ...] = ()
    """Top-level modules that must be importable."""
    install: str = ""
    """Command that installs them."""
    ours: bool = False
    """Whether it is part of monopart."""
    largest: int | None = None
    """Problems above this size are left out."""
    read: Callable[[Any], Any] | None = None
    """Brings an untimed result into the form that the judge expects."""
    needs: Callable[[], str | None] | None = None
    """Another reason for absence, or None."""
    rare: bool = False
    """Takes seconds a run: only on problems that ask for it, three of twenty."""
    single: bool = False
    """Takes many seconds a run: its one run is the timed one."""
    slow_start: bool = False
    """Takes seconds to prepare: left out of quick runs."""

    def absent(self, quick: bool = False) -> str | None:
        """Why the method does not run here, with the install line; None where it does."""
        if quick and self.slow_start:
            return "left out by --quick"
        for name in self.modules:
            if importlib.util.find_spec(name) is None:
                return f"not installed; {self.install}"
        return self.needs() if self.needs is not None else None


@dataclass(frozen=True)
class Operation:
    """An operation with its methods, problems and measure of error."""

    name: str
    """Short, for the command line and file names."""
    title: str
    """Heading of its table."""
    error: str
    """What the error is, with its unit."""
    methods: tuple[Method, ...]
    """The first one of ours is what ratios refer to."""
    problems: Callable[[Settings], Iterable[Problem]]
    """Made when the operation runs, one at a time."""
    judge: Callable[[Any, Any], dict[str, float]]
    """Data and result to figures; ``error`` among them."""
    notes: tuple[str, ...] = field(default=())
    """What a reader of the table must know."""


def load(name: str) -> Any:
    """A module of a peer, untyped: the type checker need not find it."""
    return importlib.import_module(name)


_DISPLAYS = ("dash", "plotly", "plotly.graph_objects")


class _Nothing(types.ModuleType):
    """In the place of a module of which nothing is used."""

    __path__ = []  # noqa: RUF012 - a module may be looked into: a package without modules

    def __getattr__(self, name: str) -> type:
        if name.startswith("__"):
            raise AttributeError(name)
        return object


def load_open3d() -> Any:
    """Open3D, which can be imported here without the packages that it draws with.

    It imports a web server for its figures (and pytest breaks on that server's plugin); where one
    is not installed, an empty module stands in its place during the import, and is gone after it.

    Raises:
        ImportError: Open3D is not installed or does not run.
    """
    missing = [n for n in _DISPLAYS if importlib.util.find_spec(n.partition(".")[0]) is None]
    stand_ins = {name: _Nothing(name) for name in missing if name not in sys.modules}
    sys.modules.update(stand_ins)
    try:
        return load("open3d")
    finally:
        for name in stand_ins:
            del sys.modules[name]
