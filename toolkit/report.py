"""One self-contained page on a run: images, metrics, curves, costs, configuration."""

import math
import os
from collections.abc import Sequence
from pathlib import Path

from monopart.geometry.errors import InputError

from .atomic import write_text
from .report_data import (
    Headline,
    ReferenceRow,
    ReportData,
    SkipRow,
    Timings,
    Triple,
)
from .report_images import (
    content_box,
    error_map,
    ground_colour,
    legend_gradient,
    picture,
    render_issue,
    shown,
)
from .report_sections import (
    curves_section,
    details,
    escape,
    facts,
    metrics_section,
    missing,
    number_text,
    section,
    skipping_section,
    timings_section,
    words,
)
from .report_style import SCRIPT, STYLE
from .report_training import capacity_section, round_trips_section
from .report_worst import shape_section, worst_section
from .video import Image

__all__ = [
    "Headline",
    "ReferenceRow",
    "ReportData",
    "SkipRow",
    "Timings",
    "Triple",
    "build_report",
    "report_html",
]

_SECTIONS = {
    "images": "Images",
    "worst": "Worst",
    "metrics": "Metrics",
    "shape": "Shape",
    "training": "Training",
    "cost": "Cost",
    "skipped": "Skipped",
    "capture": "Capture",
    "settings": "Settings",
}

# The page may not load anything: a browser that reads this line refuses every request.
_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "base-uri 'none'; form-action 'none'"
)


def _image(image: Image, alt: str, kind: str = "") -> str:
    made = picture(shown(image))
    mark = f' data-kind="{kind}"' if kind else ""
    return (
        f'<img src="{made.uri}" width="{made.size[1]}" height="{made.size[0]}" '
        f'alt="{escape(alt)}"{mark}>'
    )


def _figure(image: Image | None, caption: str, kind: str, alt: str, absent: str) -> str:
    content = missing(absent) if image is None else _image(image, alt, kind)
    return f"<figure>{content}<figcaption>{escape(caption)}</figcaption></figure>"


def _scores(triple: Triple) -> str:
    out = []
    for name, digits in (("psnr", 2), ("ssim", 4), ("lpips", 4)):
        if name in triple.scores:
            value = triple.scores[name]
            text = "not computed" if value is None else f"{value:.{digits}f}"
            out.append(f"{name.upper()}<b>{text}</b>")
    return f'<span class="scores">{"".join(out)}</span>' if out else ""


def _triple(triple: Triple, gain: float | int) -> str:
    """A render, its photograph and their difference, cropped alike."""
    rendered, truth, error = triple.rendered, triple.truth, None
    reason = "No difference: an image is missing."
    if rendered is not None and truth is not None:
        try:
            error = error_map(rendered, truth, gain)
        except InputError as problem:
            reason = f"No difference: {problem}"
    there = [i for i in (rendered, truth) if i is not None]
    if error is not None or len(there) == 1:
        top, bottom, left, right = content_box(there, aspect=0.6)
        rendered, truth, error = (
            None if i is None else i[top:bottom, left:right] for i in (rendered, truth, error)
        )
    issue = None if triple.rendered is None else render_issue(triple.rendered, triple.truth)
    banner = f'<p class="banner">{escape(issue)}</p>' if issue else ""
    whole = triple.rendered is not None and triple.truth is not None
    note = f'<p class="small lead">{escape(triple.note)}</p>' if triple.note and whole else ""
    why = triple.note or "it was not given."
    figures = (
        _figure(rendered, "Rendered", "rendered", f"Render, {triple.label}", f"No render: {why}")
        + _figure(
            truth, "Ground truth", "truth", f"Ground truth, {triple.label}", f"No image: {why}"
        )
        + _figure(error, f"Difference ×{gain:g}", "error", f"Difference, {triple.label}", reason)
    )
    return (
        f'<article class="triple"><header><h3>{escape(triple.label)}'
        f"<small>{escape(words(triple.split))}</small></h3>{_scores(triple)}</header>{banner}{note}"
        f'<div class="three" data-label="{escape(triple.label)}">{figures}</div></article>'
    )


def _images_section(data: ReportData) -> str:
    if not data.triples:
        body = missing("No held-out image was rendered: run monopart eval on this run folder.")
        return section("images", "Held-out images", "", body)
    scale = (
        f'<p class="scale"><span>Difference</span><span>0</span>'
        f'<i style="background:{legend_gradient()}"></i>'
        f"<span>≥ {1 / data.error_gain:.3g} of full scale, mean of R, G, B</span></p>"
    )
    body = "".join(_triple(t, data.error_gain) for t in data.triples)
    lead = (
        "Images that training never saw. They are cropped to the person for display; the scores "
        "are those of the whole image. Click one to compare it with the ground truth."
    )
    return section("images", "Held-out images", lead, f'{scale}<div class="triples">{body}</div>')


def _headline(item: Headline) -> str:
    value, unit = item.value, f"<span>{escape(item.unit)}</span>" if item.unit else ""
    if value is None:
        shown_value = '<dd class="text">not measured</dd>'
    else:
        shown_value = f"<dd>{escape(number_text(value))}{unit}</dd>"
    note = f'<dd class="note">{escape(item.note)}</dd>' if item.note else ""
    return f"<div><dt>{escape(item.label)}</dt>{shown_value}{note}</div>"


def _strip(frames: Sequence[Image]) -> str:
    """The turntable at one scale, each frame cropped at its sides, on its own ground colour."""
    if not frames:
        text = "No turntable was rendered: run monopart turntable on this run folder."
        return f'<div class="wrap">{missing(text)}</div>'
    top, bottom, _, _ = content_box(frames, margin=0.04)
    sides = [content_box([f], margin=0.05)[2:] for f in frames]
    red, green, blue = ground_colour(frames[0])
    images = "".join(
        _image(f[top:bottom, left:right], f"Turntable, view {i + 1} of {len(frames)}")
        for i, (f, (left, right)) in enumerate(zip(frames, sides, strict=True))
    )
    issues = [issue for f in frames if (issue := render_issue(f))]
    banner = f'<p class="banner">{escape(issues[0])}</p>' if issues else ""
    banner = f'<div class="wrap">{banner}</div>' if banner else ""
    return (
        f'{banner}<div class="strip" style="background:rgb({red},{green},{blue})">{images}</div>'
        f'<p class="wrap caption">Turntable: {len(frames)} views of one turn.</p>'
    )


def _hero(data: ReportData) -> str:
    kpis = "".join(_headline(h) for h in data.headline)
    numbers = (
        f'<dl class="kpis">{kpis}</dl>' if kpis else missing("No headline number was measured.")
    )
    short = [f"{words(k)} {number_text(v)}" for k, v in list(data.capture.items())[:5]]
    sub = f'<p class="sub">{escape(" · ".join(short))}</p>' if short else ""
    return (
        f'<header class="hero"><div class="wrap"><p class="eyebrow">monopart run report</p>'
        f"<h1>{escape(data.title)}</h1>{sub}{numbers}</div>{_strip(data.turntable)}</header>"
    )


def _loss_warnings(data: ReportData) -> list[str]:
    out = []
    for name in dict.fromkeys(n for row in data.curves for n in (row.get("losses") or {})):
        values = [(r.get("iteration"), (r.get("losses") or {}).get(name)) for r in data.curves]
        bad = [i for i, v in values if v is not None and not math.isfinite(v)]
        if bad:
            out.append(
                f"Loss {name!r} is not finite in {len(bad)} of {len(values)} log rows, "
                f"first at iteration {bad[0]}."
            )
    return out


def _metric_warnings(data: ReportData) -> list[str]:
    out = []
    for split, protocols in data.metrics.items():
        for protocol, regions in protocols.items():
            for region, scores in regions.items():
                bad = [n for n, v in scores.items() if v is not None and not math.isfinite(v)]
                if bad:
                    where = f"{words(split)}, {protocol}, {region}"
                    out.append(f"Not finite in the metrics ({where}): {', '.join(bad)}.")
    return out


def _triple_warnings(data: ReportData) -> list[str]:
    out = []
    for triple in data.triples:
        if triple.rendered is None:
            out.append(f"{triple.label}: no render: {triple.note or 'it was not given.'}")
            continue
        if issue := render_issue(triple.rendered, triple.truth):
            out.append(f"{triple.label}: {issue}")
        if triple.truth is not None and triple.truth.shape != triple.rendered.shape:
            sizes = f"{tuple(triple.rendered.shape)} and {tuple(triple.truth.shape)}"
            out.append(f"{triple.label}: render and ground truth differ in size: {sizes}.")
    return out


def found_warnings(data: ReportData) -> list[str]:
    """What is visibly wrong in the data itself: broken renders, losses and scores.

    Args:
        data: The report's data.

    Returns:
        One sentence each, to be shown after `data.warnings`.

    >>> found_warnings(ReportData("x", curves=[{"losses": {"mse": float("nan")}, "iteration": 3}]))
    ["Loss 'mse' is not finite in 1 of 1 log rows, first at iteration 3."]
    """
    return _loss_warnings(data) + _metric_warnings(data) + _triple_warnings(data)


def _warnings(data: ReportData) -> str:
    found = list(dict.fromkeys([*data.warnings, *found_warnings(data)]))
    if not found:
        return ""
    items = "".join(f"<li>{escape(w)}</li>" for w in found)
    noun = "One thing went wrong" if len(found) == 1 else f"{len(found)} things went wrong"
    return (
        f'<aside class="warnings" aria-label="Warnings"><div class="wrap"><strong>{noun}</strong>'
        f"<ul>{items}</ul></div></aside>"
    )


def report_html(data: ReportData) -> str:
    """Build the page as text.

    Args:
        data: What to show.

    Returns:
        HTML that loads nothing from anywhere.

    >>> report_html(ReportData("A run")).startswith("<!doctype html>")
    True
    """
    capture = facts(data.capture) if data.capture else missing("No facts on the capture.")
    settings = details("Configuration", data.config, "No configuration was given.") + details(
        "Environment", data.environment, "No facts on the environment."
    )
    sections = (
        _images_section(data)
        + worst_section(data.worst)
        + metrics_section(data)
        + shape_section(data.metrics)
        + curves_section(data.curves)
        + round_trips_section(data.curves, data.round_trips)
        + capacity_section(data.capacity)
        + timings_section(data.timings)
        + skipping_section(data.skipping)
        + section("capture", "Capture", "", capture)
        + section("settings", "Settings", "", settings)
    )
    shown_sections = {k: v for k, v in _SECTIONS.items() if f'<section id="{k}"' in sections}
    links = "".join(f'<a href="#{k}">{v}</a>' for k, v in shown_sections.items())
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        '<meta name="color-scheme" content="light dark"><link rel="icon" href="data:,">'
        f"<title>{escape(data.title)} · monopart</title><style>{STYLE}</style></head>\n"
        f'<body>{_warnings(data)}{_hero(data)}<nav aria-label="Sections"><div class="wrap">{links}'
        f'</div></nav>\n<main class="wrap">{sections}</main>\n<footer class="wrap">'
        "This page is one file: it needs no network and no other file.</footer>"
        f"<script>{SCRIPT}</script></body></html>\n"
    )


def build_report(run: str | os.PathLike[str], data: ReportData) -> Path:
    """Write report.html into a run folder.

    Args:
        run: Existing run folder.
        data: What to show; what is missing is said in words.

    Returns:
        Path of the page.

    Raises:
        InputError: The folder does not exist, or an image has not three channels.
    """
    return write_text(Path(run) / "report.html", report_html(data))
