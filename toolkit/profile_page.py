"""What a profile of training steps looks like: a table, a trace for browsers, a page of its own."""

import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .atomic import write_text
from .explain import plain_console
from .profiling import Event, KindProfile, StageRow, kernel_rows, stage_rows
from .report_style import STYLE

TRACE, PAGE = "profile.json", "profile.html"
GAP = 2000.0  # microseconds between two steps of the trace
SHORTEST = 3.0  # microseconds; shorter operators are in the trace, not on the page
_CLASS = {"stage": "c1", "kernel": "c3", "autograd": "c4", "op": "c6"}


def write_profile(run: Path, profiles: Sequence[KindProfile]) -> None:
    """Write the trace and the page into a run folder.

    Args:
        run: the run folder.
        profiles: from `profile_training`.
    """
    write_text(run / TRACE, json.dumps(chrome_trace(profiles), separators=(",", ":")) + "\n")
    write_text(run / PAGE, profile_html(profiles))


def print_profile(profiles: Sequence[KindProfile]) -> None:
    """Print the tables of stages and kernels on stderr.

    Args:
        profiles: from `profile_training`.
    """
    from rich.table import Table

    console = plain_console()
    for title, rows in _tables(profiles):
        table = Table(title=title, title_justify="left")
        for number, name in enumerate(_head(profiles)):
            table.add_column(name, justify="right" if number else "left", no_wrap=not number)
        for row in rows:
            table.add_row(*_cells(row))
        console.print(table)


def chrome_trace(profiles: Sequence[KindProfile]) -> dict[str, Any]:
    """The traced steps, one after the other, in the Trace Event Format; the table beside them.

    Args:
        profiles: from `profile_training`.

    Reference: https://docs.google.com/document/d/1CvAClvFfyA5R-PhYUmn5OOQtYMH4h6I0nSsKchNAySU
    """
    threads = _threads([e for p in profiles for e in p.events])
    events: list[dict[str, Any]] = [
        {"name": "thread_name", "ph": "M", "pid": 1, "tid": i, "args": {"name": name}}
        for i, name in enumerate(threads)
    ]
    base = 0.0
    for p in profiles:
        for e in p.events:
            name = f"step ({p.kind.name})" if e.name == "step" and e.kind == "stage" else e.name
            where = {"ph": "X", "pid": 1, "tid": threads.index(e.thread)}
            when = {"ts": round(base + e.start, 3), "dur": round(e.duration, 3)}
            events.append({"name": name, "cat": e.kind, **where, **when})
        base += GAP + max((e.start + e.duration for e in p.events), default=0.0)
    rows = [
        {"stage": r.name.strip(), "wall_ms": r.mean_wall, "cpu_ms": r.mean_cpu, "share": r.share}
        for r in stage_rows(profiles)
    ]
    kinds = [{"kind": p.kind.name, "share": p.kind.share} for p in profiles]
    facts = {"average_step": rows, "kinds_of_steps": kinds}
    return {"traceEvents": events, "displayTimeUnit": "ms", "otherData": facts}


def _tables(profiles: Sequence[KindProfile]) -> list[tuple[str, list[StageRow]]]:
    return [
        ("Time of a training step, ms", stage_rows(profiles)),
        ("Warp kernels, ms summed over threads", kernel_rows(profiles)),
    ]


def _head(profiles: Sequence[KindProfile]) -> list[str]:
    kinds = [f"{p.kind.name} ({100 * p.kind.share:.1f} % of steps)" for p in profiles]
    return ["work", *kinds, "average wall", "average CPU", "share"]


def _cells(row: StageRow) -> list[str]:
    walls = ["-" if w is None else f"{w:.1f}" for w in row.wall]
    cpu = "-" if row.mean_cpu is None else f"{row.mean_cpu:.1f}"
    return [row.name, *walls, f"{row.mean_wall:.1f}", cpu, f"{100 * row.share:.1f} %"]


def _threads(events: Sequence[Event]) -> list[str]:
    """Threads in the order of their first event, that of the steps first."""
    return list(dict.fromkeys(e.thread for e in events))


def _table_html(title: str, head: Sequence[str], rows: Sequence[StageRow]) -> str:
    mark = ["", *[' class="n"'] * (len(head) - 1)]
    top = "".join(f"<th{m}>{html.escape(h)}</th>" for m, h in zip(mark, head, strict=True))
    body = []
    for row in rows:
        cells = "".join(
            f"<td{m}>{html.escape(c).replace('  ', '&emsp;')}</td>"
            for m, c in zip(mark, _cells(row), strict=True)
        )
        width = f"{100 * min(row.share, 1.0):.1f}%"
        body.append(
            f'<tr>{cells}<td><div class="bar"><i style="width:{width}"></i></div></td></tr>'
        )
    return (
        f'<h3 class="sub">{html.escape(title)}</h3><div class="scroll"><table><thead><tr>{top}'
        f"<th></th></tr></thead><tbody>{''.join(body)}</tbody></table></div>"
    )


def _page_data(profiles: Sequence[KindProfile]) -> dict[str, Any]:
    """Events with names and threads by number: what the script draws."""
    shown = [[e for e in p.events if e.kind != "op" or e.duration >= SHORTEST] for p in profiles]
    names = list(dict.fromkeys(e.name for events in shown for e in events))
    threads = _threads([e for events in shown for e in events])
    index, kinds = {n: i for i, n in enumerate(names)}, list(_CLASS)
    steps = []
    for p, events in zip(profiles, shown, strict=True):
        rows = []
        for e in events:
            what = index[e.name], kinds.index(e.kind), threads.index(e.thread)
            rows.append([*what, round(e.start, 1), round(e.duration, 1)])
        steps.append({"kind": p.kind.name, "events": rows})
    classes = list(_CLASS.values())
    return {"names": names, "threads": threads, "kinds": kinds, "classes": classes, "steps": steps}


def profile_html(profiles: Sequence[KindProfile]) -> str:
    """One page without any request: the tables, and a timeline to zoom into.

    Args:
        profiles: from `profile_training`.
    """
    head = _head(profiles)
    tables = "".join(_table_html(title, head, rows) for title, rows in _tables(profiles))
    data = json.dumps(_page_data(profiles), separators=(",", ":")).replace("<", "\\u003c")
    named = zip(
        ("stage", "Warp kernel", "backward function", "operator"), _CLASS.values(), strict=True
    )
    legend = "".join(f'<li class="{c}"><span class="key"></span>{n}</li>' for n, c in named)
    policy = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>Profile of a training step</title><style>{STYLE}{_STYLE}</style></head>"
        '<body><div class="wrap"><section><h1>Profile of a training step</h1>'
        '<p class="lead">The timeline is of one step of each kind, traced with all its operators, '
        "which slows it down; the tables below are means of steps without that.</p>"
        '<div class="dbar" id="kinds"></div>'
        f'<ul class="legend">{legend}</ul><div class="chart" id="flame"></div>'
        '<p class="small lead">Wheel or + and − zoom, dragging or the arrow keys move, double '
        "click or 0 shows the whole step. A rectangle names itself under the pointer.</p>"
        f"</section><section>{tables}<p class='small lead'>The parts of the backward pass are "
        "those of the traced step, scaled to the time of the others; the time of kernels is also "
        "in the stages that launch them. CPU is that of all threads.</p></section></div>"
        f'<script type="application/json" id="data">{data}</script>'
        f"<script>{_SCRIPT}</script></body></html>\n"
    )


_STYLE = """
#flame svg{width:100%;display:block;touch-action:none;cursor:grab;background:var(--panel)}
#flame rect{fill:var(--k);stroke:var(--panel);stroke-width:.5}
#flame text{font-size:11px;pointer-events:none;fill:#fff}
#flame text.lane{fill:var(--muted)}
@media(prefers-color-scheme:dark){#flame text{fill:#000}#flame text.lane{fill:var(--muted)}}
#kinds button{font:inherit;color:inherit;background:var(--panel);border:1px solid var(--line);
border-radius:5px;padding:6px 12px;cursor:pointer}
#kinds button[aria-pressed=true]{background:var(--ink);color:var(--bg)}
.dbar{padding:10px 0}
th.n{white-space:normal;max-width:12ch}
table{font-size:14px}th,td{padding:4px 10px 4px 0}td:first-child{white-space:nowrap}
"""

_SCRIPT = """
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const home = document.getElementById("flame"), bar = document.getElementById("kinds");
  const space = "http://www.w3.org/2000/svg", row = 18;
  const svg = document.createElementNS(space, "svg");
  svg.tabIndex = 0;
  svg.setAttribute("role", "img");
  svg.setAttribute("aria-label", "Timeline of a step");
  const tip = Object.assign(document.createElement("div"), {className: "tip"});
  home.append(svg);
  let rects = [], lanes = [], whole = 1, from = 0, to = 1, wide = 800;
  const ms = (us) => us < 1000 ? `${us.toFixed(1)} µs` : `${(us / 1000).toFixed(2)} ms`;
  const node = (tag, values, text) => {
    const made = document.createElementNS(space, tag);
    Object.entries(values).forEach(([name, value]) => made.setAttribute(name, value));
    if (text) made.textContent = text;
    return made;
  };
  const load = (step) => {
    rects = [];
    lanes = [];
    let top = 0;
    data.threads.forEach((thread, number) => {
      const open = [];
      let deepest = 0;
      const mine = step.events.filter((event) => event[2] === number);
      if (!mine.length) return;
      lanes.push({name: thread, y: top});
      top += row;
      mine.forEach(([name, kind, , start, duration]) => {
        while (open.length && open[open.length - 1] <= start) open.pop();
        rects.push({name: data.names[name], kind, start, duration, y: top + open.length * row});
        open.push(start + duration);
        deepest = Math.max(deepest, open.length);
      });
      top += deepest * row + 8;
    });
    whole = Math.max(...rects.map((rect) => rect.start + rect.duration));
    [from, to] = [0, whole];
    svg.setAttribute("height", top);
    draw();
  };
  const draw = () => {
    wide = svg.clientWidth || 800;
    svg.setAttribute("viewBox", `0 0 ${wide} ${svg.getAttribute("height")}`);
    const scale = wide / (to - from), made = [];
    lanes.forEach((lane) =>
      made.push(node("text", {x: 4, y: lane.y + 13, class: "lane"}, `thread ${lane.name}`)));
    rects.forEach((rect, index) => {
      const left = Math.max((rect.start - from) * scale, 0);
      const right = Math.min((rect.start + rect.duration - from) * scale, wide);
      if (right - left < 0.4) return;
      made.push(node("rect", {x: left, y: rect.y, width: right - left, height: row - 1,
        class: data.classes[rect.kind], "data-index": index}));
      const fits = Math.floor((right - left - 6) / 6.2);
      if (fits > 3) made.push(node("text", {x: left + 3, y: rect.y + 13},
        rect.name.length > fits ? rect.name.slice(0, fits - 1) + "…" : rect.name));
    });
    svg.replaceChildren(...made);
  };
  const view = (start, length) => {
    length = Math.min(Math.max(length, 5), whole);
    from = Math.min(Math.max(start, 0), whole - length);
    to = from + length;
    tip.remove();
    draw();
  };
  const zoom = (factor, at) => view(at - (at - from) * factor, (to - from) * factor);
  const place = (event) => from + (event.clientX - svg.getBoundingClientRect().left) / wide
    * (to - from);
  svg.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(event.deltaY > 0 ? 1.25 : 0.8, place(event));
  }, {passive: false});
  let held = null;
  svg.addEventListener("pointerdown", (event) => {
    held = {x: event.clientX, from};
    svg.setPointerCapture(event.pointerId);
  });
  svg.addEventListener("pointerup", () => { held = null; });
  svg.addEventListener("pointerleave", () => tip.remove());
  svg.addEventListener("pointermove", (event) => {
    if (held) {
      view(held.from - (event.clientX - held.x) / wide * (to - from), to - from);
      return;
    }
    const under = document.elementFromPoint(event.clientX, event.clientY);
    const rect = under && under.dataset && rects[under.dataset.index];
    if (!rect) { tip.remove(); return; }
    tip.textContent = `${rect.name}\\n${data.kinds[rect.kind]}, ${ms(rect.duration)} from `
      + ms(rect.start);
    const box = home.getBoundingClientRect();
    const x = Math.min(Math.max(event.clientX - box.left, 120), box.width - 120);
    tip.style.left = `${x}px`;
    tip.style.top = `${event.clientY - box.top - 8}px`;
    home.append(tip);
  });
  svg.addEventListener("dblclick", () => view(0, whole));
  svg.addEventListener("keydown", (event) => {
    const middle = (from + to) / 2, length = to - from;
    const acts = {"+": () => zoom(0.7, middle), "-": () => zoom(1.4, middle),
      0: () => view(0, whole), ArrowLeft: () => view(from - length / 5, length),
      ArrowRight: () => view(from + length / 5, length)};
    if (acts[event.key]) { event.preventDefault(); acts[event.key](); }
  });
  window.addEventListener("resize", draw);
  const buttons = data.steps.map((step) => {
    const made = Object.assign(document.createElement("button"),
      {type: "button", textContent: step.kind});
    made.addEventListener("click", () => {
      buttons.forEach((other) => other.setAttribute("aria-pressed", other === made));
      load(step);
    });
    return made;
  });
  bar.append(...buttons);
  if (buttons.length) buttons[0].click();
})();
"""
