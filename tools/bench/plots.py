"""Scatter plots with logarithmic axes as SVG files, light or dark as the viewer is."""

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

from monopart.toolkit.charts import linear_ticks, log_ticks, tick_label

_WIDTH, _HEIGHT = 820, 430
_LEFT, _RIGHT, _TOP, _BOTTOM = 74, 290, 44, 52
_COLOURS = (
    *("#0b6e99", "#c2571a", "#3f7d20", "#8a3ffc", "#b8336a", "#6b6b6b", "#9a7d0a", "#1192e8"),
    *("#a2191f", "#005d5d", "#570408", "#198038"),
)
_STYLE = (
    "text{font:12px system-ui,sans-serif;fill:#222}.grid{stroke:#ddd}.title{font-size:15px;"
    "font-weight:600}.front{stroke:#888;stroke-width:2;stroke-dasharray:5 4;fill:none}"
    ".on{font-weight:600}"
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
class _Axis:
    """A logarithmic or linear axis between two pixels."""

    ticks: tuple[float, ...]
    start: float
    end: float
    log: bool = True

    def at(self, value: float) -> float:
        low, high = self.ticks[0], self.ticks[-1]
        if self.log:
            low, high, value = math.log10(low), math.log10(high), math.log10(value)
        return self.start + (value - low) / (high - low) * (self.end - self.start)

    def shown(self) -> list[float]:
        """Ticks that are labelled: powers of ten where there are many."""
        if not self.log:
            return list(self.ticks)
        powers = [t for t in self.ticks if abs(math.log10(t) - round(math.log10(t))) < 1e-9]
        return powers if len(self.ticks) > 7 and len(powers) > 1 else list(self.ticks)


def _axis(values: list[float], start: int, end: int, log: bool = True) -> _Axis:
    low, high = min(values), max(values)
    ticks = log_ticks(low, high) if log else linear_ticks(low, high)
    return _Axis(tuple(ticks), float(start), float(end), log)


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


def _staircase(front: list[tuple[float, float]], x: _Axis, y: _Axis) -> str:
    """The border of what some method reaches: level, then down at the next, more exact one."""
    corners = [(x.at(front[0][0]), y.end)]
    for a, b in front:
        corners += [(x.at(a), corners[-1][1]), (x.at(a), y.at(b))]
    corners.append((x.end, corners[-1][1]))
    line = " ".join(f"{a:.1f},{b:.1f}" for a, b in corners)
    return f'<polyline class="front" points="{line}"/>'


def log_plot(
    series: Sequence[Dots],
    title: str,
    x_label: str,
    y_label: str,
    front: bool = False,
    log_y: bool = True,
) -> str:
    """An SVG file of points over two logarithmic axes.

    Args:
        series: the methods; points that are not above 0 are left out.
        title: heading.
        x_label: label below.
        y_label: label above the vertical axis.
        front: draw the Pareto front of all points, and the names on it in bold.
        log_y: a logarithmic vertical axis; otherwise a linear one.

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
        y = _axis([p[1] for p in every], _HEIGHT - _BOTTOM, _TOP, log_y)
        body, best = _grid(x, y), set()
        if front:
            best = set(pareto_front(every))
            body += _staircase(sorted(best), x, y) + _front_key(len(points))
        body += "".join(
            _dots(i, dots, own, (x, y), bool(best & set(own)))
            for i, (dots, own) in enumerate(points)
        )
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


def _front_key(number: int) -> str:
    """The line of the legend that names the front."""
    left, top = _WIDTH - _RIGHT + 12, _TOP + 10 + 20 * number
    return (
        f'<polyline class="front" points="{left},{top} {left + 20},{top}"/>'
        f'<text x="{left + 24}" y="{top + 4}">Pareto front</text>'
    )


def _grid(x: _Axis, y: _Axis) -> str:
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


def _dots(
    number: int,
    dots: Dots,
    own: list[tuple[float, float]],
    axes: tuple[_Axis, _Axis],
    best: bool,
) -> str:
    x, y = axes
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
    kind = ' class="on"' if best else ""
    out.append(f'<text{kind} x="{left + 14}" y="{top + 4}">{name}</text>')
    return f"<g>{''.join(out)}</g>"
