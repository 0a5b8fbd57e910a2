"""``monopart-bench meshes``: every mesh command on the meshes that other packages ship."""

import contextlib
import dataclasses
import hashlib
import io
import json
import os
import tempfile
import traceback
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from monopart.geometry.errors import InputError
from monopart.tools.cli import main as mesh_program
from monopart.tools.meshio import FORMATS

from .publish import BEGIN, END, grid
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
HEAD = ["mesh", "faces", "`check`: errors", "`unwrap`", "`partition`", "`remesh --clean`"]
HEAD += ["`bake distance`", "`convert`"]
CRASHED, CHANGED = -1, -2
"""Exit codes of a run that ended in a traceback, and of one that touched what it read."""


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


def mesh_files(folders: Sequence[Path], largest: int) -> dict[str, Path]:
    """Mesh files of folders, by the folder's name and their own, the small ones first.

    Args:
        folders: looked through with all that is in them.
        largest: bytes of the largest file that is taken.

    Raises:
        InputError: no such folder, or no mesh in it.
    """
    found: dict[str, Path] = {}
    for folder in folders:
        files = [p for p in folder.rglob("*") if p.suffix.lower() in FORMATS and p.is_file()]
        files = [p for p in files if p.suffix.lower() != ".npz" and p.stat().st_size <= largest]
        if not files:
            raise InputError(f"{folder}: expected a folder with meshes, found none; name another")
        for path in sorted(files, key=lambda p: (p.stat().st_size, p)):
            found.setdefault(f"{folder.name}: {path.name}", path)
    return found


def runs(name: str, path: Path, commands: Sequence[str] = tuple(COMMANDS)) -> Iterator[Run]:
    """Commands on a mesh, each in a folder of its own.

    Args:
        name: what to call the mesh.
        path: its file.
        commands: names of `COMMANDS`.
    """
    for command in commands:
        with tempfile.TemporaryDirectory() as out:
            yield _run(name, path, command, Path(out))


def _run(name: str, path: Path, command: str, out: Path) -> Run:
    words, target = COMMANDS[command]
    argv = [word.format(input=path) for word in words] + ["-o", str(out / target)]
    before, said = _state(path), io.StringIO()
    os.environ["MONOPART_DEBUG"] = "1"  # what is no error of the input must be seen as a crash

    def call() -> int:
        try:
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said):
                return mesh_program(argv) or 0
        except (Exception, SystemExit):
            said.write(traceback.format_exc())
            return CRASHED

    _, cpu, code = timed(call)
    code = code if _state(path) == before else CHANGED
    report = out / ("check.json" if command == "check" else f"{command}.{command}.json")
    facts = json.loads(report.read_text()) if report.is_file() else {}
    return Run(name, command, code, said.getvalue().strip(), cpu, facts)


def _state(path: Path) -> tuple[str, list[str]]:
    """Content of a file, and the names of all that lies beside it."""
    return hashlib.sha256(path.read_bytes()).hexdigest(), sorted(os.listdir(path.parent))


def write(folders: Sequence[Path], largest: int, out: Path, page: Path | None) -> None:
    """Run all commands on all meshes of folders; keep the runs as JSON and, if asked, in a page.

    Args:
        folders: where meshes are.
        largest: bytes of the largest file that is taken.
        out: folder for ``meshes.json``.
        page: a Markdown file with the marks of this table, or None.

    Raises:
        InputError: no meshes, no such page, or no marks in it.
    """
    done: list[Run] = []
    out.mkdir(parents=True, exist_ok=True)
    for name, path in mesh_files(folders, largest).items():
        for run in runs(name, path):
            say(f"{name}: {run.command}: {run.code} ({run.cpu:.1f} s) {run.words[-300:]}")
            done.append(run)
        text = json.dumps([dataclasses.asdict(run) for run in done], indent=1)
        (out / "meshes.json").write_text(text + "\n", encoding="utf-8")
    print(table(done))
