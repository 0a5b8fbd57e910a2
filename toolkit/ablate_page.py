"""The page and the files of a grid: tables beside the paper's own figures."""

import csv
import io
import re
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from monopart.geometry.errors import InputError

from .ablate_table import Spread, Table, collected, rows_of, verdict
from .atomic import write_json, write_text
from .grid import FULL, PUBLISHED_ON, Variant

SHOWN = ("full", "box")
"""Regions of the page; the files hold all of them."""
_DIGITS = {"psnr": 2, "ssim": 4, "lpips": 4, "mask_iou": 4, "depth_mm": 1, "depth_median_mm": 1}
_NAMES = {
    "psnr": "PSNR",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "mask_iou": "IoU",
    "depth_mm": "depth mm, mean",
    "depth_median_mm": "median",
}
_MISSING = "–"


def write_tables(
    out: Path,
    variants: Mapping[str, Variant],
    summaries: Sequence[Mapping[str, Any]],
    facts: Mapping[str, Any],
    publish: Path | None = None,
) -> Path:
    """Write table.md, table.json and table.csv, and the same into a page of the documentation.

    Args:
        out: folder to write into.
        variants: name to variant, in order.
        summaries: contents of summary.json of the complete cells.
        facts: command, base, settings, equal (variants that share a training) and splits
            (capture to split to number of images).
        publish: a page; None writes none. Its part between the marks "ablation: begin" and
            "ablation: end" is replaced, or added at its end; the files go into the folder beside
            the page that is called as it is.

    Returns:
        table.md.

    Raises:
        InputError: a page that does not exist, or with one of the two marks.
    """
    table = collected(summaries)
    rows = rows_of(table, variants, facts["equal"])
    page = page_text(table, variants, summaries, facts)
    write_text(out / "table.md", page)
    content = {**facts, "rows": rows, "trainings": list(summaries)}
    _write_files(out / "table", content, rows)
    if publish is not None:
        folder = publish.with_suffix("")
        folder.mkdir(exist_ok=True)
        _write_files(folder / out.name, content, rows)
        write_text(publish, replaced(publish, out.name, page))
    return out / "table.md"


def _write_files(stem: Path, content: Mapping[str, Any], rows: Sequence[Mapping]) -> None:
    write_json(stem.with_name(f"{stem.name}.json"), content, nonfinite="null")
    file = io.StringIO()
    if rows:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    write_text(stem.with_name(f"{stem.name}.csv"), file.getvalue())


def replaced(page: Path, name: str, text: str) -> str:
    """A page with the part between two marks replaced, or added at the end.

    Args:
        page: the page.
        name: of the part.
        text: its new content.

    Raises:
        InputError: no such page, or one of the marks without the other.
    """
    if not page.is_file():
        raise InputError(f"--publish {page}: expected a page, found none; write it first")
    old = page.read_text(encoding="utf-8")
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    part = f"{begin}\n{text}{end}"
    if begin not in old and end not in old:
        return f"{old.rstrip()}\n\n{part}\n"
    found = re.search(f"{re.escape(begin)}.*?{re.escape(end)}", old, re.DOTALL)
    if found is None:
        raise InputError(f"--publish {page}: expected both marks {begin} and {end}, found one")
    return old[: found.start()] + part + old[found.end() :]


def page_text(
    table: Table,
    variants: Mapping[str, Variant],
    summaries: Sequence[Mapping[str, Any]],
    facts: Mapping[str, Any],
) -> str:
    """The tables as Markdown.

    Args:
        table: from `collected`.
        variants: name to variant, in order.
        summaries: contents of summary.json.
        facts: see :func:`write_tables`.
    """
    out = ["Made by", "", f"    {facts['command']}", ""]
    out += _legend(variants, facts)
    out += _notes(summaries)
    sections = dict.fromkeys((k.capture, k.split, k.protocol) for k in table)
    for capture, split, protocol in sections:
        chosen = {
            k: v
            for k, v in table.items()
            if (k.capture, k.split, k.protocol) == (capture, split, protocol)
            and (k.region in SHOWN or protocol not in ("strict",))
        }
        count = {s["images"].get(split, 0) for s in summaries if s["capture"] == capture}
        whole = facts["splits"].get(capture, {}).get(split)
        images = "/".join(map(str, sorted(count)))
        out += [f"**measured, {capture}: {split.replace('_', ' ')}, protocol {protocol}**, ", ""]
        out[-2] += f"{images} of {whole} images" + (", evenly spread" if whole not in count else "")
        out += _section(chosen, variants, facts["equal"], split)
    return "\n".join([*out, *_costs(summaries, variants)]).rstrip() + "\n"


def _legend(variants: Mapping[str, Variant], facts: Mapping[str, Any]) -> list[str]:
    common = " ".join(facts["settings"])
    out = [
        f"Base: preset `{facts['base']}`" + (f" with `{common}`" if common else "") + ". "
        "Mean ± standard deviation over seeds; in parentheses the difference to `full`, paired "
        "over seeds, ± its standard deviation, bold where it is larger than that. PSNR in dB, "
        f"higher is better; SSIM likewise; LPIPS lower. *{PUBLISHED_ON}*: PSNR under the paper's "
        "protocol (`legacy`), of other people, and in parentheses its difference to the paper's "
        "own full model.",
        "",
        "| cell | what | settings |",
        "|---|---|---|",
    ]
    for name, variant in variants.items():
        shown = [f"preset {variant.preset}"] if variant.preset else []
        shown += variant.settings
        same = facts["equal"].get(name)
        what = variant.label + (f"; the same configuration as `{same}`" if same else "")
        out.append(f"| `{name}` | {what} | {' '.join(f'`{s}`' for s in shown)} |")
    return [*out, ""]


def _notes(summaries: Sequence[Mapping[str, Any]]) -> list[str]:
    """What a reader must know: several states of the code, warnings of trainings."""
    out = []
    commits = sorted({str(s["code"]["git_commit"]) for s in summaries})
    if len(commits) > 1:
        out.append(f"- The trainings are of different states of the code: {', '.join(commits)}.")
    elif commits:
        out.append(f"- Commit {commits[0]}.")
    warnings = dict.fromkeys(w for s in summaries for w in s["warnings"])
    for warning in warnings:
        having = sum(warning in s["warnings"] for s in summaries)
        out.append(f"- {having} of {len(summaries)} trainings: {warning}")
    return [*out, ""]


def _section(
    table: Table, variants: Mapping[str, Variant], equal: Mapping[str, str], split: str
) -> list[str]:
    """One table: a row per cell and kind of poses, a column per region and metric."""
    columns = list(dict.fromkeys((k.region, k.metric) for k in table))
    published = any(split in v.published for v in variants.values())
    head = ["cell", "poses", *(f"{_NAMES.get(m, m)} {r}" for r, m in columns)]
    head += [f"{PUBLISHED_ON}: PSNR"] * published
    out = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for poses in dict.fromkeys(k.poses for k in table):
        by_column = {(k.region, k.metric): v for k, v in table.items() if k.poses == poses}
        for name, variant in variants.items():
            cells = [
                _cell(by_column.get(c, {}), name, equal.get(name, name), c[1]) for c in columns
            ]
            if all(c == _MISSING for c in cells) and not variant.published.get(split):
                continue
            cells += [_published(variants, name, split)] * published
            out.append("| " + " | ".join([f"`{name}`", poses, *cells]) + " |")
    return [*out, ""]


def _cell(cells: Mapping[str, Spread], name: str, trained: str, metric: str) -> str:
    spread, full = cells.get(trained), cells.get(FULL)
    if spread is None:
        return _MISSING
    digits = _DIGITS.get(metric, 4)
    text = _with_noise(spread, digits, "")
    if name == FULL or full is None:
        return text
    difference = spread.minus(full)
    if difference is None:
        return text
    shown = _with_noise(difference, digits, "+")
    seen = round(difference.mean, digits) != 0.0
    beyond = seen and verdict(metric, difference) in ("better", "worse")
    return f"{text} ({f'**{shown}**' if beyond else shown})"


def _with_noise(spread: Spread, digits: int, sign: str) -> str:
    text = f"{spread.mean:{sign}.{digits}f}"
    return text if spread.deviation is None else f"{text} ± {spread.deviation:.{digits}f}"


def _published(variants: Mapping[str, Variant], name: str, split: str) -> str:
    value = variants[name].published.get(split)
    full = variants[FULL].published.get(split)
    if value is None:
        return _MISSING
    return f"{value:.2f}" if name == FULL or full is None else f"{value:.2f} ({value - full:+.2f})"


def _costs(summaries: Sequence[Mapping[str, Any]], variants: Mapping[str, Variant]) -> list[str]:
    """What the trainings cost, mean over seeds."""
    out = ["**Training, mean over seeds**", ""]
    out += [
        "| capture | cell | seeds | iterations | wall s | processor s |",
        "|---|---|---|---|---|---|",
    ]
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for summary in summaries:
        groups.setdefault((summary["capture"], summary["cell"]), []).append(summary)
    order = list(variants)
    for (capture, name), found in sorted(groups.items(), key=lambda g: order.index(g[0][1])):
        means = [statistics.fmean(s[k] for s in found) for k in ("iterations", "seconds")]
        means.append(statistics.fmean(s["cpu_seconds"] for s in found))
        cells = [capture, f"`{name}`", str(len(found)), *(f"{m:.0f}" for m in means)]
        out.append("| " + " | ".join(cells) + " |")
    return out
