"""Runs operations and collects their tables."""

import sys
from collections.abc import Callable, Iterable, Sequence
from importlib import metadata
from typing import Any

from monopart.geometry.errors import InputError, MonopartError

from .registry import Method, Operation, Problem, Settings
from .results import Absence, Report, Row, Table, finite
from .timing import Timing, measure, spread, timed

PEERS = (
    *("open3d", "libigl", "trimesh", "fcpw", "scipy", "pykdtree", "rtree", "smplx"),
    *("body-models", "kornia", "roma", "opencv-contrib-python-headless"),
)


def say(text: str) -> None:
    """Progress goes to stderr."""
    print(text, file=sys.stderr, flush=True)


def environment() -> dict[str, Any]:
    """Machine, versions of our packages and of the peers."""
    from monopart.toolkit.environment import environment_facts

    peers: dict[str, str | None] = {}
    for name in PEERS:
        try:
            peers[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            peers[name] = None
    return environment_facts() | {"peers": peers}


def chosen(operations: Sequence[Operation], only: Iterable[str]) -> list[Operation]:
    """The operations of the given names, all where none is given.

    Raises:
        InputError: an unknown name.
    """
    known = {o.name: o for o in operations}
    for name in only:
        if name not in known:
            raise InputError(f"--only: expected one of {', '.join(known)}, found {name!r}")
    return [o for o in operations if not only or o.name in set(only)]


def run_suite(
    name: str,
    operations: Sequence[Operation],
    settings: Settings,
    keep: Callable[[Report], Any] = lambda report: None,
) -> Report:
    """Run the chosen operations one after the other.

    Args:
        name: of the suite.
        operations: all of them.
        settings: what the command line asked for.
        keep: called with the report so far after every operation: an interrupt loses little.
    """
    report = Report(name, settings.quick, environment(), [])
    for operation in chosen(operations, settings.only):
        report.tables.append(run_operation(operation, settings))
        keep(report)
    return report


def run_operation(operation: Operation, settings: Settings) -> Table:
    """Compare all methods of an operation on all its problems."""
    say(f"{operation.name}: {operation.title}")
    absent: dict[str, str] = {}
    present: list[Method] = []
    for method in operation.methods:
        reason = method.absent(settings.quick)
        if reason is None:
            present.append(method)
        else:
            absent[method.name] = reason
    rows: list[Row] = []
    for problem in operation.problems(settings):
        say(f"  {problem.size} {problem.setting}")
        rows += _rows(operation, present, problem, settings, absent)
    return Table(
        operation.name,
        operation.title,
        operation.error,
        rows,
        [Absence(name, reason) for name, reason in absent.items()],
        list(operation.notes),
    )


def _rows(
    operation: Operation,
    methods: list[Method],
    problem: Problem,
    settings: Settings,
    absent: dict[str, str],
) -> list[Row]:
    """All methods on one problem; what breaks is reported as absent and not tried again."""
    calls: dict[str, Callable[[], Any]] = {}
    once: dict[str, tuple[float, float, Any]] = {}
    used: dict[str, Method] = {}
    for method in methods:
        too_large = (method.largest or problem.size) < problem.size
        if method.name in absent or too_large or (method.rare and not problem.thorough):
            continue
        try:
            call = method.prepare(problem.data)
            first = timed(call)
        except (ImportError, AttributeError, RuntimeError, TypeError, ValueError) as error:
            if method.ours and not isinstance(error, ImportError | MonopartError):
                raise
            line = " ".join(str(error).split())[:160]
            absent[method.name] = f"did not run ({type(error).__name__}: {line}); {method.install}"
            say(f"  {method.name}: {absent[method.name]}")
            continue
        used[method.name] = method
        if method.single:
            once[method.name] = first
        else:
            calls[method.name] = call
    effort = problem.effort if problem.effort and not settings.quick else settings.effort
    timings, results = measure(calls, effort, warm=True)
    for name, (wall, cpu, result) in once.items():
        timings[name], results[name] = Timing(spread([wall]), spread([cpu])), result
    rows = []
    for name, timing in timings.items():
        read = used[name].read
        result = results[name] if read is None else read(results[name])
        figures = {k: finite(v) for k, v in operation.judge(problem.data, result).items()}
        error = figures.pop("error", None)
        facts = {k: v for k, v in figures.items() if v is not None}
        rows.append(
            Row(
                name,
                used[name].ours,
                problem.size,
                problem.setting,
                timing.wall,
                timing.cpu,
                error,
                facts,
            )
        )
    return rows
