"""Tables for people: on the terminal, as Markdown, and as plots."""

from collections.abc import Sequence
from pathlib import Path

from .plots import Dots, log_plot
from .results import Report, Row, Summary, Table, summarise, write_report

FLOOR = 1e-9
"""Errors below this are drawn here: a logarithmic axis has no zero."""


def seconds(value: float | int) -> str:
    """A duration with a unit.

    >>> seconds(0.0123)
    '12.3 ms'
    """
    for unit, scale in (("s", 1.0), ("ms", 1e3)):
        if value * scale >= 1.0:
            return f"{value * scale:.3g} {unit}"
    return f"{value * 1e6:.3g} µs"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.2g}"


def _ratio(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def _facts(summary: Summary) -> str:
    shown = [f"{name} {value:.4g}" for name, value in summary.facts.items()]
    if summary.problems < summary.of:  # ratios pair the same problems, medians and means do not
        shown.append(f"on {summary.problems} of {summary.of} problems")
    return ", ".join(shown)


def cells(summary: Summary) -> list[str]:
    """One row of a table."""
    return [
        str(summary.size),
        ("**" + summary.method + "**") if summary.ours else summary.method,
        seconds(summary.wall),
        seconds(summary.low),
        seconds(summary.iqr),
        seconds(summary.cpu),
        _ratio(summary.ratio),
        _ratio(summary.cpu_ratio),
        _number(summary.error),
        _facts(summary),
    ]


HEAD = ["size", "method", "median", "min", "IQR", "CPU", "× ours", "CPU × ours", "error", "also"]


def print_report(report: Report) -> None:
    """Print the tables of a report."""
    from rich.console import Console
    from rich.table import Table as RichTable

    console = Console()
    console = Console(width=max(console.width, 128))
    for table in report.tables:
        grid = RichTable(title=table.title, caption=f"error: {table.error}")
        for name in HEAD:
            left = name in ("method", "also")
            grid.add_column(name, justify="left" if left else "right", no_wrap=name != "also")
        for summary in summarise(table):
            row = cells(summary)
            row[1] = f"[bold]{summary.method}[/bold]" if summary.ours else summary.method
            grid.add_row(*row)
        console.print(grid)
        for absence in table.absent:
            console.print(f"absent: {absence.method}: {absence.reason}", markup=False)
        for note in table.notes:
            console.print(f"note: {note}", markup=False)


def machine_line(report: Report) -> str:
    """Machine, versions and commit of a report, one line of Markdown."""
    facts = report.environment
    versions = facts["packages"] | facts["peers"]
    shown = ", ".join(f"{name} {version}" for name, version in versions.items() if version)
    return (
        f"*{facts['cpu']}, {facts['cores']} cores, {facts['threads']} threads; "
        f"Python {facts['python']}; {shown}; commit {facts['git_commit'] or 'of the wheel'}.*"
    )


def markdown(report: Report) -> str:
    """The tables of a report as Markdown."""
    out = [machine_line(report), ""]
    for table in report.tables:
        out += [f"### {table.title}", "", f"Error: {table.error}.", ""]
        out += ["| " + " | ".join(HEAD) + " |", "|" + "---|" * len(HEAD)]
        out += ["| " + " | ".join(cells(s)) + " |" for s in summarise(table)]
        out.append("")
        out += [f"- Absent: {a.method}: {a.reason}" for a in table.absent]
        out += [f"- {note}" for note in table.notes]
        out.append("")
    return "\n".join(out).rstrip() + "\n"


def _named(summary: Summary) -> str:
    few = f" ({summary.problems} of {summary.of})" if summary.problems < summary.of else ""
    return summary.method + few


def main_size(summaries: Sequence[Summary]) -> int:
    """The size that most problems have, and of several the one with most methods; 0 for none."""
    counts: dict[int, tuple[int, int]] = {}
    for summary in summaries:
        problems, methods = counts.get(summary.size, (0, 0))
        counts[summary.size] = (max(problems, summary.of), methods + 1)
    return max(counts, key=lambda size: (*counts[size], size), default=0)


def pareto(table: Table) -> str:
    """Run time against error, one dot per method, at the size on which most was measured."""
    summaries = [s for s in summarise(table) if s.error is not None]
    size = main_size(summaries)
    series = [
        Dots(_named(s), [s.wall], [max(s.error or 0.0, FLOOR)], bold=s.ours)
        for s in summaries
        if s.size == size
    ]
    return log_plot(series, f"{table.title} ({size})", "median seconds", table.error, front=True)


def growth(table: Table) -> str:
    """Run time against size, one line per method."""
    lines: dict[str, list[Summary]] = {}
    for summary in summarise(table):
        lines.setdefault(summary.method, []).append(summary)
    series = [
        Dots(name, [float(s.size) for s in own], [s.wall for s in own], True, own[0].ours)
        for name, own in lines.items()
    ]
    return log_plot(series, table.title, "size", "median seconds")


def curve_plot(rows: list[Row], clock: str) -> str:
    """PSNR of held-out views against seconds, one line per preset.

    Args:
        rows: of the table "curve".
        clock: "cpu" or "wall".
    """
    series = []
    for name in dict.fromkeys(r.method for r in rows):
        own = [r for r in rows if r.method == name and r.wall.median > 0]
        times = [(r.cpu if clock == "cpu" else r.wall).median for r in own]
        series.append(Dots(name, times, [r.facts["PSNR"] for r in own], True, True))
    label = "CPU seconds" if clock == "cpu" else "wall-clock seconds"
    return log_plot(series, "Training", label, "PSNR of held-out views, dB", log_y=False)


def table_plots(report: Report, name: str, table: Table) -> dict[str, str]:
    """Plots of a table as SVG by file name: time against error, and against size.

    Args:
        report: the report.
        name: of its file.
        table: one of its tables.
    """
    found, summaries = {}, summarise(table)
    stem = f"{name}_{table.operation}"
    if report.suite.startswith("training"):
        clocks = ("cpu", "wall") if table.operation == "curve" else ()
        return {f"{stem}_{clock}.svg": curve_plot(table.rows, clock) for clock in clocks}
    if len([s for s in summaries if s.error is not None]) > 1:
        found[f"{stem}_pareto.svg"] = pareto(table)
    if len({s.size for s in summaries}) > 1:
        found[f"{stem}_growth.svg"] = growth(table)
    return found


def save_report(report: Report, out: Path) -> Path:
    """Write the JSON, the Markdown and the plots of a report into a folder.

    Returns:
        The JSON file.
    """
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"{report.suite}.json"
    write_report(report, path)
    (out / f"{report.suite}.md").write_text(markdown(report), encoding="utf-8")
    for table in report.tables:
        for name, plot in table_plots(report, report.suite, table).items():
            (out / name).write_text(plot, encoding="utf-8")
    return path
