"""Wavefront OBJ with its material and picture; vertex colours stand behind the position."""

import io
import re
from pathlib import Path

import numpy as np

from monopart.geometry.atomic import write_bytes, write_text
from monopart.geometry.errors import InputError

from .images import decoded, encoded
from .meshio import Mesh
from .polygons import fan_corners, fan_notes

_OPTIONS = re.compile(
    r"(?:-(?:[ost](?:\s+[-+.\dEe]+){1,3}|mm(?:\s+\S+){2}|(?!(?:[ost]|mm)\s)[A-Za-z]+\s+\S+)\s+)*"
)
"""Options of a map, before the name of its picture."""


class _Lines:
    """What the lines of an OBJ file say."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.verts: list[list[str]] = []
        self.uvs: list[list[str]] = []
        self.corners: list[tuple[int, int]] = []
        self.sizes: list[int] = []
        self.libraries: list[str] = []
        self.materials: list[str] = []
        self.name = ""
        self.unknown: set[str] = set()

    def read(self, text: str) -> None:
        for number, line in enumerate(text.replace("\\\n", " ").splitlines(), 1):
            words = line.split()
            if words and not words[0].startswith("#"):
                self.line(words, line, number)

    def line(self, words: list[str], line: str, number: int) -> None:
        kind, values = words[0], words[1:]
        if kind == "v":
            self.verts.append(values)
        elif kind == "vt":
            self.uvs.append(values)
        elif kind == "f":
            self.face(values, number)
        elif kind in ("mtllib", "usemtl", "o"):
            self.named(kind, line.strip()[len(kind) :].strip())
        elif kind not in ("vn", "g", "s"):
            self.unknown.add(kind)

    def named(self, kind: str, value: str) -> None:
        if kind == "mtllib":
            self.libraries.append(value)
        elif kind == "usemtl":
            self.materials.append(value)
        else:
            self.name = self.name or value

    def face(self, values: list[str], number: int) -> None:
        for corner in values:
            parts = corner.split("/")
            uv = parts[1] if len(parts) > 1 else ""
            self.corners.append(
                (
                    self.index(parts[0], len(self.verts), number),
                    self.index(uv, len(self.uvs), number) if uv else -1,
                )
            )
        self.sizes.append(len(values))

    def index(self, word: str, count: int, number: int) -> int:
        try:
            value = int(word)
        except ValueError:
            value = 0
        index = value - 1 if value > 0 else count + value
        if value == 0 or not 0 <= index < 2**53:
            raise InputError(
                f"{self.path}: line {number}: expected an index from 1 or from -{count}, "
                f"found {word or 'nothing'}; correct the face"
            )
        return index


def read(path: Path) -> Mesh:
    """Read an OBJ; groups become one mesh, and one picture is read where all materials share it."""
    lines = _Lines(path)
    data = path.read_bytes()
    if b"\0" in data:
        raise InputError(
            f"{path}: expected text, found zero bytes; it is damaged, of another "
            "kind, or UTF-16: save it as OBJ in UTF-8"
        )
    lines.read(data.decode("utf-8-sig", "replace"))
    if not lines.verts:
        raise InputError(
            f"{path}: expected lines of vertices (v x y z), found none; it is empty or "
            "no OBJ, export it again"
        )
    verts, colors, odd = _positions(lines.verts, path)
    sizes = np.array(lines.sizes, dtype=np.int64)
    fans, dropped = fan_corners(sizes)
    corners = np.array(lines.corners, dtype=np.int64).reshape(-1, 2)
    faces = corners[:, 0][fans]
    corner_uv, notes = _uv(lines, corners[:, 1][fans], path)
    texture, more = _texture(lines, path) if corner_uv is not None else (None, [])
    unknown = [f"{kind} lines: not read" for kind in sorted(lines.unknown)]
    return Mesh(
        verts,
        faces,
        corner_uv=corner_uv,
        colors=colors,
        texture=texture,
        name=lines.name or path.stem,
        notes=(*fan_notes(sizes, dropped), *odd, *notes, *more, *unknown),
    )


def _positions(
    rows: list[list[str]], path: Path
) -> tuple[np.ndarray, np.ndarray | None, list[str]]:
    """Positions, colours, and what is not kept."""
    widths = {len(row) for row in rows}
    if min(widths) < 6:
        lost = ["colors: not on every vertex, not read"] if max(widths) >= 6 else []
        return _numbers(rows, 3, "vertex", path), None, lost
    values = _numbers(rows, 6, "vertex", path)
    colors = values[:, 3:]
    is_byte = (colors > 1).any() and (colors == np.rint(colors)).all()  # as some programs write
    return values[:, :3], colors / 255 if is_byte else colors, []


def _numbers(rows: list[list[str]], width: int, what: str, path: Path) -> np.ndarray:
    """The first numbers of each row, (n, width)."""
    values = []
    for number, row in enumerate(rows, 1):
        try:
            values.append([float(row[column]) for column in range(width)])
        except (ValueError, IndexError):
            raise InputError(
                f"{path}: {what} {number}: expected {width} numbers such as 0.5, found "
                f"{' '.join(row)[:80] or 'none'}; correct it, or export it again"
            ) from None
    return np.array(values, dtype=np.float64).reshape(-1, width)


def _uv(lines: _Lines, index: np.ndarray, path: Path) -> tuple[np.ndarray | None, list[str]]:
    if not lines.uvs or not (index >= 0).any():
        return None, []
    if index.max() >= len(lines.uvs):
        raise InputError(
            f"{path}: expected texture indices up to {len(lines.uvs)}, found {index.max() + 1}; "
            "correct the faces"
        )
    rows = [[*row, "0"] if len(row) == 1 else row for row in lines.uvs]
    uv = _numbers(rows, 2, "vt", path)
    missing = int((index < 0).any(axis=1).sum())
    notes = [f"texture coordinates: none on {missing} faces, set to 0"] if missing else []
    return np.where((index < 0)[..., None], 0.0, uv[np.maximum(index, 0)]), notes


def _texture(lines: _Lines, path: Path) -> tuple[np.ndarray | None, list[str]]:
    names: list[str] = []
    notes: list[str] = []
    for library in lines.libraries:
        file = path.parent / library
        if not file.is_file():
            notes.append(f"{library}: the material file is missing")
            continue
        names += _pictures(file.read_text("utf-8-sig", "replace"))
    pictures = list(dict.fromkeys(_OPTIONS.sub("", name, count=1) for name in names))
    if pictures and not set(pictures) & set(names):
        notes.append("options of the picture: not kept")
    if len(pictures) != 1:
        return None, notes + ([f"textures: {len(pictures)} pictures, not read"] if pictures else [])
    file = path.parent / pictures[0].replace("\\", "/")
    if not file.is_file():
        return None, [*notes, f"{pictures[0]}: the picture is missing"]
    try:
        return decoded(file.read_bytes(), pictures[0]), notes
    except InputError as error:  # the shape is whole, and many tools need no picture
        return None, [*notes, f"not read: {error}"]


def _pictures(text: str) -> list[str]:
    found = []
    for line in text.splitlines():
        words = line.split(None, 1)
        if len(words) == 2 and words[0] == "map_Kd":
            found.append(words[1].strip())
    return found


def sidecars(target: Path, mesh: Mesh) -> list[Path]:
    """Files that stand beside an OBJ of this mesh.

    Args:
        target: the OBJ.
        mesh: what it holds.

    Returns:
        The picture and the material file, where there is a picture.
    """
    if mesh.texture is None or mesh.corner_uv is None:
        return []
    return [target.with_suffix(".png"), target.with_suffix(".mtl")]


def write(path: Path, mesh: Mesh, target: Path, text: bool) -> None:
    """Write the OBJ after its picture and material, so that it never names what is not there."""
    out = io.StringIO()
    files = sidecars(target, mesh)
    if files and mesh.texture is not None:
        picture, material = files
        write_bytes(picture, encoded(mesh.texture))
        write_text(material, f"newmtl textured\nKd 1 1 1\nmap_Kd {picture.name}\n")
        out.write(f"mtllib {material.name}\nusemtl textured\n")
    out.write(f"o {' '.join(mesh.name.split()) or 'mesh'}\n")
    values = [mesh.verts] if mesh.colors is None else [mesh.verts, mesh.colors]
    for row in np.concatenate(values, axis=1).tolist():
        out.write("v " + " ".join(f"{value:.17g}" for value in row) + "\n")
    faces = mesh.faces + 1
    if mesh.corner_uv is None:
        for a, b, c in faces.tolist():
            out.write(f"f {a} {b} {c}\n")
    else:
        _write_uv(out, faces, mesh.corner_uv)
    path.write_text(out.getvalue(), encoding="utf-8")


def _write_uv(out: io.StringIO, faces: np.ndarray, corner_uv: np.ndarray) -> None:
    unique, inverse = np.unique(corner_uv.reshape(-1, 2), axis=0, return_inverse=True)
    for u, v in unique.tolist():
        out.write(f"vt {u:.17g} {v:.17g}\n")
    rows = np.concatenate([faces, inverse.reshape(-1, 3) + 1], axis=1)
    for a, b, c, x, y, z in rows.tolist():
        out.write(f"f {a}/{x} {b}/{y} {c}/{z}\n")
