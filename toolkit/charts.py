"""Small line charts drawn as inline SVG; colours come from the page's style sheet."""

import html
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from monopart.geometry.errors import InputError

_WIDTH, _HEIGHT = 520, 300
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 14, 14, 44
_MAX_POINTS = 400


@dataclass(frozen=True)
class Series:
    """One line of a chart."""

    name: str
    """Shown in the legend."""
    x: Sequence[float | int]
    """Horizontal values; points that are not finite are left out."""
    y: Sequence[float | int | None]
    """Vertical values, as many; None, NaN, infinity and (on a log axis) y ≤ 0 are left out."""
    marks: bool = False
    """Draw a dot at each point."""
    smooth: bool = False
    """Draw the values faint and their moving average over them, when there are many."""


@dataclass(frozen=True)
class _Axes:
    """Maps data to the drawing."""

    x: tuple[float, float]
    y: tuple[float, float]
    log_y: bool

    def at(self, x: float, y: float) -> tuple[float, float]:
        lo, hi = self.y
        if self.log_y:
            lo, hi, y = math.log10(lo), math.log10(hi), math.log10(y)
        right = (x - self.x[0]) / (self.x[1] - self.x[0]) * (_WIDTH - _LEFT - _RIGHT)
        down = (hi - y) / (hi - lo) * (_HEIGHT - _TOP - _BOTTOM)
        return _LEFT + right, _TOP + down


def linear_ticks(low: float | int, high: float | int, count: int = 5) -> list[float]:
    """Round numbers that cover [low, high], about `count` of them, in steps of 1, 2 or 5.

    Args:
        low: Smallest value.
        high: Largest value; an empty range is widened.
        count: How many to aim for.

    Returns:
        Increasing ticks; the first is ≤ low and the last ≥ high.

    >>> linear_ticks(0, 95)
    [0.0, 20.0, 40.0, 60.0, 80.0, 100.0]
    """
    if high - low < 1e-9 * max(1.0, abs(low), abs(high)):
        pad = max(abs(low), 1.0) * 0.05
        low, high = low - pad, high + pad
    raw = (high - low) / max(count, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m for m in (1, 2, 5, 10) if m * power >= raw * (1 - 1e-9)) * power
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(i * step, 12) for i in range(first, last + 1)]


def log_ticks(low: float | int, high: float | int) -> list[float]:
    """Powers of ten times 1, 2 and 5 that cover [low, high].

    Args:
        low: Smallest value, above 0.
        high: Largest value.

    Returns:
        Increasing ticks; the first is ≤ low and the last ≥ high.

    Raises:
        InputError: `low` is not positive or `high` is smaller.

    >>> log_ticks(0.003, 0.4)
    [0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5]
    """
    if not 0 < low <= high:
        raise InputError(f"low, high: expected 0 < low ≤ high, found {low}, {high}")
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1
    ticks = [float(f"{f}e{p}") for p in range(first, last + 1) for f in (1, 2, 5)]
    lower = max(t for t in ticks if t <= low * (1 + 1e-9))
    upper = min(t for t in ticks if t >= high * (1 - 1e-9) and t > lower)
    return [t for t in ticks if lower <= t <= upper]


def tick_label(value: float | int) -> str:
    """Short label that tells a tick from its neighbours: 0.002, 1.2e-5, 40, 20k."""
    if value and (abs(value) < 1e-3 or abs(value) >= 1e6):
        mantissa, _, power = f"{value:.3e}".partition("e")
        return f"{float(mantissa):g}e{int(power)}"
    if abs(value) >= 10_000 and value % 1000 == 0:
        return f"{value / 1000:g}k"
    return f"{value:g}"


def _clean(series: Series, log_y: bool) -> list[tuple[float, float]]:
    """Finite points of a series."""
    points = []
    for x, y in zip(series.x, series.y, strict=True):
        if y is None or not (math.isfinite(x) and math.isfinite(y)) or (log_y and y <= 0):
            continue
        points.append((float(x), float(y)))
    return points


def _averaged(points: list[tuple[float, float]], log_y: bool) -> list[tuple[float, float]]:
    """Centred moving average, of logarithms on a log axis, over a fortieth of the points."""
    half = max(1, len(points) // 80)
    values = [math.log(y) if log_y else y for _, y in points]
    back: Callable[[float], float] = math.exp if log_y else float
    result = []
    for i, (x, _) in enumerate(points):
        window = values[max(0, i - half) : i + half + 1]
        result.append((x, back(sum(window) / len(window))))
    return result


def _thinned(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Keep the lowest and the highest point of each bin, so that spikes stay visible."""
    if len(points) <= _MAX_POINTS:
        return points
    size = math.ceil(len(points) / (_MAX_POINTS // 2))
    kept = []
    for start in range(0, len(points), size):
        part = points[start : start + size]
        ends = {min(part, key=lambda p: p[1]), max(part, key=lambda p: p[1])}
        kept.extend(sorted(ends))
    return kept


def _line(points: list[tuple[float, float]], axes: _Axes, css: str) -> str:
    path = " ".join("{:.1f},{:.1f}".format(*axes.at(*p)) for p in _thinned(points))
    return f'<polyline class="{css}" points="{path}"></polyline>'


def _draw(series: Series, points: list[tuple[float, float]], axes: _Axes, number: int) -> str:
    """One series: line, faint line below its average, dots."""
    colour = f"line c{number % 6 + 1}"
    out = []
    if series.smooth and len(points) >= 40:
        out.append(_line(points, axes, colour + " faint"))
        points = _averaged(points, axes.log_y)
    out.append(_line(points, axes, colour))
    if series.marks or len(points) < 3:
        for point in points:
            left, top = axes.at(*point)
            out.append(
                f'<circle class="dot c{number % 6 + 1}" cx="{left:.1f}" cy="{top:.1f}" r="3.2">'
                f"<title>{html.escape(series.name)}: {point[1]:.4g}</title></circle>"
            )
    name = html.escape(series.name, quote=True)
    return f'<g data-name="{name}">{"".join(out)}</g>'


def _frame(axes: _Axes, x_ticks: list[float], y_ticks: list[float]) -> str:
    """Grid lines and tick labels."""
    out = []
    if axes.log_y and len(y_ticks) > 9:  # over three decades only the powers of ten are labelled
        y_ticks = [t for t in y_ticks if abs(math.log10(t) - round(math.log10(t))) < 1e-6]
    bottom = _HEIGHT - _BOTTOM
    for tick in y_ticks:
        _, top = axes.at(axes.x[0], tick)
        out.append(f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{top:.1f}" ')
        out.append(f'y2="{top:.1f}"></line><text class="tick" x="{_LEFT - 8}" y="{top + 4:.1f}" ')
        out.append(f'text-anchor="end">{tick_label(tick)}</text>')
    for tick in x_ticks:
        left, _ = axes.at(tick, axes.y[0])
        out.append(f'<line class="axis" x1="{left:.1f}" x2="{left:.1f}" y1="{bottom}" ')
        out.append(f'y2="{bottom + 4}"></line><text class="tick" x="{left:.1f}" ')
        out.append(f'y="{bottom + 18}" text-anchor="middle">{tick_label(tick)}</text>')
    out.append(f'<line class="axis" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{bottom}" ')
    out.append(f'y2="{bottom}"></line>')
    return "".join(out)


def line_chart(
    series: Sequence[Series],
    *,
    title: str,
    x_label: str,
    y_label: str,
    log_y: bool = False,
) -> str:
    """Draw series as an SVG element with axes, ticks and labels, and an HTML legend above it.

    Args:
        series: Lines; at most six keep different colours.
        title: Heading, and the name for screen readers.
        x_label: Label below.
        y_label: Label at the top of the vertical axis.
        log_y: Logarithmic vertical axis.

    Returns:
        An HTML figure. Without a single finite point it says so in words.

    >>> chart = Series("psnr", [0, 1, 2], [20.0, 24.0, 25.0])
    >>> "<svg" in line_chart([chart], title="PSNR", x_label="s", y_label="dB")
    True
    """
    head = f"<h3>{html.escape(title)} <small>{html.escape(y_label)}</small></h3>"
    cleaned = [(s, _clean(s, log_y)) for s in series]
    drawn = [(s, p) for s, p in cleaned if p]
    empty = [s.name for s, p in cleaned if not p]
    words = ""
    if empty:
        names = html.escape(", ".join(empty))
        words = f'<p class="missing small">No drawable value logged for: {names}.</p>'
    if not drawn:
        words = words or '<p class="missing">Nothing was logged, so there is no curve.</p>'
        return f'<figure class="chart">{head}{words}</figure>'
    xs = [x for _, points in drawn for x, _ in points]
    ys = [y for _, points in drawn for _, y in points]
    x_ticks = linear_ticks(min(xs), max(xs))
    y_ticks = log_ticks(min(ys), max(ys)) if log_y else linear_ticks(min(ys), max(ys))
    low, high = min(xs), max(xs)  # time ends where the log ends, not at a round number
    if high <= low:
        low, high = x_ticks[0], x_ticks[-1]
    elif 0 < low < 0.1 * high:
        low = 0.0
    x_ticks = [t for t in x_ticks if low <= t <= high]
    axes = _Axes((low, high), (y_ticks[0], y_ticks[-1]), log_y)
    lines = "".join(_draw(s, p, axes, i) for i, (s, p) in enumerate(drawn))
    legend = "".join(
        f'<li><i class="key c{i % 6 + 1}"></i>{html.escape(s.name)}</li>'
        for i, (s, _) in enumerate(drawn)
    )
    name = html.escape(f"{title}: {y_label} against {x_label}", quote=True)
    middle = (_LEFT + _WIDTH - _RIGHT) // 2
    unit = html.escape(x_label.rpartition(", ")[2], quote=True)
    data = (
        f'data-box="{_LEFT} {_TOP} {_WIDTH - _RIGHT} {_HEIGHT - _BOTTOM}" '
        f'data-x="{axes.x[0]:.8g} {axes.x[1]:.8g}" data-y="{axes.y[0]:.8g} {axes.y[1]:.8g}" '
        f'data-log="{int(log_y)}" data-unit="{unit}"'
    )
    return (
        f'<figure class="chart">{head}<ul class="legend">{legend}</ul>'
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{name}" {data}>'
        f"{_frame(axes, x_ticks, y_ticks)}{lines}"
        f'<text class="tick" x="{middle}" y="{_HEIGHT - 6}" text-anchor="middle">'
        f"{html.escape(x_label)}</text></svg>{words}</figure>"
    )
