"""Parts of any mesh: from its skinning weights, its skeleton, or the body that ships with us.

From weights nothing but numpy and scipy is loaded; torch is never needed.
"""

import importlib.resources
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from monopart.geometry.alignment import Similarity
from monopart.geometry.atomic import write_bytes, write_json
from monopart.geometry.bone_heat import heat_weights
from monopart.geometry.errors import InputError
from monopart.geometry.geodesics import PartBands, part_bands
from monopart.geometry.joint_names import joint_names
from monopart.geometry.mesh_graph import MeshGraph, components, face_graph
from monopart.geometry.part_cleaning import clean_face_labels, label_shares, vertex_labels
from monopart.geometry.part_tables import (
    joint_parts,
    pieces_of_joints,
    preset_table,
    table_by_name,
)
from monopart.geometry.weight_transfer import transfer_rows

from .images import encoded
from .meshio import Mesh, Skeleton, read_mesh
from .pictures import front_and_back, part_colors
from .templates import fitted_person

Method = Literal["auto", "weights", "heat", "transfer"]
_FAR = 0.06  # a body surface farther away gives no weights, in diagonals of the body
_UNLIKE = 0.03  # residual of an alignment that is doubted, in diagonals
_SMPL_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)


@dataclass(frozen=True, eq=False)
class Partition:
    """A mesh in parts.

    Attributes:
        names: name of each part.
        face_part: [F] part of each face.
        vertex_part: [V] part of each vertex.
        weights: [V, J] skinning weights that decided.
        method: where the weights come from: weights, heat or transfer.
        bands: parts that reach over their borders, where a width was asked for.
        notes: what to doubt, one line each.
        upright: moves the mesh into the frame of bodies (y up, front at +z), for pictures.
    """

    names: tuple[str, ...]
    face_part: Int[np.ndarray, "f"]
    vertex_part: Int[np.ndarray, "v"]
    weights: Float[np.ndarray, "v j"]
    method: str
    bands: PartBands | None = None
    notes: tuple[str, ...] = ()
    upright: Similarity | None = None


def default_body() -> Mesh:
    """The body that ships with the package, read without torch."""
    asset = importlib.resources.files("monopart.geometry") / "assets" / "body.npz"
    with importlib.resources.as_file(asset) as path:
        return read_mesh(path)


def _is_smpl(names: Sequence[str]) -> bool:
    known = joint_names(24)[:22]
    return len(names) in (22, 24, 52, 55) and tuple(names[:22]) == known


def part_table(
    preset: str, num_joints: int, skeleton: Skeleton | None
) -> dict[str, tuple[int, ...]]:
    """Joints of each part of a preset, by number for SMPL bodies, else by the names of the joints.

    Args:
        preset: see `monopart.geometry.part_tables.preset_table`.
        num_joints: number of joints of the weights.
        skeleton: names and parents, or None for a body in the order of the SMPL family.

    Returns:
        Part name → joints.

    Raises:
        InputError: unknown preset, or neither numbers nor names tell the parts.

    >>> part_table("single", 2, None)
    {'whole': (0, 1)}
    """
    if skeleton is None or _is_smpl(skeleton.names):
        return preset_table(preset, num_joints)
    return table_by_name(preset, skeleton.names, skeleton.parents)


def _parents(num_joints: int, skeleton: Skeleton | None) -> tuple[int, ...] | None:
    """Parents of the joints; None where nothing tells them."""
    if skeleton is not None:
        return skeleton.parents
    if num_joints in (22, 24):
        return (*_SMPL_PARENTS, 20, 21)[:num_joints]
    return None


def _chosen(mesh: Mesh, method: Method) -> str:
    if method != "auto":
        return method
    if mesh.weights is not None:
        return "weights"
    return "heat" if mesh.skeleton is not None else "transfer"


def weights_of(
    mesh: Mesh, method: Method = "auto"
) -> tuple[Float[np.ndarray, "v j"], Skeleton | None, str, Similarity | None]:
    """Skinning weights of any mesh: its own, by heat from its skeleton, or those of our body.

    Args:
        mesh: finite, with faces.
        method: "weights", "heat", "transfer", or "auto" for the first that is possible.

    Returns:
        The weights, their skeleton (None: not known), the method used, and for "transfer" the
        similarity that lays the mesh on our body.

    Raises:
        InputError: the mesh lacks what the method needs.
    """
    chosen = _chosen(mesh, method)
    if chosen == "weights":
        mesh.require(weights=True)
        return _rows(mesh), mesh.skeleton, chosen, None
    mesh.require()
    if chosen == "heat":
        bones = mesh.skeleton
        if bones is None:
            raise InputError(
                f"{mesh.name}: skeleton: expected joints to compute weights from, found none; "
                "give a rigged glb or npz, or take the method transfer"
            )
        return (
            heat_weights(mesh.verts, mesh.faces, bones.joints, bones.parents),
            bones,
            chosen,
            None,
        )
    if chosen != "transfer":
        raise InputError(
            f"method: expected auto, weights, heat or transfer, found {method!r}; choose one"
        )
    body = default_body()
    posed, moved = fitted_person(body, mesh.verts, mesh.faces)
    size = float(np.linalg.norm(np.ptp(posed, axis=0)))
    source = _rows(body), (posed, body.faces)
    rows, _ = transfer_rows(*source, (moved(mesh.verts), mesh.faces), _FAR * size)
    return rows, body.skeleton, chosen, moved


def _rows(mesh: Mesh) -> np.ndarray:
    """Weights of a mesh with rows of sum 1; rows of zeros stay."""
    weights = mesh.weights
    if weights is None or not np.isfinite(weights).all() or weights.min(initial=0.0) < 0:
        raise InputError(
            f"{mesh.name}: weights: expected finite numbers ≥ 0, found others; "
            "look at them with monopart-mesh check"
        )
    total = weights.sum(1, keepdims=True)
    return weights / np.where(total > 0, total, 1.0)


def partition(
    mesh: Mesh,
    preset: str = "five",
    *,
    table: Mapping[str, Sequence[int]] | None = None,
    method: Method = "auto",
    smoothing: float | None = None,
    band: float | None = None,
    symmetry_plane: float | None = 0.0,
) -> Partition:
    """Divide a mesh into body parts: connected, with short borders, the same left and right.

    Args:
        mesh: finite, with faces.
        preset: three, five, six, per_limb, with "+hands" behind it for hands apart, or single.
        table: joints of each named part, in place of a preset.
        method: where weights come from, see `weights_of`.
        smoothing: width over which a border may move to become shorter, in the mesh's unit; None is
            a hundredth of its diagonal, 0 only removes islands.
        band: how far parts reach over their borders along the surface; None for no bands.
        symmetry_plane: x of the plane in which left and right are equal where the mesh is; None for
            no such plane.

    Returns:
        The parts.

    Raises:
        InputError: a damaged mesh, an unknown preset, or joints that the table does not fit.

    >>> tube = Mesh(np.eye(3), np.array([[0, 1, 2]]), weights=np.ones((3, 1)))
    >>> partition(tube, "single").names
    ('whole',)
    """
    mesh.require()
    weights, skeleton, chosen, moved = weights_of(mesh, method)
    count = weights.shape[1]
    joints = dict(table) if table is not None else part_table(preset, count, skeleton)
    owner = joint_parts(joints, count)
    parents = _parents(count, skeleton)
    piece, part = (
        (owner, tuple(range(len(joints)))) if parents is None else pieces_of_joints(owner, parents)
    )
    shares = label_shares(weights, piece, len(part))[mesh.faces].mean(1)
    verts, plane = mesh.verts, symmetry_plane
    if moved is not None and plane is not None:  # left and right as the body that was laid on it
        verts, plane = verts @ moved.rotation.T, float(-moved.shift[0] / moved.scale)
    label = clean_face_labels(shares, verts, mesh.faces, smoothing, plane)
    vertex = vertex_labels(label, mesh.verts, mesh.faces, len(part))
    face_part, vertex_part = np.array(part)[label], np.array(part)[vertex]
    bands = None
    if band is not None:
        bands = part_bands(face_part, mesh.verts, mesh.faces, len(joints), band)
    notes = _notes(mesh, weights, tuple(joints), face_part, moved)
    return Partition(tuple(joints), face_part, vertex_part, weights, chosen, bands, notes, moved)


def _notes(
    mesh: Mesh,
    weights: np.ndarray,
    names: tuple[str, ...],
    face_part: np.ndarray,
    moved: Similarity | None,
) -> tuple[str, ...]:
    notes = []
    bare = int((~weights.any(1)).sum())
    if bare:
        notes.append(f"{bare} of {mesh.num_verts} vertices have no weights")
    missing = sorted(set(range(len(names))) - set(face_part.tolist()))
    if missing:
        notes.append("no face belongs to " + ", ".join(names[p] for p in missing))
    if moved is not None and moved.residual > _UNLIKE:
        notes.append(
            f"the mesh is unlike our body in its pose ({moved.residual:.1%} of the diagonal off "
            "after alignment): give it a skeleton"
        )
    return tuple(notes)


def partition_report(mesh: Mesh, parts: Partition) -> dict[str, object]:
    """Numbers of a partition, as JSON holds them.

    Args:
        mesh: the mesh.
        parts: its partition.

    Returns:
        Method, notes, and for each part: faces, vertices, area, length of its border, connected
        pieces, and faces in its band.
    """
    graph = face_graph(mesh.verts, mesh.faces)
    labels = parts.face_part
    a, b = graph.edges.T
    apart = labels[a] != labels[b]
    report = []
    for part, name in enumerate(parts.names):
        mine = labels == part
        border = apart & (mine[a] | mine[b])
        entry: dict[str, object] = {
            "name": name,
            "faces": int(mine.sum()),
            "vertices": int((parts.vertex_part == part).sum()),
            "area": float(graph.mass[mine].sum()),
            "border": float(graph.weights[border].sum()),
            "pieces": _num_pieces(graph, mine),
        }
        if parts.bands is not None:
            entry["faces_with_band"] = int(parts.bands.faces[part].sum())
        report.append(entry)
    return {
        "name": mesh.name,
        "method": parts.method,
        "notes": list(parts.notes),
        "border": float(graph.weights[apart].sum()),
        "parts": report,
    }


def _num_pieces(graph: MeshGraph, mine: np.ndarray) -> int:
    a, b = graph.edges.T
    return len(np.unique(components(graph.num_nodes, graph.edges, mine[a] & mine[b])[mine]))


def partition_picture(
    mesh: Mesh, parts: Partition, height: int = 640
) -> Float[np.ndarray, "h w 3"]:
    """Parts coloured, from front and back, with their names.

    Args:
        mesh: the mesh, y up and front at +z, unless the partition turned it upright.
        parts: its partition.
        height: rows of a view.

    Returns:
        sRGB in [0, 1].
    """
    colors = part_colors(len(parts.names))
    verts = mesh.verts if parts.upright is None else parts.upright(mesh.verts)
    legend = list(zip(parts.names, colors, strict=True))
    return front_and_back(verts, mesh.faces, colors[parts.face_part], legend, height)


def write_partition(
    mesh: Mesh, parts: Partition, folder: str | os.PathLike[str], name: str = "parts"
) -> tuple[Path, ...]:
    """Write `NAME.npz` (parts of faces and vertices), `NAME.json` and `NAME.png`.

    Args:
        mesh: the mesh.
        parts: its partition.
        folder: an existing folder.
        name: of the files.

    Returns:
        The files.

    Raises:
        InputError: no such folder.
    """
    import io

    place = Path(folder)
    arrays: dict[str, Any] = {
        "names": np.array(parts.names),
        "face_part": parts.face_part,
        "vertex_part": parts.vertex_part,
    }
    if parts.bands is not None:
        arrays |= {"band_faces": parts.bands.faces, "shares": parts.bands.shares}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return (
        write_bytes(place / f"{name}.npz", buffer.getvalue()),
        write_json(place / f"{name}.json", partition_report(mesh, parts)),
        write_bytes(place / f"{name}.png", encoded(partition_picture(mesh, parts))),
    )
