"""``monopart-bench publish``: reports into a page of the documentation, in place."""

import shutil
from collections.abc import Sequence
from pathlib import Path

from monopart.geometry.errors import InputError

from .results import Report, Table, read_report, summarise
from .show import cells, growth, machine_line, pareto
from .training import curve_plot

BEGIN, END = "<!-- {}: begin -->", "<!-- {}: end -->"
HEAD = ["size", "method", "median", "IQR", "CPU", "× ours", "error", "also"]
_KEPT = (0, 1, 2, 4, 5, 6, 8, 9)  # columns of `show.cells` that the page has


def section(report: Report, name: str, folder: str) -> str:
    """The tables of a report, short, with links to its plots.

    Args:
        report: the report.
        name: of its file, which its plots begin with.
        folder: where the plots lie, relative to the page.
    """
    out = [machine_line(report), ""]
    for table in report.tables:
        out += [f"### {table.title}", "", f"Error: {table.error}.", ""]
        out += ["| " + " | ".join(HEAD) + " |", "|" + "---|" * len(HEAD)]
        for summary in summarise(table):
            row = cells(summary)
            out.append("| " + " | ".join(row[i] for i in _KEPT) + " |")
        out.append("")
        out += [f"- Absent: {a.method}: {a.reason}" for a in table.absent]
        out += [f"- {note}" for note in table.notes]
        out += [
            "",
            *(f"![{table.title}]({folder}/{file})" for file in plots(report, name, table)),
            "",
        ]
    return "\n".join(out).strip() + "\n"


def plots(report: Report, name: str, table: Table) -> dict[str, str]:
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
    if len([s for s in summaries if s.error is not None]) > 1 and report.suite != "scaling":
        found[f"{stem}_pareto.svg"] = pareto(table)
    if len({s.size for s in summaries}) > 1:
        found[f"{stem}_growth.svg"] = growth(table)
    return found


def publish(reports: Sequence[Path], page: Path) -> list[str]:
    """Write reports into a page, each between the marks of its suite.

    The JSON of a report and its plots are put into a folder beside the page, named as the page.

    Args:
        reports: JSON files of this program.
        page: a Markdown file that holds ``<!-- SUITE: begin -->`` and ``<!-- SUITE: end -->``.

    Returns:
        The suites that were written.

    Raises:
        InputError: no such page, no marks for a suite, or a report of tiny problems.
    """
    try:
        text = page.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{page}: expected a Markdown page, found {error.strerror}") from None
    read = [(path, read_report(path)) for path in reports]
    folder = page.with_suffix("")
    for path, report in read:
        if report.quick:
            raise InputError(f"{path}: expected measurements, found a --quick run; run it in full")
        name = path.stem
        begin, end = BEGIN.format(name), END.format(name)
        if begin not in text or end not in text:
            raise InputError(
                f"{page}: expected the marks {begin} and {end}; add them where it goes"
            )
        before, rest = text.split(begin, 1)
        after = rest.split(end, 1)[1]
        text = f"{before}{begin}\n{section(report, name, folder.name)}{end}{after}"
    folder.mkdir(exist_ok=True)
    for path, report in read:
        shutil.copyfile(path, folder / path.name)
        for table in report.tables:
            for file, plot in plots(report, path.stem, table).items():
                (folder / file).write_text(plot, encoding="utf-8")
    page.write_text(text, encoding="utf-8")
    return [path.stem for path, _ in read]
