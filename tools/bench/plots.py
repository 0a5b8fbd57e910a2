"""Scatter plots with two logarithmic axes as SVG files, light or dark as the viewer is."""

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

from monopart.toolkit.charts import log_ticks, tick_label

_WIDTH, _HEIGHT = 760, 430
_LEFT, _RIGHT, _TOP, _BOTTOM = 74, 230, 44, 52
_COLOURS = (
    *("#0b6e99", "#c2571a", "#3f7d20", "#8a3ffc", "#b8336a", "#6b6b6b", "#9a7d0a", "#1192e8"),
    *("#a2191f", "#005d5d", "#570408", "#198038"),
)
_STYLE = (
    "text{font:12px system-ui,sans-serif;fill:#222}.grid{stroke:#ddd}.title{font-size:15px;"
    "font-weight:600}.front{stroke:#999;stroke-dasharray:4 4;fill:none}"
    "@media(prefers-color-scheme:dark){text{fill:#eee}.grid{stroke:#444}.paper{fill:#161616}}"
)


@dataclass(frozen=True)
class Dots:
    """The points of one method."""

    name: str
    """Shown in the legend."""
    x: Sequence[float]
    """Horizontal values, above 0."""
    y: Sequence[float]
    """Vertical values, above 0."""
    joined: bool = False
    """Join the points by a line."""
    bold: bool = False
    """Ours: larger, filled."""


@dataclass(frozen=True)
class _Log:
    """A logarithmic axis between two pixels."""

    ticks: tuple[float, ...]
    start: float
    end: float

    def at(self, value: float) -> float:
        low, high = math.log10(self.ticks[0]), math.log10(self.ticks[-1])
        return self.start + (math.log10(value) - low) / (high - low) * (self.end - self.start)

    def shown(self) -> list[float]:
        """Ticks that are labelled: powers of ten where there are many."""
        powers = [t for t in self.ticks if abs(math.log10(t) - round(math.log10(t))) < 1e-9]
        return powers if len(self.ticks) > 7 and len(powers) > 1 else list(self.ticks)


def _axis(values: list[float], start: int, end: int) -> _Log:
    return _Log(tuple(log_ticks(min(values), max(values))), float(start), float(end))


def pareto_front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Points that no other point beats in both values, by the first.

    >>> pareto_front([(1.0, 3.0), (2.0, 2.0), (3.0, 2.5)])
    [(1.0, 3.0), (2.0, 2.0)]
    """
    front: list[tuple[float, float]] = []
    for point in sorted(points):
        if not front or point[1] < front[-1][1]:
            front.append(point)
    return front


def log_plot(
    series: Sequence[Dots], title: str, x_label: str, y_label: str, front: bool = False
) -> str:
    """An SVG file of points over two logarithmic axes.

    Args:
        series: the methods; points that are not above 0 are left out.
        title: heading.
        x_label: label below.
        y_label: label above the vertical axis.
        front: draw the Pareto front of all points.

    >>> log_plot([Dots("a", [1.0], [2.0])], "t", "s", "m").startswith("<svg")
    True
    """
    points = [
        (dots, [(float(x), float(y)) for x, y in zip(dots.x, dots.y, strict=True) if min(x, y) > 0])
        for dots in series
    ]
    every = [p for _, own in points for p in own]
    body = f'<text x="{_LEFT}" y="40">nothing was measured</text>'
    if every:
        x = _axis([p[0] for p in every], _LEFT, _WIDTH - _RIGHT)
        y = _axis([p[1] for p in every], _HEIGHT - _BOTTOM, _TOP)
        body = _grid(x, y)
        if front:
            line = " ".join(f"{x.at(a):.1f},{y.at(b):.1f}" for a, b in pareto_front(every))
            body += f'<polyline class="front" points="{line}"/>'
        body += "".join(_dots(i, dots, own, x, y) for i, (dots, own) in enumerate(points))
    middle = (_LEFT + _WIDTH - _RIGHT) // 2
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style>"
        f'<rect class="paper" width="{_WIDTH}" height="{_HEIGHT}" fill="#fff"/>'
        f'<text class="title" x="10" y="18">{html.escape(title)}</text>'
        f'<text x="10" y="36">{html.escape(y_label)}</text>{body}'
        f'<text x="{middle}" y="{_HEIGHT - 10}" text-anchor="middle">{html.escape(x_label)}</text>'
        "</svg>\n"
    )


def _grid(x: _Log, y: _Log) -> str:
    out = []
    for tick in x.shown():
        left = x.at(tick)
        out.append(
            f'<line class="grid" x1="{left:.1f}" x2="{left:.1f}" y1="{y.end}" y2="{y.start}"/>'
            f'<text x="{left:.1f}" y="{y.start + 18}" text-anchor="middle">'
            f"{tick_label(tick)}</text>"
        )
    for tick in y.shown():
        top = y.at(tick)
        out.append(
            f'<line class="grid" x1="{x.start}" x2="{x.end}" y1="{top:.1f}" y2="{top:.1f}"/>'
            f'<text x="{x.start - 8}" y="{top + 4:.1f}" text-anchor="end">{tick_label(tick)}</text>'
        )
    return "".join(out)


def _dots(number: int, dots: Dots, own: list[tuple[float, float]], x: _Log, y: _Log) -> str:
    colour = _COLOURS[number % len(_COLOURS)]
    name = html.escape(dots.name)
    fill = colour if dots.bold else "none"
    radius = 6 if dots.bold else 5
    style = f'stroke="{colour}" fill="{fill}" stroke-width="2"'
    out = []
    if dots.joined and len(own) > 1:
        line = " ".join(f"{x.at(a):.1f},{y.at(b):.1f}" for a, b in sorted(own))
        out.append(f'<polyline points="{line}" stroke="{colour}" fill="none"/>')
    for a, b in own:
        out.append(
            f'<circle cx="{x.at(a):.1f}" cy="{y.at(b):.1f}" r="{radius}" {style}>'
            f"<title>{name}: {a:.4g}, {b:.3g}</title></circle>"
        )
    left, top = _WIDTH - _RIGHT + 22, _TOP + 10 + 20 * number
    out.append(f'<circle cx="{left}" cy="{top}" r="{radius}" {style}/>')
    out.append(f'<text x="{left + 14}" y="{top + 4}">{name}</text>')
    return f"<g>{''.join(out)}</g>"
