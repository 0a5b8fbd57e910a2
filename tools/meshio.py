"""A mesh with what the formats may carry, and the files it is read from and written to.

Nothing here needs torch. What a format cannot hold is said, not lost in silence: `losses`.
"""

import dataclasses
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np
from jaxtyping import Float

from monopart.geometry.atomic import replacing
from monopart.geometry.errors import InputError

from .mesh_kinds import refuse_other_kinds

WEIGHTS_SUM = 1e-3
"""Rows of weights may differ by this much from a sum of 1 before a writer refuses them."""

LARGEST = 1e75
"""Largest coordinate with which tools compute: squares of areas must stay within float64."""

_DAMAGE = (
    *(ValueError, KeyError, IndexError, TypeError, OverflowError, EOFError, MemoryError),
    *(RecursionError, AttributeError),
)


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Joints of a rest pose; a parent stands before its children and a root's parent is -1."""

    names: tuple[str, ...]
    """Name of each joint."""
    parents: tuple[int, ...]
    """Parent of each joint, -1 for a root."""
    joints: Float[np.ndarray, "J 3"]
    """Rest positions in the mesh's frame, (J, 3)."""

    def __post_init__(self) -> None:
        """Refuse tables of different lengths and parents that stand behind their children."""
        count = len(self.parents)
        if len(self.names) != count or self.joints.shape != (count, 3):
            raise InputError(
                f"skeleton: expected as many names and joints as parents ({count}), found "
                f"{len(self.names)} names and joints {self.joints.shape}; make them agree"
            )
        wrong = [j for j, parent in enumerate(self.parents) if not -1 <= parent < j]
        if wrong:
            raise InputError(
                f"skeleton: expected parents before their children, found joint {wrong[0]} with "
                f"parent {self.parents[wrong[0]]}; sort the joints from the root"
            )


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh with optional texture coordinates, skin, colours and texture.

    Shapes and indices are checked here, with errors that name the array, so the fields say no shape
    to the type checker; numbers may be NaN, for broken files are read to be reported.

    >>> flat = Mesh(np.eye(3), np.array([[0, 1, 2]]), name="triangle")
    >>> flat.num_verts, flat.num_faces, flat.weights is None
    (3, 1, True)
    """

    verts: np.ndarray
    """Positions, float64, metres where the file says no other unit, (V, 3)."""
    faces: np.ndarray
    """Vertex indices, int64, (F, 3); none for a point cloud."""
    corner_uv: np.ndarray | None = None
    """Texture coordinates per face corner, v upwards, (F, 3, 2)."""
    weights: np.ndarray | None = None
    """Skinning weights, (V, J)."""
    skeleton: Skeleton | None = None
    """Joints that the weights belong to."""
    colors: np.ndarray | None = None
    """Vertex colours, sRGB in [0, 1], (V, 3)."""
    texture: np.ndarray | None = None
    """Image, sRGB in [0, 1], row 0 at v = 1, (H, W, 3)."""
    name: str = "mesh"
    """What to call it."""
    notes: tuple[str, ...] = ()
    """What the file held that is not kept here, one line each."""

    def __post_init__(self) -> None:
        """Bring the arrays to float64 and int64 and refuse shapes or indices that do not agree."""
        for field in ("verts", "corner_uv", "weights", "colors", "texture"):
            value = getattr(self, field)
            if value is not None:
                object.__setattr__(self, field, np.asarray(value, dtype=np.float64))
        faces = np.asarray(self.faces)
        if faces.size == 0:  # a point cloud, whatever the shape of nothing
            faces = np.zeros((0, 3), dtype=np.int64)
        object.__setattr__(self, "faces", self._whole(faces))
        verts, count = len(self.verts), len(self.faces)
        wanted = {
            "verts": (verts, 3),
            "faces": (count, 3),
            "corner_uv": (count, 3, 2),
            "weights": (verts, None),
            "colors": (verts, 3),
            "texture": (None, None, 3),
        }
        for field, shape in wanted.items():
            self._check_shape(field, shape)
        if count and (self.faces.min() < 0 or self.faces.max() >= verts):
            raise InputError(
                f"{self.name}: faces: expected indices in 0..{verts - 1}, found "
                f"{self.faces.min()}..{self.faces.max()}; correct the faces"
            )
        joints = None if self.weights is None else self.weights.shape[1]
        if self.skeleton and joints not in (None, len(self.skeleton.parents)):
            raise InputError(
                f"{self.name}: skeleton: expected {joints} joints (those of the weights), found "
                f"{len(self.skeleton.parents)}; give one joint per column of weights"
            )

    def _whole(self, faces: np.ndarray) -> np.ndarray:
        """Vertex numbers as int64; some files hold them as floats."""
        if faces.dtype.kind == "f":
            whole = (faces == np.rint(faces)) & (np.abs(faces) < 2**53)
            if not whole.all():
                raise InputError(
                    f"{self.name}: faces: expected whole vertex numbers, found "
                    f"{faces[~whole][0]:g}; correct the faces"
                )
        return faces.astype(np.int64)

    def _check_shape(self, field: str, shape: tuple[int | None, ...]) -> None:
        value = getattr(self, field)
        if value is None:
            return
        fits = value.ndim == len(shape) and all(
            n in (None, m) for n, m in zip(shape, value.shape, strict=True)
        )
        if not fits:
            wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
            raise InputError(
                f"{self.name}: {field}: expected the shape {wanted}, found {value.shape}; "
                "make it agree with the other arrays"
            )

    @property
    def num_verts(self) -> int:
        """Number of vertices."""
        return len(self.verts)

    @property
    def num_faces(self) -> int:
        """Number of triangles."""
        return len(self.faces)

    def require(self, *, faces: bool = True, weights: bool = False, uv: bool = False) -> "Mesh":
        """The mesh itself, if it holds what a tool needs: finite vertices and the parts asked for.

        Args:
            faces: at least one triangle.
            weights: skinning weights.
            uv: texture coordinates.

        Raises:
            InputError: something is missing or not finite.
        """
        bad = int(np.count_nonzero(~np.isfinite(self.verts).all(axis=1)))
        if bad:
            raise InputError(
                f"{self.name}: vertices: expected finite numbers, found {bad} of {self.num_verts} "
                "with NaN or infinity; clean the mesh first (monopart-mesh remesh --clean)"
            )
        far = np.abs(self.verts).max(initial=0.0)
        if far > LARGEST:
            raise InputError(
                f"{self.name}: vertices: expected coordinates up to {LARGEST:g}, found {far:g}; "
                "their areas overflow, choose a larger unit"
            )
        if faces and not self.num_faces:
            raise InputError(
                f"{self.name}: faces: expected at least one triangle, found {self.num_verts} "
                "points and no face; give a surface, not a point cloud"
            )
        if weights and self.weights is None:
            raise InputError(
                f"{self.name}: weights: expected skinning weights, found none; give a rigged glb "
                "or npz, or compute them (monopart-mesh bake weights)"
            )
        if uv and self.corner_uv is None:
            raise InputError(
                f"{self.name}: texture coordinates: expected some, found none; make them "
                "(monopart-mesh unwrap)"
            )
        return self


@dataclass(frozen=True)
class Format:
    """What a kind of file can hold, and the room that reads and writes it."""

    room: str
    """Module of this package with `read(path) -> Mesh` and `write(path, mesh)`."""
    holds: frozenset[str]
    """Attributes of `Mesh` that survive a round trip."""
    precision: str
    """How exactly positions are kept."""


_ALL = frozenset({"corner_uv", "weights", "skeleton", "colors", "texture"})
FORMATS: dict[str, Format] = {
    ".obj": Format("mesh_obj", _ALL - {"weights", "skeleton"}, "float64 as text"),
    ".ply": Format("mesh_ply", _ALL - {"texture"}, "float64"),
    ".stl": Format("mesh_stl", frozenset(), "float32"),
    ".glb": Format("mesh_gltf", _ALL, "float32"),
    ".gltf": Format("mesh_gltf", _ALL, "float32"),
    ".npz": Format("mesh_npz", _ALL, "float64"),
}


def format_of(path: str | os.PathLike[str]) -> Format:
    """The format that a file name asks for.

    Args:
        path: file name; its ending decides, in either case.

    Returns:
        The format.

    Raises:
        InputError: no such format.

    >>> sorted(format_of("a.OBJ").holds)
    ['colors', 'corner_uv', 'texture']
    """
    suffix = Path(path).suffix.lower()
    if suffix not in FORMATS:
        raise InputError(
            f"{path}: expected a file that ends in {', '.join(FORMATS)}, found "
            f"{suffix or 'no ending'}; convert it or rename it"
        )
    return FORMATS[suffix]


def read_mesh(path: str | os.PathLike[str]) -> Mesh:
    """Read a mesh file; nothing in it is executed and it is not changed.

    Args:
        path: obj, ply, stl, glb, gltf or npz.

    Returns:
        The mesh; polygons are cut into triangles, vertices keep their order.

    Raises:
        InputError: missing, damaged or unknown file, or arrays that do not agree.
    """
    source = Path(path)
    kind = format_of(source)
    if not source.is_file():
        found = "a folder" if source.is_dir() else "nothing"
        raise InputError(f"{source}: expected a mesh file, found {found}; check the path")
    with refused(source), np.errstate(all="ignore"):  # damaged numbers are looked at afterwards
        refuse_other_kinds(source)
        return _room(kind).read(source)


def write_mesh(path: str | os.PathLike[str], mesh: Mesh, *, text: bool = False) -> tuple[str, ...]:
    """Write a mesh file, whole or not at all.

    Args:
        path: where to; the ending decides the format.
        mesh: what to write.
        text: ply and stl as text, not binary; of no effect elsewhere.

    Returns:
        What the file does not hold, see `losses`.

    Raises:
        InputError: unknown ending, no such folder, or numbers that the format cannot hold.
    """
    kind = format_of(path)
    target = Path(path)
    with replacing(target) as temporary:
        _room(kind).write(temporary, mesh, target, text)
    return losses(mesh, path)


def losses(mesh: Mesh, path: str | os.PathLike[str]) -> tuple[str, ...]:
    """What a file of this name would not hold of a mesh.

    Args:
        mesh: what would be written.
        path: file name; its ending decides.

    Returns:
        One line for each loss.

    >>> losses(Mesh(np.eye(3), np.array([[0, 1, 2]]), colors=np.ones((3, 3))), "a.stl")
    ('colors: .stl cannot hold them', 'vertices: merged where equal, unused ones dropped')
    """
    kind = format_of(path)
    suffix = Path(path).suffix.lower()
    words = {"corner_uv": "texture coordinates"}
    lost = [
        f"{words.get(name, name)}: {suffix} cannot hold them"
        for name in ("corner_uv", "weights", "skeleton", "colors", "texture")
        if getattr(mesh, name) is not None and name not in kind.holds
    ]
    with np.errstate(over="ignore", invalid="ignore"):
        rounded = mesh.verts.astype(np.float32).astype(np.float64)
    if kind.precision == "float32" and not np.array_equal(rounded, mesh.verts, equal_nan=True):
        lost.append("positions: rounded to float32")
    lost += _special_losses(mesh, suffix)
    if suffix == ".stl":
        lost.append("vertices: merged where equal, unused ones dropped")
    return tuple(lost)


def _special_losses(mesh: Mesh, suffix: str) -> list[str]:
    """What a format holds only under a condition, or only in 8 bits."""
    lost = []
    if suffix in (".glb", ".gltf") and mesh.weights is not None and mesh.skeleton is None:
        lost.append(f"weights: {suffix} holds them only with a skeleton")
    if suffix in (".obj", ".glb", ".gltf") and mesh.texture is not None and mesh.corner_uv is None:
        lost.append(f"texture: {suffix} holds it only with texture coordinates")
    if suffix == ".ply" and mesh.colors is not None and not _is_8_bit(mesh.colors):
        lost.append("colors: rounded to 8 bits")
    if suffix not in (".ply", ".stl") and mesh.texture is not None and not _is_8_bit(mesh.texture):
        lost.append("texture: rounded to 8 bits")
    return lost


def _is_8_bit(values: np.ndarray) -> bool:
    """Whether values are whole numbers of 255ths from 0 to 1."""
    scaled = values * 255
    return bool(np.allclose(scaled, np.rint(np.clip(scaled, 0, 255)), rtol=0, atol=1e-3))


def _room(kind: Format) -> "_Room":
    module = import_module(f".{kind.room}", __package__)
    return _Room(module.read, module.write)


@dataclass(frozen=True)
class _Room:
    read: Callable[[Path], Mesh]
    write: Callable[[Path, Mesh, Path, bool], None]


@contextmanager
def refused(source: Path) -> Iterator[None]:
    """Turn what a parser stumbles over into an error that names the file.

    Args:
        source: the file that is read.

    Yields:
        Nothing.

    Raises:
        InputError: the block raised it, or an error that damaged content causes.
    """
    try:
        yield
    except InputError as error:
        text = str(error)
        if str(source) in text:
            raise
        # a mesh without a name of its own is named after its file
        raise InputError(f"{source}: {text.removeprefix(f'{source.stem}: ')}") from error
    except (*_DAMAGE, OSError) as error:
        raise InputError(
            f"{source}: expected a whole, valid {source.suffix} file, found damage "
            f"({type(error).__name__}: {error}); export it again"
        ) from error


def renamed(mesh: Mesh, **changes: object) -> Mesh:
    """A copy of a mesh with some attributes replaced.

    Args:
        mesh: the mesh.
        changes: attributes and their new values.

    Returns:
        The copy, checked anew.
    """
    return dataclasses.replace(mesh, **changes)  # pyright: ignore[reportArgumentType]
