"""``monopart-bench meshes``: every mesh command on the meshes that other packages ship."""

import argparse
import contextlib
import dataclasses
import hashlib
import io
import json
import os
import tempfile
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

from monopart.geometry.errors import InputError
from monopart.tools.cli import main as mesh_program
from monopart.tools.meshio import FORMATS

from .publish import grid
from .sections import write_section
from .suite import say
from .timing import timed

COMMANDS: dict[str, tuple[list[str], str]] = {
    "check": (["check", "{input}", "--no-picture"], "check.json"),
    "unwrap": (["unwrap", "{input}", "--no-picture"], "unwrap.npz"),
    "partition": (["partition", "{input}", "--no-picture"], "partition.ply"),
    "remesh": (["remesh", "{input}", "--clean", "--no-picture"], "remesh.npz"),
    "bake": (["bake", "distance", "{input}", "--unsigned", "--no-picture"], "bake.npz"),
    "convert": (["convert", "{input}", "--picture-size", "256"], "convert.glb"),
}
"""Arguments and result of each command, by its name."""
HEAD = ["mesh", "faces", "`check`", "`unwrap`", "energy", "`partition`", "`remesh --clean`"]
HEAD += ["`bake distance`", "`convert` to glb", "CPU s"]
_ENDINGS = set(FORMATS) - {".npz"}
CRASHED, CHANGED = -1, -2
"""Exit codes of a run that ended in a traceback, and of one that touched what it read."""
_CODES = {0: "done", 1: "found", 2: "refused", CRASHED: "**crash**", CHANGED: "**changed**"}


@dataclass(frozen=True)
class Run:
    """One command on one mesh."""

    mesh: str
    """Package and file."""
    command: str
    """Name of the command."""
    code: int
    """Exit code of the program, or one of those above."""
    words: str
    """What stderr said; of a crash, the traceback."""
    cpu: float
    """Processor seconds."""
    report: Mapping[str, Any]
    """The JSON report; empty where there is none."""


def mesh_files(folders: Sequence[Path], largest: int = 700, each: int = 8) -> dict[str, Path]:
    """Mesh files of folders, by the folder's name and their own, the small ones first.

    Args:
        folders: looked through with all that is in them.
        largest: size of the largest file that is taken, in thousands of bytes.
        each: meshes of a folder, at most: evenly spread over all, sorted by size.

    Raises:
        InputError: no such folder, or no mesh in it.
    """
    found: dict[str, Path] = {}
    for folder in folders:
        files = [p for p in folder.rglob("*") if p.suffix.lower() in _ENDINGS and p.is_file()]
        files = [p for p in files if p.stat().st_size <= 1000 * largest]
        if not files:
            raise InputError(f"{folder}: expected a folder with meshes, found none; name another")
        files.sort(key=lambda p: (p.stat().st_size, p))
        count = max(1, min(each, len(files)))
        for path in (files[(len(files) - 1) * n // max(count - 1, 1)] for n in range(count)):
            found.setdefault(f"{folder.name}: {path.name}", path)
    return found


def runs(name: str, path: Path) -> Iterator[Run]:
    """All commands on a mesh, each in a folder of its own.

    Args:
        name: what to call the mesh.
        path: its file.
    """
    for command in COMMANDS:
        with tempfile.TemporaryDirectory() as out:
            yield _run(name, path, command, Path(out))


def _run(name: str, path: Path, command: str, out: Path) -> Run:
    words, target = COMMANDS[command]
    argv = [word.format(input=path) for word in words] + ["-o", str(out / target)]
    before, said = _state(path), io.StringIO()

    def call() -> int:
        try:
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said):
                with mock.patch.dict(os.environ, MONOPART_DEBUG="1"):  # crashes are not reworded
                    return mesh_program(argv) or 0
        except (Exception, SystemExit):  # noqa: BLE001 - every crash is to be counted
            said.write(traceback.format_exc())
            return CRASHED

    _, cpu, code = timed(call)
    code = code if _state(path) == before else CHANGED
    report = out / ("check.json" if command == "check" else f"{command}.{command}.json")
    facts = json.loads(report.read_text()) if report.is_file() else {}
    text = said.getvalue().strip().replace(str(path), path.name)
    return Run(name, command, code, text, cpu, facts)


def _state(path: Path) -> tuple[str, list[str]]:
    """Content of a file, and the names of all that lies beside it."""
    return hashlib.sha256(path.read_bytes()).hexdigest(), sorted(os.listdir(path.parent))


def table(done: Sequence[Run]) -> str:
    """What came out, as Markdown: a line of sums and a row for each mesh.

    Args:
        done: all runs, those of a mesh in a row.
    """
    meshes: dict[str, dict[str, Run]] = {}
    for run in done:
        meshes.setdefault(run.mesh, {})[run.command] = run
    codes = [run.code for run in done]
    layouts = [run.report["result"] for run in done if run.command == "unwrap" and run.report]
    sums = (
        f"{len(meshes)} meshes, {len(done)} runs: {codes.count(0)} done, {codes.count(1)} done "
        f"with something found, {codes.count(2)} refused in one line, {codes.count(CRASHED)} "
        f"tracebacks, {codes.count(CHANGED)} inputs changed. {len(layouts)} layouts: "
        f"{sum(x['flips'] for x in layouts)} flips, {sum(x['overlaps'] for x in layouts)} overlaps"
    )
    if layouts:
        charts = sorted(x["charts"] for x in layouts)
        energy = sorted(x["symmetric_dirichlet"] for x in layouts)
        sums += f", {charts[0]}–{charts[-1]} charts, energy {energy[0]:.3f}–{energy[-1]:.3f}"
    rows = [_cells(name, by_command) for name, by_command in meshes.items()]
    notes = [
        f"- {run.mesh}, `{run.command}`: {(run.words.splitlines() or ['the input changed'])[-1]}"
        for run in done
        if run.code not in (0, 1)
    ]
    return "\n".join([f"{sums}.", "", *grid(HEAD, rows), *notes]).rstrip() + "\n"


def _cells(name: str, runs_by_command: Mapping[str, Run]) -> list[str]:
    facts = next((run.report["input"][0] for run in runs_by_command.values() if run.report), {})
    row = [name, str(facts.get("faces", "–"))]
    for command in COMMANDS:
        run = runs_by_command.get(command)
        result = {} if run is None else run.report.get("result", {})
        row.append("–" if run is None else _words(command, result) or _CODES[run.code])
        if command == "unwrap":
            row.append(f"{result['symmetric_dirichlet']:.3f}" if result else "–")
    return [*row, f"{sum(run.cpu for run in runs_by_command.values()):.1f}"]


def _words(command: str, result: Mapping[str, Any]) -> str:
    """The figure of a result that tells the most, if there is one."""
    if not result:
        return ""
    if command == "check":
        found = [f["name"] for f in result["findings"] if f["count"] and f["severity"] == "error"]
        return ", ".join(name.replace("_", " ") for name in found) or "ok"
    if command == "unwrap":
        return f"{result['charts']} charts, {100 * result['packing']:.0f} %"
    if command == "remesh":
        return f"{result['faces']} faces"
    if command == "bake":
        return " × ".join(map(str, result["shape"]))
    return ""


def write(arguments: argparse.Namespace) -> None:
    """Run all commands on all meshes of folders; keep the runs as JSON and, if asked, in a page.

    Args:
        arguments: `folders`, `largest` and `each` as of `mesh_files`; `out`, the folder of
            ``meshes.json``; `into`, a page with the marks of this table, or None.

    Raises:
        InputError: no meshes, no such page, or no marks in it.
    """
    done: list[Run] = []
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    files = mesh_files(arguments.folders, arguments.largest, arguments.each)
    for name, path in files.items():
        for run in runs(name, path):
            say(f"{name}: {run.command}: {run.code} ({run.cpu:.1f} s)")
            done.append(run)
        text = json.dumps([dataclasses.asdict(run) for run in done], indent=1)
        (out / "meshes.json").write_text(text + "\n", encoding="utf-8")
    print(table(done))
    if arguments.into is not None:
        write_section(arguments.into, "meshes", table(done))
