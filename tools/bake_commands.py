"""The commands bake and body of ``monopart-mesh``."""

import argparse
import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from monopart.geometry.errors import InputError

from .mesh_job import Job, described
from .meshio import Mesh, Skeleton

if TYPE_CHECKING:
    from .views import Panel


def bake(arguments: argparse.Namespace, job: Job) -> int:
    """Carry weights, texture coordinates or colours to another mesh, or distances to a grid.

    Args:
        arguments: `what`, `source`, `target`, and what each needs.
        job: the run.

    Returns:
        Exit code.

    Raises:
        InputError: a target too many or too few.
    """
    if arguments.what == "distance":
        return _bake_distance(arguments, job)
    from . import bake as room
    from .views import surface_panels, uv_panels

    if arguments.target is None:
        raise InputError("TARGET: expected the mesh to bake onto, found none; give two meshes")
    job.using(arguments.target)
    source, target = job.read(arguments.source), job.read(arguments.target)
    job.update(0.1, "baking")
    if arguments.what == "weights":
        limit = np.inf if arguments.max_distance is None else arguments.max_distance
        done, report = room.bake_weights(source, target, max_distance=limit)
    elif arguments.what == "uv":
        done, report = room.bake_uv(source, target)
    elif arguments.what == "colors":
        done, report = room.bake_colors(source, target)
    else:
        done, report = room.bake_texture(source, target, arguments.size)
    print(f"{report.what}: at most {report.max_distance:.3g} away from the source")
    for note in report.notes:
        print(f"  note: {note}")

    def panels(size: int) -> "list[Panel]":
        if arguments.what == "uv":
            return uv_panels(done, size)
        shown = done
        if arguments.what == "weights":  # its colours would hide them
            shown = dataclasses.replace(done, colors=None, texture=None)
        return surface_panels(shown, report.what, size)

    return job.finish(done, dataclasses.asdict(report), panels)


def _bake_distance(arguments: argparse.Namespace, job: Job) -> int:
    from .distance_grid import distance_grid
    from .views import grid_panels

    out = job.options.out
    if arguments.target is not None or out is None or out.suffix.lower() != ".npz":
        raise InputError(
            "distance: expected one mesh and an OUT that ends in .npz, found others; correct them"
        )
    mesh = job.read(arguments.source)
    size = float(np.linalg.norm(np.ptp(mesh.require().verts, axis=0)))
    grid = distance_grid(
        mesh,
        size / 64 if arguments.spacing is None else arguments.spacing,
        margin=size / 20 if arguments.margin is None else arguments.margin,
        signed=not arguments.unsigned,
        progress=lambda done, total: job.update(
            0.9 * done / max(total, 1), f"{done}/{total} nodes"
        ),
    )
    shape = " x ".join(map(str, grid.values.shape))
    print(f"distance grid: {shape} nodes {grid.spacing:.4g} apart, off by at most {grid.bound:.4g}")
    job.extra[out] = grid.save
    result = {
        "shape": list(grid.values.shape),
        "origin": grid.origin.tolist(),
        "spacing": grid.spacing,
        "bound": grid.bound,
        "signed": grid.signed,
    }
    return job.finish(None, result, lambda pixels: grid_panels(grid.values, pixels))


def body(arguments: argparse.Namespace, job: Job) -> int:
    """Build the body file of a subject.

    Args:
        arguments: `source`, `betas`, `height`, `faces`.
        job: the run.

    Returns:
        Exit code.
    """
    from . import body as room
    from .views import surface_panels

    out = job.options.out
    job.using(arguments.source) if arguments.source is not None else job.guard_all()
    job.update(0.1, "building")
    arrays = room.build_body(
        arguments.source, betas=arguments.betas, height=arguments.height, num_faces=arguments.faces
    )
    mesh = Mesh(
        arrays.v_template,
        arrays.faces,
        corner_uv=arrays.corner_uv,
        weights=arrays.weights,
        skeleton=Skeleton(
            arrays.joint_names, arrays.tree.parents, arrays.joint_regressor @ arrays.v_template
        ),
        name="body" if arguments.source is None else arguments.source.stem,
    )
    is_body = out is not None and out.suffix.lower() == ".npz"
    if is_body and out is not None:
        job.extra[out] = lambda path: room.write_body(path, arrays)
        print(f"{out.name}: {described(mesh)}, {arrays.shapedirs.shape[2]} shape directions")
    result = {
        "betas": list(arguments.betas),
        "height": float(np.ptp(arrays.v_template[:, 1])),
        "vertices": mesh.num_verts,
        "faces": mesh.num_faces,
        "joints": len(arrays.joint_names),
    }
    print(f"height {result['height']:.3f} m")
    return job.finish(
        None if is_body else mesh, result, lambda size: surface_panels(mesh, "body", size)
    )
