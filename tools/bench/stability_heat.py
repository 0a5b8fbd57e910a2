"""Heat maps of stability as SVG files: implementations against families, light or dark."""

import html
import math
from collections.abc import Sequence

import torch

from .stability_cases import Cell, Stress

_LABEL, _CELL, _ROW, _HEAD, _TITLE, _LEGEND = 190, 34, 20, 118, 30, 52
_STYLE = (
    "text{font:12px system-ui,sans-serif;fill:#222}.small{font-size:11px}.title{font-size:14px;"
    "font-weight:600}.out{opacity:.45}.none{fill:#e3e3e3}.masked{fill:#b9c7d9}.line{stroke:#999}"
    ".bad{fill:#5b1a8b}.cross{fill:#fff;font-weight:700;text-anchor:middle}"
    "@media(prefers-color-scheme:dark){text{fill:#eee}.paper{fill:#161616}.none{fill:#333}"
    ".masked{fill:#4a5a70}}"
)
# what a number is worth, from exact to useless: upper end in units of the last place, colour, text
STEPS = (
    (1.0, "#1a9850", "≤ 1 ulp"),
    (8.0, "#91cf60", "≤ 8"),
    (1e2, "#d9ef8b", "≤ 100"),
    (1e4, "#fee08b", "≤ 1e4"),
    (1e6, "#fc8d59", "≤ 1e6"),
    (math.inf, "#d73027", "more"),
)


def _colour(ulps: float) -> str:
    return next(colour for end, colour, _ in STEPS if ulps <= end)


def _box(x: float | int, y: float | int, width: float | int, look: str) -> str:
    return f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{_ROW - 3}" {look}/>'


def _value_look(cell: Cell) -> str:
    if cell.bad_values:
        return 'class="bad"'
    if cell.ulp is not None:
        return f'fill="{_colour(cell.ulp)}"'
    return 'class="masked"' if cell.masked else 'class="none"'


def _slope_look(cell: Cell) -> str:
    if cell.bad_gradients:
        return 'class="bad"'
    if cell.gradient is None or cell.dtype == "float64":
        return 'class="none"'  # differences check float64 to nine digits only: not a colour here
    return f'fill="{_colour(cell.gradient / torch.finfo(cell.kind).eps)}"'


def _told(cell: Cell) -> str:
    """What hovering shows."""
    value = "-" if cell.value is None else f"{cell.value:.2g}"
    slope = "-" if cell.gradient is None else f"{cell.gradient:.2g}"
    text = f"{cell.way}, {cell.family}, {cell.dtype}: error {value}, gradient {slope}, "
    text += f"{cell.masked} of {cell.cases} masked, not finite: {cell.bad_values} values, "
    return f"{text}{cell.bad_gradients} gradients" + (f"; {cell.raised}" if cell.raised else "")


def _cell(cell: Cell, x: float | int, y: float | int) -> str:
    half = (_CELL - 4) / 2
    parts = [_box(x, y, half, _value_look(cell)), _box(x + half + 1, y, half, _slope_look(cell))]
    for bad, middle in ((cell.bad_values, x + half / 2), (cell.bad_gradients, x + 1.5 * half + 1)):
        if bad:
            parts.append(f'<text class="cross" x="{middle:.1f}" y="{y + 13:.1f}">×</text>')
    look = "" if cell.inside else ' class="out"'
    return f"<g{look}><title>{html.escape(_told(cell))}</title>{''.join(parts)}</g>"


def _block(stress: Stress, cells: Sequence[Cell], top: float) -> tuple[str, float]:
    """The map of one operation and where it ends."""
    rows = list(dict.fromkeys((c.way, c.dtype) for c in cells))
    at = {(c.way, c.dtype, c.family): c for c in cells}
    parts = [f'<text class="title" x="10" y="{top + 18:.1f}">{html.escape(stress.title)}</text>']
    for i, family in enumerate(stress.families):
        x, y = _LABEL + i * _CELL + 15, top + _HEAD - 6
        name = html.escape(family.name if family.inside else f"({family.name})")
        turn = f'transform="rotate(-50 {x} {y:.1f})"'
        parts.append(f'<text class="small" x="{x}" y="{y:.1f}" {turn}>{name}</text>')
    for j, (way, dtype) in enumerate(rows):
        y = top + _HEAD + j * _ROW
        text = html.escape(f"{way} · {dtype.removeprefix('float')}")
        parts.append(f'<text x="10" y="{y + 13:.1f}">{text}</text>')
        for i, family in enumerate(stress.families):
            cell = at.get((way, dtype, family.name))
            if cell is not None:
                parts.append(_cell(cell, _LABEL + i * _CELL, y))
    return "".join(parts), top + _HEAD + len(rows) * _ROW + _TITLE


def _legend(y: float) -> str:
    parts, x = [], 10.0
    looks = [(f'fill="{colour}"', text) for _, colour, text in STEPS]
    looks += [('class="bad"', "not finite"), ('class="masked"', "masked by the operation")]
    looks.append(('class="none"', "not compared"))
    for look, text in looks:
        parts.append(_box(x, y, 14, look))
        parts.append(f'<text class="small" x="{x + 19:.1f}" y="{y + 13:.1f}">{text}</text>')
        x += 38 + 6.0 * len(text)
    note = "Left half: values. Right half: gradients of float32 and shorter. (In brackets, pale): "
    note += "outside the stated domain."
    parts.append(f'<text class="small" x="10" y="{y + 36:.1f}">{note}</text>')
    return "".join(parts)


def heat_map(which: Sequence[Stress], cells: Sequence[Cell], title: str) -> str:
    """An SVG file with one block per operation.

    Args:
        which: the operations, in this order.
        cells: all cells of a run.
        title: for readers that cannot see it.
    """
    parts, top, widest = [_legend(10.0)], float(_LEGEND + 12), 0
    for stress in which:
        own = [c for c in cells if c.operation == stress.name]
        if own:
            block, top = _block(stress, own, top)
            parts.append(block)
            widest = max(widest, len(stress.families))
    width = max(880, _LABEL + widest * _CELL + 90)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {top:.0f}" role="img">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style>"
        f'<rect class="paper" width="{width}" height="{top:.0f}" fill="#fff"/>'
        f"{''.join(parts)}</svg>\n"
    )
