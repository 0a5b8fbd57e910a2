"""What the commands of ``monopart-mesh`` do."""

import argparse
import dataclasses
import sys
from collections.abc import Callable

import numpy as np

from .cli import checked_scale
from .mesh_job import FOUND, Job, Options
from .meshio import Mesh, Skeleton, losses
from .progress import progress_bar


def run(arguments: argparse.Namespace) -> int:
    """Run one command.

    Args:
        arguments: what `monopart.tools.cli.parser` made of the command line.

    Returns:
        Exit code.
    """
    command: str = arguments.command
    names = {f.name for f in dataclasses.fields(Options)}
    options = Options(**{k: v for k, v in vars(arguments).items() if k in names})
    if command == "check":  # its result is the report
        out = options.out
        picture = options.picture or (out and out.with_suffix(".png"))
        options = dataclasses.replace(options, out=None, report=out, picture=picture)
    # broken meshes hold NaN and infinity; they are reported, not warned of
    with progress_bar(command) as update, np.errstate(all="ignore"):
        return COMMANDS[command](arguments, Job(command, options, update))


def convert(arguments: argparse.Namespace, job: Job) -> int:
    """Write a mesh in another format.

    Args:
        arguments: `input`, `scale`, `strict`.
        job: the run.

    Returns:
        Exit code; 1 with `strict` when something would be lost.
    """
    scale = checked_scale(arguments.scale)
    mesh = scaled(job.read(arguments.input), scale)
    lost = losses(mesh, arguments.out)
    if arguments.strict and (lost or mesh.notes):
        for line in (*mesh.notes, *lost):
            print(f"  would be lost: {line}")
        print("nothing written (--strict)", file=sys.stderr)
        return FOUND
    from .views import surface_panels

    return job.finish(mesh, {"scale": scale}, lambda size: surface_panels(mesh, mesh.name, size))


def scaled(mesh: Mesh, factor: float) -> Mesh:
    """A mesh with all lengths multiplied.

    Args:
        mesh: the mesh.
        factor: above 0.

    Returns:
        The same mesh in another unit, joints included.

    >>> scaled(Mesh(np.eye(3), np.zeros((0, 3))), 2.0).verts[0].tolist()
    [2.0, 0.0, 0.0]
    """
    if factor == 1:
        return mesh
    bones = mesh.skeleton
    with np.errstate(over="ignore", invalid="ignore"):
        return dataclasses.replace(
            mesh,
            verts=mesh.verts * factor,
            skeleton=bones and Skeleton(bones.names, bones.parents, bones.joints * factor),
        )


def remesh(arguments: argparse.Namespace, job: Job) -> int:
    """New triangles for an old surface.

    Args:
        arguments: `input`, and one of `faces`, `edge`, `clean`.
        job: the run.

    Returns:
        Exit code.
    """
    from . import remesh as room
    from .views import surface_panels

    mesh = job.read(arguments.input)
    if arguments.faces is not None:
        done = room.decimate(mesh, arguments.faces, job.update)
    elif arguments.edge is not None:
        done = room.isotropic(mesh, arguments.edge, progress=job.update)
    else:
        done = room.clean(mesh, arguments.close_holes, job.update)
    away = done.report["distance_max"]
    print(f"surfaces at most {away:.3g} apart ({done.report['distance_max_of_size']:.2g} of size)")
    return job.finish(
        done.mesh,
        done.report,
        lambda size: [
            *surface_panels(mesh, "before", size),
            *surface_panels(done.mesh, "after", size),
        ],
    )


def check(arguments: argparse.Namespace, job: Job) -> int:
    """Look for faults and print them, the worst first.

    Args:
        arguments: `input`, `strict`, `no_intersections`.
        job: the run.

    Returns:
        Exit code; 1 when there is an error, with `strict` also for a warning.
    """
    from .check import check_mesh
    from .views import fault_panels

    mesh = job.read(arguments.input)
    job.update(0.1, "checking")
    report = check_mesh(mesh, intersections=not arguments.no_intersections)
    for line in report.lines():
        print(line)
    warned = any(f.count and f.severity == "warning" for f in report.findings)
    ok = report.ok and not (arguments.strict and warned)
    bad = [(f.of, o.indices) for f in report.findings if f.severity != "note" for o in f.worst]
    return job.finish(None, report.as_dict(), lambda size: fault_panels(mesh, bad, size), ok)


COMMANDS: dict[str, Callable[[argparse.Namespace, Job], int]] = {
    "check": check,
    "convert": convert,
    "remesh": remesh,
}
