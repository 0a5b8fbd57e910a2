"""The page of stability: tables of the worst case of every operation, and heat maps beside it."""

import math
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import torch

from monopart.geometry.errors import InputError

from .sections import marks, write_section
from .stability import ROOMS, chosen, run, write_json
from .stability_cases import Cell, Outcome, Stress
from .stability_heat import heat_map

Rooms = Mapping[str, Sequence[Stress]]
BEGIN, END = marks("stability")
FACTORS = {"quick": 0.1, "usual": 1.0, "exhaustive": 4.5}
"""Cases of a family, in those of a usual run."""
PROMISED = {"blend_skin", "body", "project", "rays", "undistort", "closest_point"}
"""Operations that are promised to 1e-6 in float32."""
SLOPE, PLACES, WORST = 1e-4, 4.0, 0.1
"""Largest relative error of a gradient; in float32, or so many times what one last place in the
inputs does to the exact gradient, where that is more; and at most this."""
_HEAD = ("operation", "by", "type", "worst error", "ulp", "family", "condition", "gradient")
_HEAD = (*_HEAD, "by one place", "masked", "bad")


def _number(value: float | None) -> str:
    return "-" if value is None else ("0" if value == 0 else f"{value:.1e}")


def _largest(cells: Iterable[Cell], of: str) -> tuple[float, Cell] | None:
    known = [(getattr(c, of), c) for c in cells if getattr(c, of) is not None]
    return max(known, key=lambda pair: pair[0]) if known else None


def _line(entries: Sequence[str]) -> str:
    return "| " + " | ".join(e.replace("|", "\\|") for e in entries) + " |"


def _row(title: str, cells: Sequence[Cell]) -> str:
    """One implementation in one precision, over all families inside the domain."""
    value, slope = _largest(cells, "value"), _largest(cells, "gradient")
    gains = [c.slopes.amplification for c in cells if c.slopes.amplification is not None]
    masked = sum(c.masked for c in cells) / max(sum(c.cases for c in cells), 1)
    bad = sum(c.bad_values for c in cells), sum(c.bad_gradients for c in cells)
    stopped = sum(bool(c.raised) for c in cells)
    entries = [
        *(title, cells[0].way, cells[0].dtype),
        _number(value[0] if value else None),
        _number(value[1].ulp if value else None),
        value[1].family if value and value[0] else "-",
        _number(max(gains) if gains else None),
        _number(slope[0] if slope else None),
        _number(slope[1].slopes.spread if slope else None),
        f"{100 * masked:.0f} %" if masked else "0",
        f"**{bad[0]} / {bad[1]}**" if any(bad) else "0",
    ]
    if stopped:
        entries[-1] += f"; an error in {stopped}"
    return _line(entries)


def _table(which: Sequence[Stress], cells: Sequence[Cell]) -> list[str]:
    out = [_line(_HEAD), "|" + "---|" * len(_HEAD)]
    for stress in which:
        own = [c for c in cells if c.operation == stress.name and c.inside]
        title = f"**{stress.title}**"
        for key in dict.fromkeys((c.way, c.dtype) for c in own):
            out.append(_row(title, [c for c in own if (c.way, c.dtype) == key]))
            title = ""
    return [*out, ""]


def _domains(which: Sequence[Stress]) -> list[str]:
    out = ["| operation | holds for; else | errors relative to |", "|---|---|---|"]
    out += [_line((s.title, s.domain, s.error)) for s in which]
    return [*out, ""]


def verdict(which: Sequence[Stress], outcome: Outcome) -> list[str]:
    """The promises, with what a run measured, as lines of a list.

    Args:
        which: the operations that ran.
        outcome: the run.
    """
    ours = [c for c in outcome.cells if c.ours and c.inside]
    bad = sum(c.bad_values + c.bad_gradients for c in ours)
    single = [c for c in ours if c.dtype == "float32" and c.operation in PROMISED]
    worst = _largest(single, "value")
    out = [
        f"- {outcome.cases} cases in {len(outcome.cells)} combinations of operation, family, type "
        f"and implementation; {sum(c.cases for c in ours)} cases are ours and inside the domains.",
        f"- Of these, values or gradients that are not finite: **{bad}**.",
    ]
    if worst is not None:
        where = f"{worst[1].operation}, {worst[1].family}"
        out.append(
            "- Skinning, bodies, cameras and closest surface in float32: at most "
            f"**{worst[0]:.1e}** of the scale ({where}); promised: 1e-6."
        )
    beaten = [text for stress in which for text in _losses(stress, outcome.cells)]
    if beaten:
        out.append("- A peer's worst error is smaller by more than a third: " + "; ".join(beaten))
    return [*out, ""]


def _losses(stress: Stress, cells: Sequence[Cell]) -> list[str]:
    """Where a peer is clearly more exact than our first way, on the families that it ran."""
    inside = [c for c in cells if c.operation == stress.name and c.inside]
    found = []
    for way in (w for w in stress.ways if not w.ours):
        for dtype in ("float32", "float64"):
            their = [c for c in inside if c.way == way.name and c.dtype == dtype]
            shared = {c.family for c in their}
            mine = [c for c in inside if c.way == stress.ways[0].name and c.dtype == dtype]
            a = _largest([c for c in mine if c.family in shared], "value")
            b = _largest(their, "value")
            if any(c.bad_values or c.raised for c in their) or a is None or b is None:
                continue
            if 1.5 * b[0] < a[0]:
                found.append(f"{way.name}, {stress.title}, {dtype} ({b[0]:.1e}, ours {a[0]:.1e})")
    return found


def section(rooms: Rooms, outcome: Outcome, folder: str) -> str:
    """What the command writes between its marks.

    Args:
        rooms: the operations that ran, by room.
        outcome: the run.
        folder: where the heat maps lie, relative to the page.
    """
    machine = f"{platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}"
    every = [s for own in rooms.values() for s in own]
    out = [f"Measured on {machine}.", "", *verdict(every, outcome)]
    for room, own in rooms.items():
        out += [f"### {ROOMS[room]}", "", *_domains(own), *_table(own, outcome.cells)]
        out += [f"![Heat map: {ROOMS[room]}]({folder}/{room}.svg)", ""]
    if outcome.absent:
        names = ", ".join(f"{k} (needs {v})" for k, v in outcome.absent.items())
        out += [f"Not installed, and so not measured: {names}.", ""]
    return "\n".join(out)


def _write_maps(rooms: Rooms, outcome: Outcome, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for room, own in rooms.items():
        svg = heat_map(own, outcome.cells, ROOMS[room])
        (folder / f"{room}.svg").write_text(svg, encoding="utf-8")


def write(rooms: Rooms, outcome: Outcome, out: Path) -> None:
    """Write ``stability.json``, the section as ``stability.md`` and the heat maps.

    Args:
        rooms: the operations that ran, by room.
        outcome: the run.
        out: the folder.
    """
    write_json(outcome, out / "stability.json")
    (out / "stability.md").write_text(section(rooms, outcome, "stability"), encoding="utf-8")
    _write_maps(rooms, outcome, out / "stability")


def publish(rooms: Rooms, outcome: Outcome, page: Path) -> None:
    """Write the section into a page, between its marks, and the heat maps into a folder beside it.

    Args:
        rooms: the operations that ran, by room.
        outcome: the run.
        page: a Markdown file with the two marks.

    Raises:
        InputError: no such page, or no marks in it.
    """
    write_section(page, "stability", section(rooms, outcome, page.stem))
    _write_maps(rooms, outcome, page.with_suffix(""))


def failures(which: Sequence[Stress], outcome: Outcome) -> list[str]:
    """What breaks a promise of ours: a line each, none where all hold.

    Args:
        which: the operations that ran.
        outcome: the run.
    """
    by_name = {s.name: s for s in which}
    ours = [c for c in outcome.cells if c.ours and c.inside]
    return [text for cell in ours for text in _broken(by_name[cell.operation], cell)]


def _broken(stress: Stress, cell: Cell) -> list[str]:
    way = next(w for w in stress.ways if w.name == cell.way)
    values = {"float32": way.limit or stress.limit, "float64": way.double or stress.double}
    # a gradient may be off by what a few last places of the inputs do to it: no float does better
    slopes = {
        "float32": max(SLOPE, min(WORST, PLACES * (cell.slopes.spread or 0.0))),
        "float64": SLOPE,
    }
    checks = (
        ("values not finite", cell.bad_values, 0.0),
        ("gradients not finite", cell.bad_gradients, 0.0),
        ("error", cell.value, values.get(cell.dtype, 16 * torch.finfo(cell.kind).eps)),
        ("gradient error", cell.gradient, slopes.get(cell.dtype, math.inf)),
    )
    where = f"{stress.name}, {cell.family}, {cell.way}, {cell.dtype}"
    return [
        f"{where}: {name} {got:.3g}, promised {most:.3g}"
        for name, got, most in checks
        if got is not None and not got <= most
    ]


def command(size: str, only: Sequence[str], out: Path, page: Path | None) -> None:
    """Run, write, and tell what breaks a promise.

    Args:
        size: one of `FACTORS`; a quick run leaves other libraries out.
        only: names of operations; none is all.
        out: folder of ``stability.json``, ``stability.md`` and the heat maps.
        page: a page to write into, or None.

    Raises:
        InputError: an unknown operation, a page that cannot be written, or a broken promise.
    """
    rooms = chosen(only)
    which = [s for own in rooms.values() for s in own]
    outcome = run(which, FACTORS[size], size != "quick", size == "exhaustive")
    write(rooms, outcome, out)
    if page is not None:
        publish(rooms, outcome, page)
    print("\n".join(verdict(which, outcome)))
    broken = failures(which, outcome)
    if broken:
        raise InputError(f"stability: {len(broken)} promises broken\n  " + "\n  ".join(broken))
