"""Body files and pickled arrays, read without executing anything that is in them."""

import io
import os
import pickle
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from .errors import InputError
from .joint_names import joint_names
from .kinematics import KinematicTree
from .pickles import BAD_DATA, load_restricted

WEIGHT_SUM_TOLERANCE = 1e-3
"""Rows of skinning weights whose sum is this near to 1 are scaled to 1; others are refused."""


@dataclass(frozen=True, eq=False)
class BodyArrays:
    """The arrays of a body file under one set of names, checked against each other."""

    v_template: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    weights: Float[np.ndarray, "V J"]
    tree: KinematicTree
    joint_regressor: Float[np.ndarray, "J V"]
    shapedirs: Float[np.ndarray, "V 3 B"]
    posedirs: Float[np.ndarray, "V 3 P"]
    corner_uv: Float[np.ndarray, "F 3 2"] | None
    joint_names: tuple[str, ...]


def read_npy_object(path: str | os.PathLike[str]) -> Any:
    """What a `.npy` file holds, pickled objects included, without executing anything.

    Args:
        path: file such as `annots.npy` (a dict in a 0-d object array) or any plain array.

    Returns:
        The object of a 0-d object array (dict, list, array, text, number), else the array.

    Raises:
        InputError: missing or damaged file, or a pickle that names a function or class.
    """
    with _open(path) as stream:
        value = _read_npy(stream, str(path))
    is_wrapped = value.dtype == object and value.ndim == 0
    return value.item() if is_wrapped else value


def read_body_arrays(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """The arrays of a body file; text and numbers become 0-d arrays, other objects are left out.

    Args:
        path: `.npz`, or `.pkl` holding a dict (numpy, scipy.sparse and chumpy arrays).

    Returns:
        Arrays by their names in the file; sparse matrices are dense.

    Raises:
        InputError: missing or damaged file, another kind of file, or code in a pickle.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".npz", ".pkl"):
        raise InputError(
            f"{path}: expected a body file that ends in .npz or .pkl, found {suffix or 'no ending'}"
            "; convert it or rename it"
        )
    with _open(path) as stream:
        if suffix == ".npz":
            members = _read_npz(stream, str(path))
        else:
            members = load_restricted(stream, str(path))
    if not isinstance(members, dict):
        raise InputError(
            f"{path}: expected a dict of arrays, found {type(members).__name__}; "
            "pass the file of a body model"
        )
    plain = (np.ndarray, np.generic, str, int, float)
    arrays = {str(k): np.asarray(v) for k, v in members.items() if isinstance(v, plain)}
    return {name: array for name, array in arrays.items() if array.dtype != object}


def read_body(path: str | os.PathLike[str]) -> BodyArrays:
    """Read and check the body of an SMPL, SMPL-H or SMPL-X file.

    Args:
        path: `.npz` or `.pkl`.

    Returns:
        The checked arrays under the names used here.

    Raises:
        InputError: see `read_body_arrays`; or arrays missing, not finite, or of shapes, indices or
            weight sums that do not agree.
    """
    return check_body(read_body_arrays(path), str(path))


def check_body(raw: dict[str, np.ndarray], source: str) -> BodyArrays:
    """Check the arrays of a body and bring them under one set of names.

    Args:
        raw: arrays by their names in an SMPL, SMPL-H or SMPL-X file.
        source: what to call them in errors.

    Returns:
        The checked arrays; floats are float64, faces int64, rows of weights sum to 1.

    Raises:
        InputError: arrays missing, not finite, or of shapes, indices or sums that do not agree.
    """
    file = _BodyFile(raw, source)
    template = file.floats(("v_template",), (None, 3))
    num_verts = len(template)
    faces = file.indices(("f", "faces"), (None, 3), num_verts)
    tree = file.tree()
    num_joints = tree.num_joints
    weights = file.floats(("weights", "lbs_weights"), (num_verts, num_joints))
    regressor = file.floats(("J_regressor",), (num_joints, num_verts))
    shapedirs = file.floats(("shapedirs",), (num_verts, 3, None))
    size = 9 * (num_joints - 1)
    posedirs = np.zeros((num_verts, 3, size))
    if "posedirs" in raw:
        posedirs = file.floats(("posedirs",), (num_verts, 3, size))
    return BodyArrays(
        v_template=template,
        faces=faces,
        weights=file.normalised(weights),
        tree=tree,
        joint_regressor=regressor,
        shapedirs=shapedirs,
        posedirs=posedirs,
        corner_uv=file.corner_uv(len(faces)),
        joint_names=joint_names(num_joints),
    )


class _BodyFile:
    """Arrays of one file, looked up and checked with errors that name file and array."""

    def __init__(self, raw: dict[str, np.ndarray], source: str) -> None:
        self.raw = raw
        self.source = source

    def error(self, name: str, expected: Any, found: Any) -> InputError:
        return InputError(
            f"{self.source}: {name}: expected {expected}, found {found}; "
            "pass an unaltered SMPL, SMPL-H or SMPL-X body file"
        )

    def get(self, names: tuple[str, ...], shape: tuple[int | None, ...]) -> tuple[str, np.ndarray]:
        name = next((n for n in names if n in self.raw), None)
        if name is None:
            present = ", ".join(sorted(self.raw)) or "nothing"
            raise self.error(" or ".join(names), "an array of this name", f"only {present}")
        array = self.raw[name]
        fits = array.ndim == len(shape) and all(
            n in (None, m) for n, m in zip(shape, array.shape, strict=True)
        )
        if not fits or array.size == 0 or array.dtype.kind not in "fiu":
            wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
            raise self.error(name, f"numbers of shape {wanted}", f"{array.dtype} {array.shape}")
        return name, array

    def floats(self, names: tuple[str, ...], shape: tuple[int | None, ...]) -> np.ndarray:
        name, array = self.get(names, shape)
        array = array.astype(np.float64)
        if not np.isfinite(array).all():
            bad = int(np.count_nonzero(~np.isfinite(array)))
            raise self.error(name, "finite numbers", f"{bad} NaN or infinite")
        return array

    def indices(
        self, names: tuple[str, ...], shape: tuple[int | None, ...], bound: int
    ) -> np.ndarray:
        name, array = self.get(names, shape)
        low, high = array.min(), array.max()
        if low < 0 or high >= bound or not (array == array.astype(np.int64)).all():
            raise self.error(name, f"indices in 0..{bound - 1}", f"{low}..{high}")
        return array.astype(np.int64)

    def tree(self) -> KinematicTree:
        if "kintree_table" not in self.raw and "parents" in self.raw:
            parents = self.get(("parents",), (None,))[1].tolist()
        else:
            table = self.get(("kintree_table",), (2, None))[1].astype(np.int64).tolist()
            column = {joint: place for place, joint in enumerate(table[1])}
            parents = [-1, *(column.get(parent, -1) for parent in table[0][1:])]
        try:
            return KinematicTree.from_parents(parents)
        except InputError as error:
            raise InputError(f"{self.source}: kintree_table: {error}") from error

    def normalised(self, weights: np.ndarray) -> np.ndarray:
        sums = weights.sum(axis=1, keepdims=True)
        worst = int(np.abs(sums - 1).argmax())
        if abs(sums[worst, 0] - 1) > WEIGHT_SUM_TOLERANCE or weights.min() < -WEIGHT_SUM_TOLERANCE:
            found = f"row {worst} with sum {sums[worst, 0]:.6g}, smallest {weights.min():.6g}"
            raise self.error("weights", "rows of weights ≥ 0 that sum to 1", found)
        return weights / sums

    def corner_uv(self, num_faces: int) -> np.ndarray | None:
        if "vt" not in self.raw or "ft" not in self.raw:
            return None
        uv = self.floats(("vt",), (None, 2))
        return uv[self.indices(("ft",), (num_faces, 3), len(uv))]


def _open(path: str | os.PathLike[str]) -> io.BufferedReader:
    try:
        return Path(path).open("rb")
    except OSError as error:
        raise InputError(
            f"{path}: expected a readable file, found none ({error.strerror}); check the path"
        ) from error


def _read_npz(stream: io.BufferedReader, source: str) -> dict[str, Any]:
    members: dict[str, Any] = {}
    try:
        with zipfile.ZipFile(stream) as archive:
            for name in archive.namelist():
                member = io.BytesIO(archive.read(name))
                array = _read_npy(member, f"{source}[{name}]")
                is_wrapped = array.dtype == object and array.ndim == 0
                members[name.removesuffix(".npy")] = array.item() if is_wrapped else array
    except InputError:
        raise
    except (zipfile.BadZipFile, OSError, *BAD_DATA) as error:
        raise _damaged(source, "an .npz archive of arrays", error) from error
    return members


def _read_npy(stream: io.BufferedIOBase, source: str) -> np.ndarray:
    try:
        version = np.lib.format.read_magic(stream)
        readers = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }
        if version not in readers:
            raise pickle.UnpicklingError(f"format version {version}")
        shape, fortran, dtype = readers[version](stream)
        if not dtype.hasobject:
            flat = _read_plain(stream, shape, dtype)
            return flat.reshape(shape, order="F" if fortran else "C")
    except (zipfile.BadZipFile, OSError, *BAD_DATA) as error:
        raise _damaged(source, "a .npy array", error) from error
    value = load_restricted(stream, source)
    if not isinstance(value, np.ndarray):
        raise _damaged(source, "an array of objects", type(value).__name__)
    return value


def _read_plain(stream: io.BufferedIOBase, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    size = int(np.prod(shape, dtype=object))
    data = stream.read(size * dtype.itemsize)
    if len(data) != size * dtype.itemsize:
        raise EOFError(f"{len(data)} of {size * dtype.itemsize} bytes")
    return np.frombuffer(data, dtype).astype(dtype.newbyteorder("="))


def _damaged(source: str, expected: str, found: Any) -> InputError:
    detail = f"{type(found).__name__}: {found}" if isinstance(found, Exception) else str(found)
    return InputError(
        f"{source}: expected {expected}, found a damaged file ({' '.join(detail.split())}); "
        "copy or download it again"
    )
