"""The sections of a report, each a function from data to HTML."""

import html
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

from .charts import Series, line_chart
from .metrics import SHAPE
from .report_data import Number, ReportData, SkipRow, Timings

_DIGITS = {"psnr": 2, "ssim": 4, "lpips": 4}
_UNITS = {"psnr": "PSNR ↑ dB", "ssim": "SSIM ↑", "lpips": "LPIPS ↓"}


def escape(value: object) -> str:
    """Text that is safe in HTML, attributes included."""
    return html.escape(str(value), quote=True)


def words(name: str) -> str:
    """A field name as words.

    >>> words("novel_view")
    'novel view'
    """
    return name.replace("_", " ")


def missing(text: str) -> str:
    """Say in words what is not there."""
    return f'<p class="missing">{escape(text)}</p>'


def seconds_text(value: Number | None) -> str:
    """Seconds in the unit that reads best.

    >>> seconds_text(0.0312), seconds_text(8.25), seconds_text(734)
    ('31.2 ms', '8.25 s', '12 min 14 s')
    """
    if value is None:
        return "not measured"
    if not math.isfinite(value):
        return str(value)
    if value < 1:
        return f"{value * 1e3:.3g} ms"
    if value < 99.5:
        return f"{value:.3g} s"
    hours, rest = divmod(round(value), 3600)
    minutes, seconds = divmod(rest, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {seconds} s"


def count_text(value: int | None) -> str:
    """A count with groups of three digits."""
    return "not counted" if value is None else f"{value:,}".replace(",", "\u202f")


def number_text(value: object) -> str:
    """A value in four digits where it is a float, else as it is."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "none"}[value]
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _score_cell(name: str, value: Number | None) -> str:
    if value is None:
        return '<td class="n none">not computed</td>'
    return f'<td class="n">{value:.{_DIGITS.get(name, 4)}f}</td>'


def table(head: Sequence[tuple[str, bool]], rows: Sequence[str]) -> str:
    """A table; `head` holds (text, is a number), `rows` finished lines."""
    cells = "".join(f"<th{' class=n' * right}>{escape(text)}</th>" for text, right in head)
    return (
        f'<div class="scroll"><table><thead><tr>{cells}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def section(name: str, title: str, lead: str, body: str) -> str:
    """A section with an anchor."""
    text = f'<p class="lead">{escape(lead)}</p>' if lead else ""
    return f'<section id="{name}"><h2>{escape(title)}</h2>{text}{body}</section>'


def curves_section(rows: Sequence[Mapping[str, Any]]) -> str:
    """Loss and PSNR against training time."""
    if not rows:
        body = missing("No training log was given, so there are no curves.")
        return section("training", "Training", "", body)
    times = [float(row.get("seconds") or 0.0) for row in rows]
    names = list(dict.fromkeys(n for row in rows for n in (row.get("losses") or {})))
    losses = [
        Series(words(n), times, [(row.get("losses") or {}).get(n) for row in rows], smooth=True)
        for n in names
    ]
    psnr = []
    if any(row.get("psnr") is not None for row in rows):
        psnr.append(Series("training rays", times, [r.get("psnr") for r in rows], smooth=True))
    if any(row.get("val_psnr") is not None for row in rows):
        psnr.append(Series("held-out", times, [r.get("val_psnr") for r in rows], marks=True))
    label = "training time, seconds"
    charts = line_chart(
        losses, title="Loss", x_label=label, y_label="logarithmic", log_y=True
    ) + line_chart(psnr, title="PSNR", x_label=label, y_label="dB")
    last = rows[-1]
    lead = f"{len(rows)} log rows; the last at {seconds_text(times[-1])}"
    if last.get("iteration") is not None:
        lead += f", iteration {last['iteration']}"
    lead += ". The bold line is a moving average."
    return section("training", "Training", lead, f'<div class="charts">{charts}</div>')


def metrics_section(data: ReportData) -> str:
    """Our table, and the peers beside it."""
    rows, null = [], False
    for split, protocols in data.metrics.items():
        for protocol, regions in protocols.items():
            if protocol == SHAPE:  # has a table of its own
                continue
            for region, scores in regions.items():
                null = null or any(scores.get(n) is None for n in _DIGITS)
                cells = "".join(_score_cell(n, scores.get(n)) for n in _DIGITS)
                names = "".join(
                    f'<td class="name">{escape(words(n))}</td>' for n in (split, protocol, region)
                )
                rows.append(f"<tr>{names}{cells}</tr>")
    head = [("Split", False), ("Protocol", False), ("Region", False)]
    body = (
        table(head + [(t, True) for t in _UNITS.values()], rows)
        if rows
        else missing("Not evaluated yet: run monopart eval on this run folder.")
    )
    if null:
        body += (
            '<p class="small lead">“Not computed” means that what the metric needs was absent, '
            "such as the LPIPS weights; it is not zero.</p>"
        )
    lead = "Mean over the held-out images; every camera and frame counts the same."
    return section("metrics", "Metrics", lead if rows else "", body + _references(data))


def _references(data: ReportData) -> str:
    """Other methods, grouped by what they are comparable with, ours first."""
    keys = list(dict.fromkeys((r.split, r.protocol, r.region) for r in data.references))
    out = []
    for split, protocol, region in keys:
        ours = data.metrics.get(split, {}).get(protocol, {}).get(region)
        entries: list[tuple[str, str, Mapping[str, Number | None], Number | None, str]] = []
        if ours is not None:
            took = data.timings.stages.get("training")
            entries.append(("This run", ' class="ours"', ours, took, "wall-clock seconds"))
        for r in data.references:
            if (r.split, r.protocol, r.region) == (split, protocol, region):
                scores = {"psnr": r.psnr, "ssim": r.ssim, "lpips": r.lpips}
                entries.append((r.name, "", scores, r.seconds, r.note))
        rows = [_reference_row(*entry) for entry in entries]
        head = [("Method", False), *((t, True) for t in _UNITS.values())]
        title = f"Beside others: {words(split)}, {words(protocol)}, {words(region)}"
        out.append(f'<h3 class="sub">{escape(title)}</h3>')
        out.append(table([*head, ("Training", True), ("Source", False)], rows))
    return "".join(out)


def _reference_row(
    name: str, css: str, scores: Mapping[str, Number | None], took: Number | None, note: str
) -> str:
    cells = "".join(
        '<td class="n none">not stated</td>'
        if scores.get(n) is None and not css
        else _score_cell(n, scores.get(n))
        for n in _DIGITS
    )
    time = seconds_text(took) if took is not None else "not stated"
    return (
        f'<tr{css}><td class="name">{escape(name)}</td>{cells}'
        f'<td class="n">{time}</td><td class="note">{escape(note)}</td></tr>'
    )


def _bar(share: float) -> str:
    return f'<div class="bar"><i style="width:{100 * min(max(share, 0.0), 1.0):.2f}%"></i></div>'


def timings_section(timings: Timings) -> str:
    """Costs as facts, stages as bars."""
    peak = timings.peak_memory_bytes
    cells = {
        "One training iteration": seconds_text(timings.seconds_per_iteration),
        "Rendering one frame": seconds_text(timings.render_seconds_per_frame),
        "Peak memory": "not measured" if peak is None else f"{peak / 2**30:.2f} GiB",
    }
    body = facts(cells)
    if timings.stages:
        total = sum(timings.stages.values())
        rows = [
            f'<tr><td class="name">{escape(words(name))}</td><td class="n">{seconds_text(value)}'
            f'</td><td class="n">{100 * value / total if total else 0:.1f} %</td>'
            f'<td style="width:46%">{_bar(value / total if total else 0)}</td></tr>'
            for name, value in timings.stages.items()
        ]
        head = [("Stage", False), (f"{seconds_text(total)} in all", True), ("Share", True)]
        body += '<h3 class="sub">Where the time went</h3>' + table([*head, ("", False)], rows)
    else:
        body += missing("No stage was timed.")
    return section("cost", "Time and memory", timings.note, body)


def skipping_section(rows: Sequence[SkipRow]) -> str:
    """What was skipped, with the share that was evaluated."""
    if not rows:
        return section("skipped", "What was skipped", "", missing("Nothing was counted."))
    out = []
    for row in rows:
        known = row.dense is not None and row.kept is not None and row.dense > 0
        share = row.kept / row.dense if known and row.kept is not None and row.dense else 0.0
        cells = (
            f'<td class="n">{share * 100:.1f} %</td><td>{_bar(share)}</td>'
            if known
            else '<td class="n none">not known</td><td></td>'
        )
        out.append(
            f'<tr><td class="name">{escape(row.what)}</td><td class="n">{count_text(row.dense)}'
            f'</td><td class="n">{count_text(row.kept)}</td>{cells}'
            f'<td class="note">{escape(row.note)}</td></tr>'
        )
    head = [("Work", False), ("Dense", True), ("Evaluated", True), ("Share", True)]
    body = table([*head, ("", False), ("Why", False)], out)
    lead = "Work that is not done. A row is exact, or says that it is approximate and where."
    return section("skipped", "What was skipped", lead, body)


def facts(values: Mapping[str, Any]) -> str:
    """A definition list in columns."""
    items = "".join(
        f"<div><dt>{escape(words(k))}</dt><dd>{escape(number_text(v))}</dd></div>"
        for k, v in values.items()
    )
    return f'<dl class="facts">{items}</dl>'


def _value(value: object) -> str:
    if isinstance(value, str | int | float | bool) or value is None:
        return f'<span class="mono">{escape(number_text(value))}</span>'
    return f'<span class="mono">{escape(json.dumps(value, default=str))}</span>'


def _flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Nested mappings as dotted names."""
    out = []
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and value:
            out.extend(_flat(value, name + "."))
        else:
            out.append((name, value))
    return out


def details(title: str, values: Mapping[str, Any], absent: str) -> str:
    """A table that opens on a click."""
    if not values:
        return missing(absent)
    entries = _flat(values)
    rows = "".join(
        f'<tr><td><span class="mono">{escape(k)}</span></td><td>{_value(v)}</td></tr>'
        for k, v in entries
    )
    return (
        f"<details><summary>{escape(title)}<small>{len(entries)} entries</small></summary>"
        f"<table><tbody>{rows}</tbody></table></details>"
    )
