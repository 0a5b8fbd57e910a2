"""PLY: vertices with colours and weights, faces with corner UVs, joints as an element of their own.

Corner UVs are the face list `texcoord` (as MeshLab writes them), weights the vertex numbers
`weight_0` to `weight_J-1`, joints the element `joint` with its names as comments; a reader that
does not know these passes over them.
"""

import re
from pathlib import Path
from urllib.parse import quote, unquote

import numpy as np

from monopart.geometry.errors import InputError

from .meshio import Mesh, Skeleton
from .ply_elements import Lists, PlyFile, parse_ply
from .polygons import fan_corners, fan_notes

_JOINT = "monopart_joint "
_NAME = "monopart_name "
_UV_NAMES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))

Columns = dict[str, np.ndarray | Lists]


def read(path: Path) -> Mesh:
    """Read a text or binary PLY; other elements and properties are named in the notes."""
    file = parse_ply(path.read_bytes(), path)
    vertex = file.elements.get("vertex")
    if vertex is None or not {"x", "y", "z"} <= set(vertex):
        raise InputError(
            f"{path}: expected the element vertex with x, y and z, found none of it; "
            "export it with positions"
        )
    verts = np.stack([_numbers(vertex, axis) for axis in "xyz"], axis=1)
    faces, corner_uv, notes = _faces(file, path)
    if corner_uv is None:
        corner_uv = _vertex_uv(vertex, faces)
    weights = _weights(vertex)
    names = [c[len(_NAME) :] for c in file.comments if c.startswith(_NAME)]
    texture = [c for c in file.comments if c.lower().startswith("texturefile")]
    return Mesh(
        verts,
        faces,
        corner_uv=corner_uv,
        weights=weights,
        skeleton=_skeleton(file),
        colors=_colors(vertex),
        name=unquote(names[0]) if names else path.stem,
        notes=(*notes, *(f"{line}: the picture is not read" for line in texture)),
    )


def _numbers(columns: Columns, name: str) -> np.ndarray:
    values = columns[name]
    if isinstance(values, Lists):
        raise InputError(f"{name}: expected a number per row, found lists; correct the header")
    return values.astype(np.float64)


def _faces(file: PlyFile, path: Path) -> tuple[np.ndarray, np.ndarray | None, tuple[str, ...]]:
    element = file.elements.get("face", {})
    lists = element.get("vertex_indices", element.get("vertex_index"))
    if not isinstance(lists, Lists):
        if "tristrips" in file.elements:
            raise InputError(
                f"{path}: expected faces, found triangle strips; export it with faces instead"
            )
        return np.zeros((0, 3), dtype=np.int64), None, ()
    corners, dropped = fan_corners(lists.sizes)
    faces = lists.values[corners]
    uv, coordinates = None, element.get("texcoord")
    if isinstance(coordinates, Lists) and np.array_equal(coordinates.sizes, 2 * lists.sizes):
        uv = coordinates.values.astype(np.float64).reshape(-1, 2)[corners]
    return faces, uv, fan_notes(lists.sizes, dropped)


def _vertex_uv(vertex: Columns, faces: np.ndarray) -> np.ndarray | None:
    for u, v in _UV_NAMES:
        if u in vertex and v in vertex:
            return np.stack([_numbers(vertex, u), _numbers(vertex, v)], axis=1)[faces]
    return None


def _weights(vertex: Columns) -> np.ndarray | None:
    names = [name for name in vertex if re.fullmatch(r"weight_\d+", name)]
    if not names or set(names) != {f"weight_{j}" for j in range(len(names))}:
        return None
    return np.stack([_numbers(vertex, f"weight_{j}") for j in range(len(names))], axis=1)


def _skeleton(file: PlyFile) -> Skeleton | None:
    joint = file.elements.get("joint")
    if joint is None or not {"x", "y", "z", "parent"} <= set(joint):
        return None
    parents = tuple(int(parent) for parent in _numbers(joint, "parent"))
    names = tuple(unquote(c[len(_JOINT) :]) for c in file.comments if c.startswith(_JOINT))
    if len(names) != len(parents):
        names = tuple(f"joint_{j}" for j in range(len(parents)))
    return Skeleton(names, parents, np.stack([_numbers(joint, axis) for axis in "xyz"], axis=1))


def _colors(vertex: Columns) -> np.ndarray | None:
    for names in (("red", "green", "blue"), ("r", "g", "b")):
        if all(name in vertex for name in names):
            kinds = {getattr(vertex[name], "dtype", np.dtype("u1")).kind for name in names}
            values = np.stack([_numbers(vertex, name) for name in names], axis=1)
            # a text file holds all numbers as floats: whole ones above 1 are bytes
            is_byte = kinds <= set("iu") or (values.size > 0 and np.nanmax(values) > 1)
            return values / 255 if is_byte else values
    return None


def write(path: Path, mesh: Mesh, target: Path, text: bool) -> None:
    """Write a binary little-endian PLY, or a text one."""
    layout = "ascii" if text else "binary_little_endian"
    vertex = _vertex_table(mesh)
    face = _face_table(mesh)
    header = [
        "ply",
        f"format {layout} 1.0",
        f"comment {_NAME}{quote(mesh.name, safe=' ')}",
    ]
    tables = [vertex, face]
    if mesh.skeleton is not None:
        header += [f"comment {_JOINT}{quote(n, safe=' ')}" for n in mesh.skeleton.names]
    header += [f"element vertex {mesh.num_verts}", *_declared(vertex)]
    header += [f"element face {mesh.num_faces}", "property list uchar int vertex_indices"]
    if mesh.corner_uv is not None:
        header.append("property list uchar float texcoord")
    if mesh.skeleton is not None:
        joint = _joint_table(mesh.skeleton)
        tables.append(joint)
        header += [f"element joint {len(joint)}", *_declared(joint)]
    header.append("end_header")
    with path.open("wb") as stream:
        stream.write(("\n".join(header) + "\n").encode("ascii"))
        for table in tables:
            stream.write(_rows(table).encode("ascii") if text else table.tobytes())


def _vertex_table(mesh: Mesh) -> np.ndarray:
    fields: list[tuple[str, str]] = [(axis, "<f8") for axis in "xyz"]
    columns = [mesh.verts]
    if mesh.colors is not None:
        fields += [(name, "u1") for name in ("red", "green", "blue")]
        columns.append(np.rint(np.clip(np.nan_to_num(mesh.colors), 0, 1) * 255))
    if mesh.weights is not None:
        fields += [(f"weight_{j}", "<f8") for j in range(mesh.weights.shape[1])]
        columns.append(mesh.weights)
    table = np.zeros(mesh.num_verts, dtype=fields)
    for (name, _), column in zip(fields, np.concatenate(columns, axis=1).T, strict=True):
        table[name] = column
    return table


def _face_table(mesh: Mesh) -> np.ndarray:
    fields: list[tuple[str, ...] | tuple[str, str, int]] = [("n", "u1"), ("corners", "<i4", 3)]
    if mesh.corner_uv is not None:
        fields += [("m", "u1"), ("texcoord", "<f4", 6)]
    table = np.zeros(mesh.num_faces, dtype=fields)
    table["n"], table["corners"] = 3, mesh.faces
    if mesh.corner_uv is not None:
        table["m"], table["texcoord"] = 6, mesh.corner_uv.reshape(-1, 6)
    return table


def _joint_table(skeleton: Skeleton) -> np.ndarray:
    fields = [(axis, "<f8") for axis in "xyz"]
    table = np.zeros(len(skeleton.parents), dtype=[*fields, ("parent", "<i4")])
    for axis, column in zip("xyz", skeleton.joints.T, strict=True):
        table[axis] = column
    table["parent"] = skeleton.parents
    return table


def _declared(table: np.ndarray) -> list[str]:
    words = {"f8": "double", "u1": "uchar", "i4": "int"}
    names = table.dtype.names or ()
    return [f"property {words[table.dtype[name].str[1:]]} {name}" for name in names]


def _rows(table: np.ndarray) -> str:
    def cell(value: object) -> str:
        if isinstance(value, np.ndarray):
            return " ".join(cell(item) for item in value.tolist())
        return f"{value:.17g}" if isinstance(value, float) else str(value)

    return "".join(" ".join(map(cell, row)) + "\n" for row in table.tolist())
