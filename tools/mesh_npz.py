"""Meshes as npz in the layout of body files, so that `BodyModel.load` reads those with a skin."""

import io
import zipfile
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import Float

from monopart.geometry.errors import InputError
from monopart.geometry.joint_names import joint_names

from .meshio import Mesh, Skeleton

_NEIGHBOURS = 64  # vertices near a joint that its row of the regressor may use
_EXACT = 1e-9  # metres; a row that misses its joint by more uses every vertex


def read(path: Path) -> Mesh:
    """Read a body file or a mesh that `write` made; pickled members are left alone."""
    arrays, skipped = _arrays(path)
    verts = _pick(arrays, path, "v_template", "verts", "vertices")
    faces = _pick(arrays, path, "f", "faces")
    notes = [f"{name}: holds objects, not read" for name in skipped]
    notes += [
        f"{name}: not kept (build such bodies by monopart-mesh body)"
        for name in ("shapedirs", "posedirs")
        if name in arrays and np.any(arrays[name])
    ]
    weights = arrays.get("weights", arrays.get("lbs_weights"))
    texture = arrays.get("texture")
    return Mesh(
        verts=verts,
        faces=faces,
        corner_uv=_corner_uv(arrays),
        weights=weights,
        skeleton=_skeleton(arrays, verts),
        colors=arrays.get("colors"),
        texture=None if texture is None else texture.astype(np.float64) / 255,
        name=str(arrays["name"]) if "name" in arrays else path.stem,
        notes=tuple(notes),
    )


def _arrays(path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """Arrays of an archive by their names, and the names of those that only a pickle could give."""
    arrays, skipped = {}, []
    try:
        with path.open("rb") as stream, zipfile.ZipFile(stream) as archive:
            for member in archive.namelist():
                if not member.endswith(".npy"):
                    continue
                name = member.removesuffix(".npy")
                content = io.BytesIO(archive.read(member))
                try:
                    arrays[name] = np.lib.format.read_array(content, allow_pickle=False)
                except ValueError as error:
                    if "allow_pickle" not in str(error):
                        raise
                    skipped.append(name)
    except (zipfile.BadZipFile, zlib.error, RuntimeError, EOFError, SyntaxError) as error:
        raise InputError(
            f"{path}: expected a whole npz archive, found damage ({error}); export it again"
        ) from error
    return arrays, skipped


def _pick(arrays: dict[str, np.ndarray], path: Path, *names: str) -> np.ndarray:
    for name in names:
        if name in arrays and arrays[name].dtype.kind in "fiu":
            return arrays[name]
    found = ", ".join(sorted(arrays)) or "nothing"
    raise InputError(
        f"{path}: expected numbers named {' or '.join(names)}, found {found}; "
        "use the layout of a body file"
    )


def _corner_uv(arrays: dict[str, np.ndarray]) -> np.ndarray | None:
    if "vt" not in arrays or "ft" not in arrays:
        return None
    rows = arrays["ft"].astype(np.int64)
    if rows.size and (rows.min() < 0 or rows.max() >= len(arrays["vt"])):
        raise InputError(
            f"ft: expected indices in 0..{len(arrays['vt']) - 1}, found {rows.min()}..{rows.max()}"
            "; correct the texture faces"
        )
    return arrays["vt"][rows].astype(np.float64)


def _skeleton(arrays: dict[str, np.ndarray], verts: np.ndarray) -> Skeleton | None:
    if "kintree_table" in arrays:
        table = arrays["kintree_table"].astype(np.int64)
        place = {joint: column for column, joint in enumerate(table[1].tolist())}
        parents = tuple(place.get(parent, -1) for parent in table[0].tolist())
        parents = (-1, *parents[1:])  # the root of some files names itself
    elif "parents" in arrays:
        parents = tuple(max(-1, parent) for parent in arrays["parents"].astype(np.int64).tolist())
    else:
        return None
    if "joints" in arrays:
        joints = arrays["joints"]
    elif "J_regressor" in arrays:
        joints = arrays["J_regressor"] @ verts
    else:
        return None
    names = arrays.get("joint_names")
    return Skeleton(
        names=joint_names(len(parents)) if names is None else tuple(map(str, names)),
        parents=parents,
        joints=joints.astype(np.float64),
    )


def write(path: Path, mesh: Mesh, target: Path, text: bool) -> None:
    """Write the arrays that a body file has, as far as the mesh has them, and the others beside."""
    arrays: dict[str, np.ndarray] = {
        "v_template": mesh.verts,
        "f": mesh.faces,
        "name": np.array(mesh.name),
    }
    if mesh.weights is not None:
        arrays["weights"] = mesh.weights
    if mesh.corner_uv is not None:
        rows = mesh.corner_uv.reshape(-1, 2)
        unique, inverse = np.unique(rows, axis=0, return_inverse=True)
        arrays |= {"vt": unique, "ft": inverse.reshape(-1, 3)}
    if mesh.skeleton is not None:
        arrays |= _skeleton_arrays(mesh.verts, mesh.skeleton)
    if mesh.colors is not None:
        arrays["colors"] = mesh.colors
    if mesh.texture is not None:
        arrays["texture"] = np.rint(np.clip(mesh.texture, 0, 1) * 255).astype(np.uint8)
    with path.open("wb") as stream:  # a name would get a second ending
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def _skeleton_arrays(verts: np.ndarray, skeleton: Skeleton) -> dict[str, np.ndarray]:
    numbers = np.arange(len(skeleton.parents), dtype=np.int64)
    arrays = {
        "kintree_table": np.stack([np.array(skeleton.parents, dtype=np.int64), numbers]),
        "joints": skeleton.joints,
        "joint_names": np.array(skeleton.names, dtype=np.str_),
        "shapedirs": np.zeros((len(verts), 3, 1)),
    }
    if len(verts) and np.isfinite(verts).all():
        arrays["J_regressor"] = joint_regressor(verts, skeleton.joints)
    return arrays


def joint_regressor(
    verts: Float[np.ndarray, "V 3"], joints: Float[np.ndarray, "J 3"]
) -> Float[np.ndarray, "J V"]:
    """Weights of the vertices whose sum is each joint; rows sum to 1.

    The row of least length over the nearest vertices; over all vertices where those cannot give
    the joint, as near as it goes where the mesh is flat and the joint beside its plane.

    Args:
        verts: rest positions, (V, 3).
        joints: rest joints, (J, 3).

    Returns:
        The regressor, (J, V).

    >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    >>> np.round(joint_regressor(corners, np.full((1, 3), 0.25)), 6).tolist()
    [[0.25, 0.25, 0.25, 0.25]]
    """
    regressor = np.zeros((len(joints), len(verts)))
    for row, joint in zip(regressor, joints, strict=True):
        distance = ((verts - joint) ** 2).sum(axis=1)
        for count in (min(_NEIGHBOURS, len(verts)), len(verts)):
            near = np.argpartition(distance, count - 1)[:count]
            offsets = np.vstack([(verts[near] - joint).T, np.ones(count)])
            row[:] = 0
            row[near] = np.linalg.lstsq(offsets, np.array([0.0, 0, 0, 1]), rcond=None)[0]
            if np.abs(offsets @ row[near] - [0, 0, 0, 1]).max() < _EXACT:
                break
    return regressor
