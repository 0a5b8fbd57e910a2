"""What the commands of ``monopart-mesh`` do."""

import argparse
import dataclasses
import io
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from monopart.geometry.atomic import write_bytes
from monopart.geometry.errors import InputError

from .bake_commands import bake, body
from .cli import checked_scale
from .mesh_job import FOUND, Job, Options
from .meshio import Mesh, Skeleton, losses
from .progress import progress_bar

if TYPE_CHECKING:
    from .partition import Partition


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
        job = Job(command, options, update)
        try:
            return COMMANDS[command](arguments, job)
        except InputError as error:
            raise _of_file(error, job) from error


def _of_file(error: InputError, job: Job) -> InputError:
    """An error that names a file: that of a mesh which knows its own name only."""
    text = str(error)
    options = job.options
    starts = [str(path) for path in (options.report, options.picture) if path is not None]
    if options.out is not None:  # and what stands beside it
        starts.append(f"{options.out.with_suffix('')}.")
    named = any(str(path) in text for path in job.inputs)
    if named or not job.inputs or text.startswith(("--", *starts)):
        return error
    names = ", ".join(map(str, job.inputs))
    return InputError(f"{names}: {text.removeprefix(f'{job.inputs[-1].stem}: ')}")


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


def unwrap(arguments: argparse.Namespace, job: Job) -> int:
    """Texture coordinates for a mesh.

    Args:
        arguments: `input`, `parts`, `no_symmetry` and the options of `monopart.geometry.unwrap`.
        job: the run.

    Returns:
        Exit code; 1 when faces are flipped or overlap, which methods other than slim may leave.
    """
    mesh = job.read(arguments.input).require()
    import torch

    from monopart.geometry.unwrap import unwrap as work

    from .views import uv_panels

    labels = None
    if arguments.parts is not None:
        from .partition import partition as divide

        job.update(0.02, "dividing")
        labels = torch.from_numpy(divide(mesh, arguments.parts).face_part)
    names = ("target", "method", "engine", "size", "margin", "max_charts", "chart_share")
    layout = work(
        torch.from_numpy(mesh.verts),
        torch.from_numpy(mesh.faces),
        parts=labels,
        progress=lambda stage, done: job.update(_share(stage, done), stage),
        symmetric=not arguments.no_symmetry,
        **{name: getattr(arguments, name) for name in names},
    )
    done = dataclasses.replace(mesh, corner_uv=layout.corner_uv.numpy(), texture=None, notes=())
    if mesh.texture is not None:
        print("  note: the texture fits the old coordinates and is not kept; bake it")
    for name, value in vars(layout.report).items():
        if isinstance(value, int | float):
            print(f"  {name.replace('_', ' ')}: {value:.4g}")
    ok = not layout.report.flips and not layout.report.overlaps
    return job.finish(done, vars(layout.report), lambda size: uv_panels(done, size), ok)


def _share(stage: str, done: float) -> float:
    """Part of an unwrapping that is done, by the usual times of its stages."""
    start, end = {"seams": (0.03, 0.1), "flatten": (0.1, 0.2), "pack": (0.65, 0.88)}.get(
        stage, (0.2, 0.65)
    )
    return start + (end - start) * min(max(done, 0.0), 1.0)


def partition(arguments: argparse.Namespace, job: Job) -> int:
    """Divide a mesh into body parts; the result carries their colours, an npz their numbers.

    Args:
        arguments: `input`, `parts`, `table`, `method`, `smoothing`, `band`, `no_symmetry`.
        job: the run.

    Returns:
        Exit code; 1 when a part is empty or the mesh is unlike a body.
    """
    from . import partition as room
    from .colors import part_color
    from .views import part_panels

    mesh = job.read(arguments.input)
    table = None if arguments.table is None else read_table(arguments.table, job)
    target = job.beside(".parts.npz")
    job.update(0.1, "dividing")
    parts = room.partition(
        mesh,
        arguments.parts,
        table=table,
        method=arguments.method,
        smoothing=arguments.smoothing,
        band=arguments.band,
        symmetry_plane=None if arguments.no_symmetry else 0.0,
    )
    report = room.partition_report(mesh, parts)
    for part, name in enumerate(parts.names):
        print(f"  {name}: {int((parts.face_part == part).sum())} faces")
    for note in parts.notes:
        print(f"  note: {note}")
    job.extra[target] = lambda path: write_bytes(path, parts_archive(parts))
    upright = mesh
    if parts.upright is not None:
        upright = dataclasses.replace(mesh, verts=parts.upright(mesh.verts))
    colored = dataclasses.replace(mesh, colors=part_color(parts.vertex_part), notes=())
    names = parts.names
    return job.finish(
        colored,
        report,
        lambda size: part_panels(upright, parts.face_part, names, size),
        ok=not parts.notes,
    )


def read_table(path: Path, job: Job) -> dict[str, list[int]]:
    """Joints of each part, from a JSON file.

    Args:
        path: a JSON object of lists of joint numbers.
        job: the run; the file becomes one of its inputs.

    Returns:
        Part name → joints.

    Raises:
        InputError: no such file or another content.
    """
    job.using(path)
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected a JSON file, found none ({error})") from error
    good = isinstance(table, dict) and all(
        isinstance(joints, list) and all(type(j) is int for j in joints)
        for joints in table.values()
    )
    if not good:
        raise InputError(
            f'{path}: expected an object of lists of joint numbers such as {{"head": [12, 15]}}, '
            "found other content; correct it"
        )
    return table


def parts_archive(parts: "Partition") -> bytes:
    """The numbers of a partition as npz: names, face_part, vertex_part, and bands if there are.

    Args:
        parts: the partition.

    Returns:
        The file's bytes.
    """
    arrays: dict[str, np.ndarray] = {
        "names": np.array(parts.names),
        "face_part": parts.face_part,
        "vertex_part": parts.vertex_part,
    }
    if parts.bands is not None:
        arrays |= {"band_faces": parts.bands.faces, "shares": parts.bands.shares}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


COMMANDS: dict[str, Callable[[argparse.Namespace, Job], int]] = {
    "bake": bake,
    "body": body,
    "check": check,
    "convert": convert,
    "partition": partition,
    "remesh": remesh,
    "unwrap": unwrap,
}
