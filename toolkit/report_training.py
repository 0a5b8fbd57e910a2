"""Sections of a report on what the training did inside: round trips, and the sizes of the parts."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

from .charts import Series, line_chart
from .report_sections import escape, section, table
from .round_trips import EDGES_MM

LAST_MM = 20.0  # end of the drawn histograms


def round_trips_section(
    rows: Sequence[Mapping[str, Any]], moments: Sequence[Mapping[str, Any]]
) -> str:
    """How far round trips end from where they began; nothing where none was computed.

    Args:
        rows: of train.jsonl; those with "round_trip" give the curves.
        moments: histograms, from training.json.
    """
    logged = [row for row in rows if row.get("round_trip")]
    if not logged and not moments:
        return ""
    times = [float(row.get("seconds") or 0.0) for row in logged]
    share = [_of(row, "share", 100.0) for row in logged]
    quantiles = [
        Series(name, times, [_of(row, key, 1e3) for row in logged], smooth=True)
        for name, key in (("median", "median"), ("90 %", "p90"), ("99 %", "p99"))
    ]
    shown = EDGES_MM[: EDGES_MM.index(LAST_MM) + 1]
    bins = list(itertools.pairwise(shown))
    shapes = [
        Series(
            f"step {moment['iteration']}",
            [(low + high) / 2 for low, high in bins],
            [100.0 * moment["histogram"][i] / (high - low) for i, (low, high) in enumerate(bins)],
            marks=True,
        )
        for moment in moments
    ]
    label = "training time, seconds"
    charts = (
        line_chart(
            [Series("pairs over the threshold", times, share, smooth=True)],
            title="Round trips that the consistency loss acts on",
            x_label=label,
            y_label="% of the pairs",
        )
        + line_chart(
            quantiles,
            title="Round-trip distance",
            x_label=label,
            y_label="mm, logarithmic",
            log_y=True,
        )
        + line_chart(
            shapes,
            title="Histogram of the round trips",
            x_label="distance, mm (middle of the bin)",
            y_label="% of the pairs per mm",
        )
    )
    lead = "Samples taken to the canonical body and back, with weights looked up again there."
    return section("round_trips", "Round trips", lead, f'<div class="charts">{charts}</div>')


def _of(row: Mapping[str, Any], key: str, unit: float) -> float | None:
    value = row["round_trip"].get(key)
    return None if value is None else unit * value


def capacity_section(parts: Sequence[Mapping[str, Any]]) -> str:
    """Reach and size of each part's field; nothing where they are not known.

    Args:
        parts: rows of training.json.
    """
    if not parts:
        return ""
    total = max(sum(part["rows"] for part in parts), 1)
    looked = any("area" in part for part in parts)
    rows = []
    for part in parts:
        cells = [
            f"{1e3 * part['radius']:.0f}",
            f"2^{part['log2_size']}",
            f"{part['rows']}",
            f"{100 * part['rows'] / total:.1f} %",
            f"{1e3 * part['finest']:.1f}",
        ]
        if looked:
            cells += [f"{part.get('area', 0.0):.0f}", f"{part.get('detail', 0.0):.4f}"]
        numbers = "".join(f'<td class="n">{escape(cell)}</td>' for cell in cells)
        rows.append(f'<tr><td class="name">{escape(part["part"])}</td>{numbers}</tr>')
    head = ["Reaches, mm", "Rows a level", "Rows", "Share", "Finest cell, mm"]
    head += ["Pixels an image", "Detail"] if looked else []
    body = table([("Part", False), *((text, True) for text in head)], rows)
    lead = "Hash table of each part" + (
        ", by area on screen times texture in the training images." if looked else ", all alike."
    )
    return section("capacity", "Capacity of the parts", lead, body)
