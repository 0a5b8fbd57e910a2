"""``monopart-bench publish``: reports into a page of the documentation, in place."""

from collections.abc import Sequence
from pathlib import Path

from monopart.geometry.atomic import write_text
from monopart.geometry.errors import InputError

from .results import Report, Row, Summary, Table, read_report, summarise, write_report
from .sections import read_page, with_section
from .show import cells, machine_line, main_size, seconds, table_plots

HEAD = ["method", "median", "IQR", "CPU", "× ours", "CPU × ours", "error", "also"]
_KEPT = (1, 2, 4, 5, 6, 7, 8, 9)  # columns of `show.cells` that the page has


def section(report: Report, name: str, folder: str) -> str:
    """The tables of a report, short, with links to its plots.

    Args:
        report: the report.
        name: of its file, which its plots begin with.
        folder: where the plots lie, relative to the page.
    """
    out = [machine_line(report), ""]
    for table in report.tables:
        summaries = summarise(table)
        out += [f"### {table.title}", ""]
        if report.suite.startswith("training"):
            out += _times(table) if table.operation == "time_to" else []
        else:
            out += _compared(table, summaries) + _grown(summaries)
            out += [f"- Absent: {a.method}: {a.reason}" for a in table.absent]
        out += [f"- {note}" for note in table.notes]
        files = table_plots(report, name, table)
        out += ["", *(f"![{table.title}]({folder}/{file})" for file in files), ""]
    return "\n".join(out).strip() + "\n"


def grid(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table.

    Args:
        head: of the columns.
        rows: cells.

    Returns:
        The lines, an empty one last.
    """
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return [*lines, *("| " + " | ".join(row) + " |" for row in rows), ""]


def _compared(table: Table, summaries: list[Summary]) -> list[str]:
    """All figures, at the size on which most was measured; of growth, none."""
    if table.error == "none":
        return []
    size = main_size(summaries)
    rows = [cells(s) for s in summaries if s.size == size]
    shown = [[row[i] for i in _KEPT] for row in rows]
    return [f"Size {size}. Error: {table.error}.", "", *grid(HEAD, shown)]


def _grown(summaries: list[Summary]) -> list[str]:
    """Median seconds of every method at every size, where there are several."""
    sizes = sorted({s.size for s in summaries})
    if len(sizes) < 2:
        return []
    at = {(s.method, s.size): seconds(s.wall) for s in summaries}
    ours = {s.method: s.ours for s in summaries}
    rows = [
        [f"**{name}**" if bold else name, *(at.get((name, size), "") for size in sizes)]
        for name, bold in ours.items()
    ]
    return grid(["median by size", *(str(size) for size in sizes)], rows)


def _times(table: Table) -> list[str]:
    """CPU seconds, and seconds of the clock, to each PSNR: a row per preset."""
    targets = sorted({row.size for row in table.rows})
    at = {(row.method, row.size): _time(row) for row in table.rows}
    names = dict.fromkeys(r.method for r in table.rows)
    rows = [[name, *(at.get((name, target), "–") for target in targets)] for name in names]
    text = "CPU seconds (seconds of the clock) to a PSNR in dB; – where it was not reached."
    return [text, "", *grid(["preset", *(f"{t / 10:g}" for t in targets)], rows)]


def _time(row: Row) -> str:
    shown = f"{row.cpu.median:.0f} ({row.wall.median:.0f})"
    found, seeds = row.facts["seeds"], row.facts.get("of seeds", 1.0)
    return shown if found == seeds else f"{shown}, {found:.0f} of {seeds:.0f} seeds"


def publish(reports: Sequence[Path], page: Path) -> list[str]:
    """Write reports into a page, each between the marks of its suite.

    A short form of each report and its plots are put into a folder beside the page, named as the
    page.

    Args:
        reports: JSON files of this program; none means those in that folder.
        page: a Markdown file that holds ``<!-- SUITE: begin -->`` and ``<!-- SUITE: end -->``.

    Returns:
        The suites that were written.

    Raises:
        InputError: no such page, no marks for a suite, a report of tiny problems, or no report.
    """
    text = read_page(page)
    folder = page.with_suffix("")
    read = [(path, read_report(path)) for path in reports or sorted(folder.glob("*.json"))]
    if not read:
        raise InputError(f"{folder}: expected reports, found none; name the files to publish")
    for path, report in read:
        if report.quick:
            raise InputError(f"{path}: expected measurements, found a --quick run; run it in full")
        name = path.stem
        text = with_section(text, page, name, section(report, name, folder.name))
    folder.mkdir(exist_ok=True)
    for path, report in read:
        write_report(report, folder / path.name, short=True)
        for table in report.tables:
            for file, plot in table_plots(report, path.stem, table).items():
                (folder / file).write_text(plot, encoding="utf-8")
    write_text(page, text)
    return [path.stem for path, _ in read]
