"""Results of a benchmark, written as JSON and read back strictly."""

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from monopart.geometry.errors import InputError

from .timing import Spread

SCHEMA = 1


@dataclass(frozen=True)
class Row:
    """One method on one problem."""

    method: str
    """Name of the method."""
    ours: bool
    """Whether it is part of monopart."""
    size: int
    """Size of the problem."""
    setting: str
    """What else tells the problem from others."""
    wall: Spread
    """Wall-clock seconds."""
    cpu: Spread
    """Processor seconds."""
    error: float | None
    """Error against the oracle; None where there is none."""
    facts: dict[str, float]
    """Other figures."""


@dataclass(frozen=True)
class Absence:
    """A method that did not run."""

    method: str
    """Name of the method."""
    reason: str
    """Why, and how to install it."""


@dataclass(frozen=True)
class Table:
    """All rows of one operation."""

    operation: str
    """Short name."""
    title: str
    """Heading."""
    error: str
    """What the error is, with its unit."""
    rows: list[Row]
    """Every method on every problem."""
    absent: list[Absence]
    """Methods that could not run."""
    notes: list[str]
    """What a reader must know."""


@dataclass(frozen=True)
class Report:
    """One run of ``monopart-bench``."""

    suite: str
    """geometry, fields, training, render, skipping or scaling."""
    quick: bool
    """Whether the problems were tiny."""
    environment: dict[str, Any]
    """Machine and versions."""
    tables: list[Table]
    """One per operation."""


@dataclass(frozen=True)
class Summary:
    """A method at one size, over all settings."""

    method: str
    """Name."""
    ours: bool
    """Whether it is part of monopart."""
    size: int
    """Size of the problems."""
    wall: float
    """Median over the settings of the median wall-clock seconds."""
    low: float
    """Smallest wall-clock seconds of all."""
    iqr: float
    """Median over the settings of the interquartile range, seconds."""
    cpu: float
    """Median over the settings of the median CPU seconds."""
    error: float | None
    """Largest error of all settings."""
    ratio: float | None
    """Median over the settings of wall-clock seconds relative to our first method."""
    cpu_ratio: float | None
    """The same of the CPU seconds."""
    facts: dict[str, float]
    """Other figures, mean over the settings."""
    problems: int
    """Number of settings it ran on."""
    of: int
    """Number of settings of that size."""


def write_report(report: Report, path: Path, short: bool = False) -> None:
    """Write a report as JSON.

    Args:
        report: the report.
        path: the file.
        short: numbers with five digits and no line breaks, a quarter of the bytes.
    """
    data: Any = {"schema": SCHEMA} | dataclasses.asdict(report)
    indent, separators = (None, (",", ":")) if short else (1, None)
    data = _shortened(data) if short else data
    text = json.dumps(data, indent=indent, separators=separators, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def _shortened(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _shortened(value) for key, value in data.items()}
    if isinstance(data, list):
        return [_shortened(value) for value in data]
    return float(f"{data:.5g}") if isinstance(data, float) else data


def read_report(path: Path) -> Report:
    """Read a report back.

    Raises:
        InputError: no such file, or not a report of this version.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: expected a benchmark's JSON, found {error.strerror}") from None
    except ValueError as error:
        raise InputError(f"{path}: expected JSON, found {error}; run the benchmark anew") from None
    if not isinstance(data, dict) or data.pop("schema", None) != SCHEMA:
        raise InputError(f"{path}: expected a report of schema {SCHEMA}; run the benchmark anew")
    try:
        tables = [_table(t) for t in data.pop("tables")]
        return Report(tables=tables, **data)
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: damaged report ({error}); run the benchmark anew") from None


def _table(data: dict[str, Any]) -> Table:
    rows = [
        Row(**{**row, "wall": Spread(**row["wall"]), "cpu": Spread(**row["cpu"])})
        for row in data["rows"]
    ]
    absent = [Absence(**a) for a in data["absent"]]
    return Table(**{**data, "rows": rows, "absent": absent})


def finite(value: float | int | None) -> float | None:
    """The value, or None for NaN and infinity, which JSON does not know."""
    return None if value is None or not math.isfinite(value) else float(value)


def _median(values: list[float]) -> float:
    ordered = sorted(values)
    half = len(ordered) // 2
    return ordered[half] if len(ordered) % 2 else (ordered[half - 1] + ordered[half]) / 2


def summarise(table: Table) -> list[Summary]:
    """Methods of a table by size, over all settings, in the order of size and time."""
    ours = next((r.method for r in table.rows if r.ours), None)
    base = {(r.size, r.setting): r for r in table.rows if r.method == ours}
    groups: dict[tuple[int, str], list[Row]] = {}
    settings: dict[int, set[str]] = {}
    for row in table.rows:
        groups.setdefault((row.size, row.method), []).append(row)
        settings.setdefault(row.size, set()).add(row.setting)
    result = []
    for (size, method), rows in groups.items():
        errors = [r.error for r in rows if r.error is not None]
        pairs = [(r, base[r.size, r.setting]) for r in rows if (r.size, r.setting) in base]
        ratios = [r.wall.median / max(b.wall.median, 1e-12) for r, b in pairs]
        cpu_ratios = [r.cpu.median / max(b.cpu.median, 1e-12) for r, b in pairs]
        names = {name for r in rows for name in r.facts}
        means = {n: [r.facts[n] for r in rows if n in r.facts] for n in sorted(names)}
        result.append(
            Summary(
                method,
                rows[0].ours,
                size,
                _median([r.wall.median for r in rows]),
                min(r.wall.min for r in rows),
                _median([r.wall.q3 - r.wall.q1 for r in rows]),
                _median([r.cpu.median for r in rows]),
                max(errors) if errors else None,
                _median(ratios) if ratios else None,
                _median(cpu_ratios) if cpu_ratios else None,
                {n: sum(v) / len(v) for n, v in means.items()},
                len(rows),
                len(settings[size]),
            )
        )
    return sorted(result, key=lambda s: (s.size, s.wall))
