"""The program ``monopart-mesh``: tools for meshes in standard files.

Nothing heavy is imported here: help is there at once, and an extra that is missing is said.
"""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from monopart.geometry.errors import InputError, MonopartError

INSTALL = 'pip install "monopart[tools]"'
BAD_INPUT = 2
INTERRUPTED = 130
FORMATS = "obj, ply, stl, glb, gltf, npz"

ERRORS = (MonopartError, ValueError, RuntimeError, ArithmeticError, LookupError, TypeError)
"""What a command may end with; libraries raise the others on meshes they were not made for."""

Add = Callable[[argparse.ArgumentParser], None]

PROGRAM = f"""Tools for meshes and bodies. Files: {FORMATS} (npz in the layout of SMPL files).

Each command reads INPUT, which is never changed, and writes OUT, a picture (OUT.COMMAND.png) and a
report (OUT.COMMAND.json). Results go to stdout, progress to stderr. Exit code: 0 done, 1 something
was found or would be lost, 2 wrong input, 130 interrupt."""


def parser() -> argparse.ArgumentParser:
    """The arguments of the program."""
    root = argparse.ArgumentParser(
        prog="monopart-mesh",
        description=PROGRAM,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = root.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, (text, add) in COMMANDS.items():
        command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        add(command)
    return root


def _files(command: argparse.ArgumentParser, needs_out: bool = True) -> None:
    """Where results go: the same for every command."""
    group = command.add_argument_group("files")
    text = f"result ({FORMATS})" if needs_out else "JSON report; without it nothing is written"
    group.add_argument("-o", "--out", type=Path, required=needs_out, metavar="OUT", help=text)
    if needs_out:
        group.add_argument("--report", type=Path, metavar="FILE", help="JSON report")
        group.add_argument("--text", action="store_true", help="ply and stl as text, not binary")
    group.add_argument("--picture", type=Path, metavar="FILE", help="picture (png)")
    group.add_argument("--picture-size", type=int, default=640, metavar="N", help="pixels a panel")
    group.add_argument("--no-picture", action="store_true", help="draw none")
    group.add_argument(
        "--overwrite", action="store_true", help="replace files that are there, never an input"
    )


def _input(command: argparse.ArgumentParser) -> None:
    command.add_argument("input", type=Path, metavar="INPUT", help="mesh")


def _convert(command: argparse.ArgumentParser) -> None:
    _input(command)
    command.add_argument(
        "--strict",
        action="store_true",
        help="if anything would be lost, write nothing: code 1",
    )
    command.add_argument(
        "--scale", type=float, default=1.0, metavar="S", help="factor of all lengths"
    )
    _files(command)


def _remesh(command: argparse.ArgumentParser) -> None:
    _input(command)
    way = command.add_mutually_exclusive_group(required=True)
    way.add_argument("--faces", type=int, metavar="N", help="decimate to N triangles")
    way.add_argument("--edge", type=float, metavar="L", help="equal edges of about this length")
    way.add_argument(
        "--clean",
        action="store_true",
        help="remove NaN, doubles and slivers, mend non-manifold places",
    )
    command.add_argument(
        "--close-holes", type=int, default=0, metavar="N", help="with --clean: of at most N edges"
    )
    _files(command)


def _check(command: argparse.ArgumentParser) -> None:
    _input(command)
    command.add_argument("--strict", action="store_true", help="exit code 1 for warnings as well")
    command.add_argument(
        "--no-intersections", action="store_true", help="leave out self-intersections (slow)"
    )
    _files(command, needs_out=False)


def _unwrap(command: argparse.ArgumentParser) -> None:
    _input(command)
    text = "mean symmetric Dirichlet energy; 4 keeps all lengths, more gives fewer charts"
    command.add_argument("--target", type=float, default=4.03, metavar="E", help=text)
    text = "slim never flips a face; the others are quick, and may flip and overlap"
    ways = ("slim", "arap", "lscm", "harmonic")
    command.add_argument("--method", choices=ways, default="slim", help=text)
    text = "xatlas for comparison"
    command.add_argument("--engine", choices=("monopart", "xatlas"), default="monopart", help=text)
    text = "texels along a side (default: 2048)"
    command.add_argument("--size", type=int, default=2048, metavar="N", help=text)
    text = "least distance of charts in texels (default: 4)"
    command.add_argument("--margin", type=float, default=4.0, metavar="N", help=text)
    text = "make no more charts for the sake of the target"
    command.add_argument("--max-charts", type=int, metavar="N", help=text)
    text = "largest part of the surface in one chart"
    command.add_argument("--chart-share", type=float, metavar="S", help=text)
    text = "charts of their own for each part: the name of a division as in partition"
    command.add_argument("--parts", metavar="NAME", help=text)
    text = "do not mirror the seams of a symmetric mesh"
    command.add_argument("--no-symmetry", action="store_true", help=text)
    _files(command)


def _partition(command: argparse.ArgumentParser) -> None:
    _input(command)
    group = command.add_mutually_exclusive_group()
    text = "three, five, six, per_limb, any of them with +hands, or single (default: five)"
    group.add_argument("--parts", default="five", metavar="NAME", help=text)
    text = 'joints of each part as JSON, such as {"head": [12, 15], ...}'
    group.add_argument("--table", type=Path, metavar="FILE", help=text)
    text = "where weights come from: its own, heat from its joints, or transfer from our body"
    ways = ("auto", "weights", "heat", "transfer")
    command.add_argument("--method", choices=ways, default="auto", help=text)
    text = "how far borders may move to become short (default: 1/100 of the size; 0: not at all)"
    command.add_argument("--smoothing", type=float, metavar="L", help=text)
    text = "let parts reach this far over their borders"
    command.add_argument("--band", type=float, metavar="L", help=text)
    text = "do not make left and right equal (by the plane x = 0)"
    command.add_argument("--no-symmetry", action="store_true", help=text)
    _files(command)


def _bake(command: argparse.ArgumentParser) -> None:
    what = ("weights", "uv", "colors", "texture", "distance")
    text = "what to carry; distance makes a grid (npz) of SOURCE alone"
    command.add_argument("what", choices=what, help=text)
    command.add_argument("source", type=Path, metavar="SOURCE", help="mesh to take it from")
    command.add_argument(
        "target", type=Path, nargs="?", metavar="TARGET", help="mesh to bake onto, in the same pose"
    )
    text = "weights: fill in vertices that are farther away"
    command.add_argument("--max-distance", type=float, metavar="L", help=text)
    text = "texture: rows and columns (default: 1024)"
    command.add_argument("--size", type=int, default=1024, metavar="N", help=text)
    text = "distance: between nodes (default: 1/64 of the size)"
    command.add_argument("--spacing", type=float, metavar="L", help=text)
    text = "distance: around the mesh (default: 1/20 of the size)"
    command.add_argument("--margin", type=float, metavar="L", help=text)
    text = "distance: of open meshes too, not negative inside"
    command.add_argument("--unsigned", action="store_true", help=text)
    _files(command)


def _body(command: argparse.ArgumentParser) -> None:
    text = "SMPL, SMPL-H or SMPL-X file (default: the free body of the package)"
    command.add_argument("--source", type=Path, metavar="FILE", help=text)
    text = "shape coefficients of the subject"
    command.add_argument("--betas", type=float, nargs="+", default=[], metavar="B", help=text)
    command.add_argument("--height", type=float, metavar="M", help="stature in metres")
    text = "level of detail: at most N triangles"
    command.add_argument("--faces", type=int, metavar="N", help=text)
    _files(command)


COMMANDS: dict[str, tuple[str, Add]] = {
    "unwrap": ("lay a mesh into the unit square, without flips or overlaps", _unwrap),
    "partition": ("divide a mesh into body parts, rigged or not", _partition),
    "check": ("look for what makes a mesh unfit: holes, slivers, overlaps, weights", _check),
    "bake": ("carry weights, textures or colours to another mesh; distance grids", _bake),
    "body": ("build the body file of a subject", _body),
    "remesh": ("new triangles for the same surface; weights and textures are kept", _remesh),
    "convert": ("write a mesh in another format and say what that loses", _convert),
}


def main(argv: Sequence[str] | None = None) -> int | None:
    """Run the program.

    Args:
        argv: arguments after the program's name; those of the process if None.

    Returns:
        Exit code: None or 0 when all is well, 1 when something was found, 2 for wrong input, 130
        after an interrupt.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    arguments = parser().parse_args(argv)
    try:
        from .mesh_commands import run

        return run(arguments)
    except KeyboardInterrupt:
        print("monopart-mesh: interrupted", file=sys.stderr)
        return INTERRUPTED
    except (*ERRORS, OSError, MemoryError, ModuleNotFoundError) as error:
        message = _said(error, arguments.command)
        if message is None:
            raise
        return _fail(message)


def _said(error: Exception, command: str) -> str | None:
    """An error in one line; None for those that only a developer can understand."""
    if isinstance(error, MonopartError):
        return str(error)
    if isinstance(error, ModuleNotFoundError):
        missing = (error.name or "").partition(".")[0]
        ours = not missing or missing == "monopart"
        return None if ours else f"the package {missing} is not installed; install it by {INSTALL}"
    if isinstance(error, OSError):
        return f"{error.filename or command}: {error.strerror or error}"
    if isinstance(error, MemoryError):
        return "expected a mesh that fits into memory, found a larger one; decimate it first"
    if os.environ.get("MONOPART_DEBUG"):
        return None
    return (
        f"{command} failed on this mesh ({type(error).__name__}: {error}); look at it with "
        "monopart-mesh check, and set MONOPART_DEBUG=1 for all of the error"
    )


def _fail(message: str) -> int:
    print(f"monopart-mesh: error: {' '.join(message.split())}", file=sys.stderr)
    return BAD_INPUT


def checked_scale(value: float) -> float:
    """A factor above 0.

    Args:
        value: what the user gave.

    Returns:
        The same.

    Raises:
        InputError: not a positive finite number.

    >>> checked_scale(0.01)
    0.01
    """
    if not 0 < value < float("inf"):
        raise InputError(f"--scale: expected a number above 0, found {value:g}; give another")
    return value


if __name__ == "__main__":
    sys.exit(main())
