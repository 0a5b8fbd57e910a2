"""STL: triangles without sharing; equal corners become one vertex when it is read."""

import io
import re
from pathlib import Path

import numpy as np

from monopart.geometry.errors import InputError

from .meshio import Mesh

_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER = 84
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)


def read(path: Path) -> Mesh:
    """Read a binary or text STL."""
    data = path.read_bytes()
    count = int.from_bytes(data[80:_HEADER], "little") if len(data) >= _HEADER else -1
    expected = _HEADER + count * _RECORD.itemsize
    name = path.stem
    if count >= 0 and len(data) == expected:
        corners = np.frombuffer(data, _RECORD, count, _HEADER)["corners"].astype(np.float64)
    elif data.lstrip()[:5].lower() == b"solid":
        if b"endsolid" not in data.lower():
            raise InputError(
                f"{path}: expected 'endsolid' at its end, found none; it is cut short, "
                "copy or export it again"
            )
        found = _VERTEX.findall(data)
        if len(found) % 3:
            raise InputError(
                f"{path}: expected three vertices a triangle, found {len(found)} vertices in all; "
                "it is damaged, export it again"
            )
        corners = np.array(found, dtype=object).astype(np.float64).reshape(-1, 3, 3)
        title = data.lstrip()[5:].split(b"\n", 1)[0].decode("utf-8", "replace").strip()
        name = title or name
    else:
        size = "at least 84" if count < 0 else f"{expected} (its count says {count} triangles)"
        raise InputError(
            f"{path}: expected a text that begins with 'solid', or a binary STL of {size} bytes, "
            f"found {len(data)} bytes; it is cut short, damaged or no STL: export it again"
        )
    verts, inverse = np.unique(corners.reshape(-1, 3) + 0.0, axis=0, return_inverse=True)
    order, faces = _first_seen(inverse.reshape(-1))
    return Mesh(verts[order], faces.reshape(-1, 3), name=name)


def _first_seen(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Labels in the order of their first use, and the places of all labels in that order."""
    unique, first = np.unique(labels, return_index=True)
    order = unique[np.argsort(first)]
    place = np.zeros(len(unique), dtype=np.int64)
    place[order] = np.arange(len(order))
    return order, place[labels]


def write(path: Path, mesh: Mesh, target: Path, text: bool) -> None:
    """Write the triangles, as float32."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        corners = mesh.verts[mesh.faces].astype("<f4")
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.nan_to_num(normals / np.where(length > 0, length, 1))
    if not np.isfinite(corners).all():
        raise InputError(
            f"{target}: vertices: expected numbers within float32, found others; clean the mesh "
            "first, or choose ply or npz"
        )
    if text:
        path.write_text(_text(corners, normals, mesh.name), encoding="utf-8")
        return
    records = np.zeros(len(corners), dtype=_RECORD)
    records["normal"], records["corners"] = normals, corners
    header = b"binary STL".ljust(80) + len(corners).to_bytes(4, "little")
    path.write_bytes(header + records.tobytes())


def _text(corners: np.ndarray, normals: np.ndarray, name: str) -> str:
    title = " ".join(name.split())
    out = io.StringIO()
    out.write(f"solid {title}\n")
    for normal, triangle in zip(normals.tolist(), corners.tolist(), strict=True):
        out.write("facet normal {:.9g} {:.9g} {:.9g}\nouter loop\n".format(*normal))
        for corner in triangle:
            out.write("vertex {:.9g} {:.9g} {:.9g}\n".format(*corner))
        out.write("endloop\nendfacet\n")
    out.write(f"endsolid {title}\n")
    return out.getvalue()
