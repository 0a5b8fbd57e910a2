"""One run of a mesh command: what it reads, where it writes, its picture and its report."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from monopart.geometry.atomic import write_bytes, write_json
from monopart.geometry.errors import InputError

from .meshio import Mesh, format_of, read_mesh, write_mesh
from .progress import Update

if TYPE_CHECKING:
    from .views import Panel

FOUND = 1
"""Exit code when the command ran and found something wrong."""
_WORDS = {
    "corner_uv": "texture coordinates",
    "weights": "weights",
    "skeleton": "skeleton",
    "colors": "colours",
    "texture": "texture",
}


@dataclass(frozen=True)
class Options:
    """What every command is told about its files."""

    out: Path | None = None
    """The file to write."""
    report: Path | None = None
    """Where the JSON report goes; beside `out` if None."""
    picture: Path | None = None
    """Where the picture goes; beside `out` if None."""
    no_picture: bool = False
    """Draw none."""
    picture_size: int = 640
    """Pixels along the side of a panel of the picture."""
    overwrite: bool = False
    """Files that are there may be replaced, but never an input."""
    text: bool = False
    """Write ply and stl as text."""


@dataclass
class Job:
    """Bookkeeping of a run; nothing is written before `finish`."""

    command: str
    options: Options
    update: Update
    inputs: list[Path] = field(default_factory=list)
    facts: list[dict[str, Any]] = field(default_factory=list)
    extra: dict[Path, Callable[[Path], object]] = field(default_factory=dict)
    """Other results and what writes them, whole or not at all."""
    start: float = field(default_factory=time.monotonic)

    def read(self, path: Path) -> Mesh:
        """Read a mesh and remember it as an input, after a look at where the results would go.

        Args:
            path: the mesh file.

        Raises:
            InputError: see `read_mesh`; or a result would replace a file that must stay.
        """
        self.using(path)
        self.update(0.0, "reading")
        mesh = read_mesh(path)
        self.facts.append(mesh_facts(mesh, path))
        print(f"{path.name}: {described(mesh)}")
        for note in mesh.notes:
            print(f"  note: {note}")
        return mesh

    def using(self, path: Path) -> None:
        """Remember a file that is only read.

        Args:
            path: the file.

        Raises:
            InputError: a result would replace a file that must stay.
        """
        self.inputs.append(path)
        self.guard_all()

    def guard_all(self) -> None:
        """Refuse options that make no sense and results that would replace what must stay.

        Raises:
            InputError: see `guard`.
        """
        if not 16 <= self.options.picture_size <= 4096:
            raise InputError(
                "--picture-size: expected from 16 to 4096 pixels, found "
                f"{self.options.picture_size}; choose another"
            )
        if self.options.out is not None:
            format_of(self.options.out)
        self.guard([p for p in (self.options.out, self.report(), self.picture()) if p])

    def beside(self, ending: str) -> Path:
        """A further result beside the mesh, guarded like it.

        Args:
            ending: what stands in place of the mesh's ending.

        Raises:
            InputError: see `guard`.
        """
        out = self.options.out or Path("out")
        path = out.with_name(out.stem + ending)
        self.guard([path])
        return path

    def guard(self, targets: Sequence[Path]) -> None:
        """Refuse to replace an input, or another file unless that was allowed.

        Args:
            targets: files about to be written.

        Raises:
            InputError: one of them must stay as it is.
        """
        for target in targets:
            if not target.parent.is_dir():
                raise InputError(
                    f"{target}: expected an existing folder to write into, found none; create it"
                )
            if any(_is_same(target, source) for source in self.inputs):
                raise InputError(
                    f"{target}: expected a file other than the input, found the input itself; "
                    "inputs are never changed, choose another name"
                )
            if target.exists() and not self.options.overwrite:
                raise InputError(
                    f"{target}: expected no such file yet, found one; choose another name or pass "
                    "--overwrite"
                )
        if len(set(targets)) < len(targets):
            raise InputError(
                f"{targets[0]}: expected different files for mesh, picture and report, found the "
                "same name twice; choose others"
            )

    def report(self) -> Path | None:
        """Where the JSON report goes, if anywhere."""
        out = self.options.out
        if self.options.report is not None or out is None:
            return self.options.report
        return out.with_name(f"{out.stem}.{self.command}.json")

    def picture(self) -> Path | None:
        """Where the picture goes, if anywhere."""
        out = self.options.out
        if self.options.no_picture:
            return None
        if self.options.picture is not None or out is None:
            return self.options.picture
        return out.with_name(f"{out.stem}.{self.command}.png")

    def finish(
        self,
        mesh: Mesh | None,
        result: dict[str, Any],
        panels: Callable[[int], "list[Panel]"],
        ok: bool = True,
    ) -> int:
        """Write mesh, picture and report, and say what was written.

        Args:
            mesh: what goes into `out`; None writes no mesh.
            result: what the command found, for the report.
            panels: draws the picture, given the pixels along the side of a panel.
            ok: nothing wrong was found.

        Returns:
            Exit code: 0, or 1 where something was found.

        Raises:
            InputError: a file cannot be written.
        """
        written: list[Path] = []
        entry: dict[str, Any] = {"command": self.command, "ok": ok, "input": self.facts}
        if mesh is not None and self.options.out is not None:
            self.update(0.9, "writing")
            entry["output"], files = self._write_mesh(mesh, self.options.out)
            written += files
        for path, write in self.extra.items():
            write(path)
            written.append(path)
        picture = self.picture()
        if picture is not None:
            self.update(0.92, "drawing")
            self._write_picture(picture, panels(self.options.picture_size))
            written.append(picture)
        report = self.report()
        if report is not None:
            written.append(report)
            entry |= {"result": result, "files": [p.name for p in written]}
            entry["seconds"] = round(time.monotonic() - self.start, 3)
            write_json(report, entry, nonfinite="null")
        self.update(1.0, "")
        if written:
            print("written: " + ", ".join(map(str, written)))
        return 0 if ok else FOUND

    def _write_mesh(self, mesh: Mesh, out: Path) -> tuple[dict[str, Any], list[Path]]:
        from .mesh_obj import sidecars

        files = [out]
        if out.suffix.lower() == ".obj":
            beside = sidecars(out, mesh)
            self.guard(beside)
            files = [*beside, out]
        lost = write_mesh(out, mesh, text=self.options.text)
        print(f"{out.name}: {described(mesh)}")
        for line in lost:
            print(f"  lost: {line}")
        return mesh_facts(mesh, out) | {"notes": [], "lost": list(lost)}, files

    def _write_picture(self, path: Path, panels: "list[Panel]") -> None:
        from .images import encoded
        from .views import sheet

        write_bytes(path, encoded(sheet(panels)))


def _is_same(target: Path, source: Path) -> bool:
    """Whether two names are one file, links included."""
    try:
        return os.path.samefile(target, source)
    except OSError:  # one of them is not there
        return os.path.abspath(target) == os.path.abspath(source)


def attributes(mesh: Mesh) -> list[str]:
    """What a mesh carries besides its triangles, in words.

    Args:
        mesh: the mesh.

    Returns:
        One word or two for each.
    """
    found = [word for name, word in _WORDS.items() if getattr(mesh, name) is not None]
    if mesh.weights is not None:
        place = found.index("weights")
        found[place] = f"weights ({mesh.weights.shape[1]} joints)"
    return found


def described(mesh: Mesh) -> str:
    """A mesh in one line.

    Args:
        mesh: the mesh.

    Returns:
        Counts and attributes.
    """
    line = f"{mesh.num_verts} vertices, {mesh.num_faces} faces"
    return "; ".join([line, *([", ".join(attributes(mesh))] if attributes(mesh) else [])])


def mesh_facts(mesh: Mesh, path: Path) -> dict[str, Any]:
    """A mesh for a report.

    Args:
        mesh: the mesh.
        path: its file.

    Returns:
        What JSON holds.
    """
    return {
        "file": path.name,
        "name": mesh.name,
        "vertices": mesh.num_verts,
        "faces": mesh.num_faces,
        "attributes": attributes(mesh),
        "notes": list(mesh.notes),
    }
