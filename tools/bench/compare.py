"""Two reports side by side: what became faster, slower or less exact between them."""

from dataclasses import dataclass

from .results import Report, Row


@dataclass(frozen=True)
class Change:
    """One method on one problem, in both reports."""

    operation: str
    """Short name."""
    method: str
    """Name."""
    size: int
    """Size of the problem."""
    setting: str
    """What else tells the problem from others."""
    ratio: float
    """Median wall-clock seconds of B over those of A."""
    clear: bool
    """The quartile ranges of A and B do not overlap."""
    errors: tuple[float | None, float | None]
    """Error in A and in B."""


def changes(a: Report, b: Report) -> list[Change]:
    """Rows that both reports have, largest change first."""
    before = dict(_rows(a))
    result = []
    for key, row in _rows(b):
        old = before.get(key)
        if old is None:
            continue
        clear = row.wall.q1 > old.wall.q3 or row.wall.q3 < old.wall.q1
        ratio = row.wall.median / max(old.wall.median, 1e-12)
        operation, method, size, setting = key
        errors = (old.error, row.error)
        result.append(Change(operation, method, size, setting, ratio, clear, errors))
    return sorted(result, key=lambda c: -max(c.ratio, 1 / max(c.ratio, 1e-12)))


def _rows(report: Report) -> list[tuple[tuple[str, str, int, str], Row]]:
    return [
        ((table.operation, row.method, row.size, row.setting), row)
        for table in report.tables
        for row in table.rows
    ]


def print_changes(a: Report, b: Report) -> None:
    """Print the comparison, and what only one of the reports has."""
    from rich.console import Console
    from rich.table import Table as RichTable

    console = Console()
    if a.suite != b.suite or a.quick != b.quick:
        console.print(f"note: A is {a.suite} (quick {a.quick}), B {b.suite} (quick {b.quick})")
    for name in ("cpu", "cores", "threads", "git_commit", "packages", "peers"):
        if a.environment.get(name) != b.environment.get(name):
            old, new = a.environment.get(name), b.environment.get(name)
            console.print(f"{name}: A {old}, B {new}", markup=False)
    grid = RichTable(title="B against A", caption="time B/A; * where the quartiles do not overlap")
    for name in ("operation", "method", "size", "setting", "time B/A", "error A", "error B"):
        grid.add_column(name)
    for c in changes(a, b):
        errors = ["–" if e is None else f"{e:.3g}" for e in c.errors]
        ratio = f"{c.ratio:.2f}{'*' if c.clear else ''}"
        grid.add_row(c.operation, c.method, str(c.size), c.setting, ratio, *errors)
    console.print(grid)
    keys = [{key for key, _ in _rows(report)} for report in (a, b)]
    for name, only in (("A", keys[0] - keys[1]), ("B", keys[1] - keys[0])):
        if only:
            console.print(f"{len(only)} rows are in {name} alone")
