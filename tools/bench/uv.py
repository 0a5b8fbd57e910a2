"""``monopart-bench uv``: texture coordinates by our engine, by xatlas and by single methods."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from monopart.geometry.errors import InputError
from monopart.geometry.unwrap import UVLayout, unwrap
from monopart.geometry.uv_measure import seams_of_layout
from monopart.geometry.uv_mesh import MeshEdges
from monopart.geometry.uv_mirror import seam_symmetry
from monopart.geometry.uv_seams import Surface

from .publish import grid
from .registry import Method, Operation, Problem, Settings
from .results import Report, Row
from .sections import write_section
from .show import machine_line
from .unwrap_meshes import MESHES, UnwrapData, torus


def _by(parts: bool = False, **options: Any) -> Callable[[Any], Callable[[], Any]]:
    def prepare(data: UnwrapData) -> Callable[[], UVLayout]:
        labels = data.parts if parts else None
        return lambda: unwrap(data.verts, data.faces, parts=labels, **options)

    return prepare


def _methods() -> tuple[Method, ...]:
    few: dict[str, Any] = {"target": 4.15}
    whole: dict[str, Any] = {"chart_share": 1.0}
    return (
        Method("monopart", _by(), ours=True, single=True),
        Method("monopart, few charts", _by(**few), ours=True, single=True),
        Method("monopart, few charts, by parts", _by(True, **few), single=True, rare=True),
        Method("xatlas", _by(engine="xatlas"), ("xatlas",), "pip install xatlas", single=True),
        Method(
            "xatlas by parts",
            _by(True, engine="xatlas"),
            ("xatlas",),
            "pip install xatlas",
            single=True,
            rare=True,
        ),
        Method("harmonic on cut parts", _by(True, method="harmonic", **whole), single=True),
        Method("LSCM (libigl) on cut parts", _by(True, method="lscm", **whole), single=True),
        Method("ARAP on cut parts", _by(True, method="arap", **whole), single=True),
        Method(
            "SLIM (libigl) on cut parts, overlaps split",
            _by(True, target=1e6, **whole),
            single=True,
        ),
    )


def judge(data: UnwrapData, layout: UVLayout) -> dict[str, float]:
    """Figures of a layout; the error is the mean symmetric Dirichlet energy above 4."""
    report = layout.report
    verts, faces = data.verts.double().numpy(), data.faces.numpy()
    edges = MeshEdges.of(faces)
    seams = seams_of_layout(edges, layout.corner_uv.double().numpy())
    return {
        "error": report.symmetric_dirichlet - 4,
        "charts": report.charts,
        "flips": report.flips,
        "overlaps": report.overlaps,
        "angle p99": report.angle_p99,
        "area p99": report.area_p99,
        "seam m": report.seam_length,
        "packing": report.packing,
        "seam symmetry": seam_symmetry(Surface.of(verts, faces), seams),
    }


def _problems(settings: Settings, name: str) -> Iterator[Problem]:
    title, make = MESHES[name]
    data = torus(8, 5) if settings.quick else make()
    yield Problem(len(data.faces), title, data, thorough=len(data.parts.unique()) > 1)


NOTES = (
    "Single methods cut each part to a disc by our seams and flatten it once; they may flip faces "
    "and lay them on each other.",
    "Seam symmetry: share of the seams, by length, whose mirror image is a seam, edge by edge.",
)


def operations() -> list[Operation]:
    """One for each mesh."""
    return [
        Operation(
            name,
            f"Texture coordinates: {title}",
            "mean symmetric Dirichlet energy above 4 (an isometry)",
            _methods(),
            partial(_problems, name=name),
            judge,
            NOTES,
        )
        for name, (title, _) in MESHES.items()
    ]


HEAD = ["method", "s", "CPU s", "charts", "flips", "overlaps", "sym. Dirichlet", "angle p99"]
HEAD += ["seam m", "packed", "seam symmetry"]


def tables(report: Report) -> str:
    """A table for each mesh, as Markdown.

    Args:
        report: of this suite.
    """
    out = [machine_line(report), ""]
    for table in report.tables:
        title = table.rows[0].setting
        out += [f"### {title[0].upper()}{title[1:]}, {table.rows[0].size} faces", ""]
        out += grid(HEAD, [_cells(row) for row in table.rows])
    out += [f"- {note}" for note in NOTES]
    absent = {f"- Absent: {a.method}: {a.reason}" for table in report.tables for a in table.absent}
    return "\n".join([*out, *sorted(absent)]) + "\n"


def _cells(row: Row) -> list[str]:
    facts = row.facts
    # a layout with flips has no finite energy
    energy = "∞" if row.error is None else f"{4 + row.error:.4g}"
    return [
        f"**{row.method}**" if row.ours else row.method,
        f"{row.wall.median:.1f}",
        f"{row.cpu.median:.1f}",
        *(f"{facts[name]:.0f}" for name in ("charts", "flips", "overlaps")),
        energy,
        f"{facts['angle p99']:.3g}" if "angle p99" in facts else "∞",
        f"{facts['seam m']:.1f}",
        f"{100 * facts['packing']:.0f} %",
        f"{100 * facts['seam symmetry']:.0f} %" if "seam symmetry" in facts else "–",
    ]


def write_page(report: Report, page: Path) -> None:
    """Put the tables into a page, between the marks of this suite.

    Args:
        report: of this suite, not a quick one.
        page: a Markdown file with the marks.

    Raises:
        InputError: a quick report, no such page, or no marks.
    """
    if report.quick:
        raise InputError(f"{page}: expected measurements, found a --quick run; run it in full")
    write_section(page, "uv", tables(report))
