"""New triangles for an old surface by PyMeshLab (GPL-3: the extra `tools`, and this file alone)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from monopart.geometry.errors import InputError
from monopart.geometry.weight_transfer import closest_faces

from .meshio import Mesh
from .transfer import transferred

Progress = Callable[[float, str], None]


@dataclass(frozen=True, eq=False)
class Remeshed:
    """A new mesh and what became of the old one."""

    mesh: Mesh
    """The new mesh, with the attributes of the old one."""
    report: dict[str, Any]
    """Counts before and after, and the distance between the surfaces."""


def _silent(done: float, note: str) -> None:
    """Show nothing."""


def decimate(mesh: Mesh, num_faces: int, progress: Progress = _silent) -> Remeshed:
    """Fewer triangles by quadric edge collapse; borders and topology are kept.

    Args:
        mesh: a surface with finite vertices.
        num_faces: how many triangles to leave, at least 4; more stay where topology demands it.
        progress: called with the finished part and a short text.

    Returns:
        The new mesh and a report.

    Raises:
        InputError: no surface, or `num_faces` is below 4 or not below the present number.
    """
    mesh.require()
    if not 4 <= num_faces < mesh.num_faces:
        raise InputError(
            f"faces: expected from 4 to {mesh.num_faces - 1} (fewer than now), found {num_faces}; "
            "ask for fewer, or give an edge length"
        )

    def work(meshes: Any, size: float) -> None:
        meshes.meshing_decimation_quadric_edge_collapse(
            targetfacenum=num_faces,
            preservetopology=True,
            preserveboundary=True,
            preservenormal=True,
            optimalplacement=True,
        )

    return _remeshed(mesh, work, progress, "decimate")


def isotropic(
    mesh: Mesh, edge_length: float, iterations: int = 10, progress: Progress = _silent
) -> Remeshed:
    """Triangles of nearly equal edges.

    Args:
        mesh: a surface with finite vertices.
        edge_length: in the mesh's unit, above 0.
        iterations: rounds of splitting, collapsing, flipping and smoothing.
        progress: called with the finished part and a short text.

    Returns:
        The new mesh and a report.

    Raises:
        InputError: no surface, or a length that would give more than ten million triangles.
    """
    mesh.require()
    expected = _area(mesh) / (0.433 * edge_length**2) if edge_length > 0 else np.inf
    if not expected < 1e7:
        raise InputError(
            f"edge: expected a length above 0 that gives less than ten million triangles, found "
            f"{edge_length:g} (about {expected:.3g} triangles); choose a larger one"
        )

    def work(meshes: Any, size: float) -> None:
        import pymeshlab

        lab: Any = pymeshlab  # its names are made when it is loaded
        meshes.meshing_isotropic_explicit_remeshing(
            iterations=iterations, targetlen=lab.PureValue(edge_length / size)
        )

    return _remeshed(mesh, work, progress, "isotropic")


def clean(mesh: Mesh, close_holes: int = 0, progress: Progress = _silent) -> Remeshed:
    """Mend a surface: broken numbers, doubles, slivers without area, non-manifold places.

    Args:
        mesh: a surface.
        close_holes: close holes of at most this many edges; 0 closes none.
        progress: called with the finished part and a short text.

    Returns:
        The new mesh and a report of what was removed.

    Raises:
        InputError: nothing is left.
    """
    finite, removed = without_broken(mesh)
    if not finite.num_faces:
        raise InputError(
            f"{mesh.name}: expected triangles with finite corners and weights, found none; there "
            "is nothing to mend"
        )
    finite.require()

    def work(meshes: Any, size: float) -> None:
        meshes.meshing_remove_duplicate_vertices()
        meshes.meshing_remove_duplicate_faces()
        meshes.meshing_remove_null_faces()
        if not meshes.current_mesh().face_number():
            raise InputError(
                f"{mesh.name}: expected triangles with an area, found none; there is nothing to "
                "mend"
            )
        meshes.meshing_repair_non_manifold_edges()
        meshes.meshing_repair_non_manifold_vertices()
        meshes.meshing_remove_unreferenced_vertices()
        if close_holes:
            meshes.meshing_close_holes(maxholesize=close_holes)
        meshes.meshing_re_orient_faces_coherently()

    done = _remeshed(finite, work, progress, "clean")
    report = done.report | {
        "vertices_not_finite": removed,
        "vertices_before": mesh.num_verts,
        "faces_before": mesh.num_faces,
    }
    return Remeshed(done.mesh, report)


def without_broken(mesh: Mesh) -> tuple[Mesh, int]:
    """The mesh without vertices that are not finite and without the faces at them.

    Args:
        mesh: any mesh.

    Returns:
        The rest, and the number of vertices that were taken out.
    """
    good = np.asarray(np.isfinite(mesh.verts).all(axis=1))
    if mesh.weights is not None:
        good = good & np.isfinite(mesh.weights).all(axis=1)
    if good.all():
        return mesh, 0
    kept = np.asarray(good[mesh.faces].all(axis=1))
    place = np.cumsum(good) - 1

    def rows(values: np.ndarray | None, which: np.ndarray) -> np.ndarray | None:
        return None if values is None else values[which]

    rest = Mesh(
        mesh.verts[good],
        place[mesh.faces[kept]],
        corner_uv=rows(mesh.corner_uv, kept),
        weights=rows(mesh.weights, good),
        skeleton=mesh.skeleton,
        colors=rows(mesh.colors, good),
        texture=mesh.texture,
        name=mesh.name,
    )
    return rest, int((~good).sum())


def _remeshed(
    mesh: Mesh, work: Callable[[Any, float], None], progress: Progress, method: str
) -> Remeshed:
    import pymeshlab

    lab: Any = pymeshlab  # its names are made when it is loaded
    progress(0.05, "remeshing")
    # in a box of about 1: some limits of PyMeshLab are absolute, and some of it is float32
    low, diagonal = _box(mesh)
    size = 2.0 ** np.ceil(np.log2(diagonal))  # a power of two changes no digit
    meshes = lab.MeshSet(verbose=False)
    try:
        meshes.add_mesh(lab.Mesh((mesh.verts - low) / size, mesh.faces))
        work(meshes, size)
        result = meshes.current_mesh()
        verts = np.asarray(result.vertex_matrix(), dtype=np.float64) * size + low
        faces = np.asarray(result.face_matrix(), dtype=np.int64).reshape(-1, 3)
    except lab.PyMeshLabException as error:
        raise InputError(
            f"{mesh.name}: expected a surface on which PyMeshLab can do this, found one that it "
            f"refuses ({error}); look at it with monopart-mesh check, and clean it"
        ) from error
    if not len(faces) or not np.isfinite(verts).all():
        raise InputError(
            f"{mesh.name}: expected triangles after {method}, found none; the surface is too small "
            "or has no area"
        )
    progress(0.6, "attributes")
    new = transferred(verts, faces, mesh)
    progress(0.8, "distance")
    return Remeshed(new, _report(mesh, new, method, diagonal))


def _box(mesh: Mesh) -> tuple[Float[np.ndarray, "3"], float]:
    used = mesh.verts[np.unique(mesh.faces)]
    low, high = used.min(axis=0), used.max(axis=0)
    return low, float(np.linalg.norm(high - low)) or 1.0


def _area(mesh: Mesh) -> float:
    corners = mesh.verts[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(np.linalg.norm(normals, axis=1).sum() / 2)


def _report(old: Mesh, new: Mesh, method: str, size: float) -> dict[str, Any]:
    there = closest_faces(surface_points(new.verts, new.faces), old.verts, old.faces)[2]
    back = closest_faces(surface_points(old.verts, old.faces), new.verts, new.faces)[2]
    away = np.concatenate([there, back])
    return {
        "method": method,
        "vertices_before": old.num_verts,
        "vertices": new.num_verts,
        "faces_before": old.num_faces,
        "faces": new.num_faces,
        "distance_mean": float(away.mean()),
        "distance_max": float(away.max()),
        "distance_max_of_size": float(away.max() / size),
        "attributes": [
            name
            for name in ("corner_uv", "weights", "skeleton", "colors", "texture")
            if getattr(new, name) is not None
        ],
    }


def surface_points(
    verts: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "P 3"]:
    """Vertices and face middles, where distances between surfaces are measured.

    Args:
        verts: (V, 3).
        faces: (F, 3).

    Returns:
        Points, (P, 3).
    """
    return np.concatenate([verts[np.unique(faces)], verts[faces].mean(axis=1)])
