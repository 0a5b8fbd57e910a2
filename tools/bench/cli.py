"""The program ``monopart-bench``: run time against error, ours and other libraries'."""

import argparse
import dataclasses
import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from monopart.geometry.errors import InputError
from monopart.toolkit.cli import guarded

from .registry import Settings

if TYPE_CHECKING:
    from .results import Report

INSTALL = 'pip install "monopart[toolkit,bench]"'
SUITES = {
    "geometry": "closest surface, inverse skinning, skinning, rotations, undistortion",
    "fields": "hash grid, compositing, networks",
    "training": "PSNR against seconds of every preset on each CAPTURE",
    "render": "seconds per picture of RUN",
    "skipping": "samples that are left of a picture, and what a training step saves",
    "uv": "texture coordinates of ten meshes: seconds, distortion, charts, seams, packing",
    "scaling": "time against rays, samples, frames, parts, joints, mesh size, points, threads",
}


def parser() -> argparse.ArgumentParser:
    """The arguments."""
    root = argparse.ArgumentParser(
        prog="monopart-bench",
        description="Benchmarks: methods take turns in one process; medians with spread, wall and "
        "CPU seconds, errors against a double-precision oracle. Writes JSON, Markdown and plots.",
    )
    commands = root.add_subparsers(dest="command", required=True)
    for name, text in SUITES.items():
        command = commands.add_parser(name, help=text, description=text)
        if name == "training":
            _training_arguments(command)
        elif name == "render":
            command.add_argument("run", type=Path, metavar="RUN")
        elif name == "skipping":
            command.add_argument("run", type=Path, metavar="RUN_OR_CAPTURE")
        if name == "geometry":
            command.add_argument("--poses", type=int, default=20, metavar="N")
        if name == "uv":
            command.add_argument("--into", type=Path, metavar="PAGE", help="write tables into it")
        if name in ("geometry", "render", "skipping"):
            command.add_argument("--capture", type=Path, metavar="DIR")
        command.add_argument("--only", action="append", default=[], metavar="OPERATION")
        command.add_argument("--quick", action="store_true", help="tiny problems: does it run?")
        command.add_argument("--out", type=Path, default=Path("runs/bench"), metavar="DIR")
        command.add_argument("--threads", type=int, metavar="N", help="threads of torch and Warp")
        command.add_argument("--markdown", action="store_true", help="print Markdown, not a table")
    _stability_arguments(commands)
    _meshes_arguments(commands)
    compare = commands.add_parser("compare", help="two reports side by side")
    compare.add_argument("a", type=Path, metavar="A.json")
    compare.add_argument("b", type=Path, metavar="B.json")
    show = commands.add_parser("show", help="print a report again")
    show.add_argument("report", type=Path, metavar="REPORT.json")
    show.add_argument("--markdown", action="store_true")
    cuda = commands.add_parser("cuda-sources", help="compile all kernels for CUDA, without a GPU")
    cuda.add_argument("--arch", type=int, action="append", default=[], metavar="SM")
    text = "write reports into a page, in place; without reports those that it holds, anew"
    publish = commands.add_parser("publish", help=text, description=text)
    publish.add_argument("reports", type=Path, nargs="*", metavar="REPORT.json")
    publish.add_argument("--into", type=Path, default=Path("docs/benchmarks.md"), metavar="PAGE")
    return root


def _meshes_arguments(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    text = "monopart-mesh on the meshes in folders: results or clear errors, inputs left alone"
    command = commands.add_parser("meshes", help=text, description=text)
    command.add_argument("folders", type=Path, nargs="+", metavar="FOLDER")
    text = "size of the largest file (default: 700)"
    command.add_argument("--largest", type=int, default=700, metavar="KB", help=text)
    text = "meshes of a folder, spread over their sizes (default: 8)"
    command.add_argument("--each", type=int, default=8, metavar="N", help=text)
    command.add_argument("--out", type=Path, default=Path("runs/bench"), metavar="DIR")
    command.add_argument("--into", type=Path, metavar="PAGE", help="write the table into it")


def _training_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("captures", type=Path, nargs="+", metavar="CAPTURE")
    command.add_argument("--preset", action="append", default=[], metavar="NAME")
    command.add_argument("--seeds", type=int, nargs="+", default=[0], metavar="N")
    budget = command.add_mutually_exclusive_group()
    budget.add_argument("--seconds", type=float, default=240.0, metavar="S", help="of the clock")
    budget.add_argument("--cpu-seconds", type=float, metavar="S", help="of the processor")


def _stability_arguments(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    text = "every operation on inputs that break float arithmetic, beside other libraries"
    command = commands.add_parser("stability", help=text, description=text)
    size = command.add_mutually_exclusive_group()
    size.add_argument("--exhaustive", action="store_true", help="about a million cases")
    size.add_argument("--quick", action="store_true", help="ours only, few cases")
    command.add_argument("--only", action="append", default=[], metavar="OPERATION")
    command.add_argument("--out", type=Path, default=Path("runs/bench"), metavar="DIR")
    command.add_argument("--into", type=Path, metavar="PAGE", help="write tables and maps into it")
    text = "trainings with spoilt input: no NaN, an end, and a word on what is wrong"
    command = commands.add_parser("stability-training", help=text, description=text)
    command.add_argument("capture", type=Path, metavar="CAPTURE")
    command.add_argument("--seeds", type=int, default=20, metavar="N")
    command.add_argument("--steps", type=int, default=60, metavar="N")
    command.add_argument("--into", type=Path, metavar="PAGE", help="write the table into it")


def main(argv: Sequence[str] | None = None) -> int | None:
    """Run the program.

    Args:
        argv: arguments after the program's name; those of the process if None.

    Returns:
        None when all is well, 2 for bad input, 130 after an interrupt.
    """
    arguments = parser().parse_args(argv)
    return guarded("monopart-bench", INSTALL, lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> None:
    if arguments.command == "compare":
        from .compare import print_changes
        from .results import read_report

        print_changes(read_report(arguments.a), read_report(arguments.b))
    elif arguments.command == "cuda-sources":
        from .cuda_sources import print_compiled

        print_compiled(tuple(arguments.arch) or (75, 80, 90))
    elif arguments.command == "publish":
        from .publish import publish

        print(", ".join(publish(arguments.reports, arguments.into)))
    elif arguments.command == "meshes":
        from .foreign import write

        write(arguments)
    elif arguments.command == "stability":
        from .stability_page import command

        size = "exhaustive" if arguments.exhaustive else "quick" if arguments.quick else "usual"
        command(size, arguments.only, arguments.out, arguments.into)
    elif arguments.command == "stability-training":
        from .stability_training import command

        command(arguments.capture, arguments.seeds, arguments.steps, arguments.into)
    elif arguments.command == "show":
        from .results import read_report
        from .show import markdown, print_report

        report = read_report(arguments.report)
        if arguments.markdown:
            print(markdown(report), end="")
        else:
            print_report(report)
    else:
        _suite(arguments)


def _settings(arguments: argparse.Namespace) -> Settings:
    cpu = getattr(arguments, "cpu_seconds", None)
    seconds = getattr(arguments, "seconds", 240.0) if cpu is None else cpu
    if not 0 < seconds < math.inf:
        raise InputError(f"--seconds, --cpu-seconds: expected more than 0, found {seconds:g}")
    return Settings(
        quick=arguments.quick,
        capture=getattr(arguments, "capture", None),
        run=getattr(arguments, "run", None),
        only=tuple(arguments.only),
        poses=max(1, getattr(arguments, "poses", 20)),
        presets=tuple(getattr(arguments, "preset", ())),
        seconds=seconds,
        cpu_budget=cpu is not None,
        seeds=tuple(getattr(arguments, "seeds", (0,))),
    )


def _suite(arguments: argparse.Namespace) -> None:
    import torch

    from .show import markdown, print_report, save_report

    if arguments.threads is not None:
        torch.set_num_threads(max(1, arguments.threads))
    for report in _reports(arguments, _settings(arguments)):
        path = save_report(report, arguments.out)
        if arguments.markdown:
            print(markdown(report), end="")
        else:
            print_report(report)
        print(f"written: {path}", file=sys.stderr)


def _reports(arguments: argparse.Namespace, settings: Settings) -> Iterator["Report"]:
    """The report of a suite; of training, one per capture."""
    from . import fields, geometry, render, scaling, skipping, uv
    from .show import save_report
    from .suite import run_suite

    def keep(report: "Report") -> None:
        save_report(report, arguments.out)

    if arguments.command == "training":
        from .training import run_training

        names = [capture.absolute().name for capture in arguments.captures]
        if len(set(names)) < len(names):
            raise InputError(
                f"CAPTURE: expected folders of different names, found {', '.join(names)}; the "
                "reports are named after them"
            )
        for capture in arguments.captures:
            yield run_training(dataclasses.replace(settings, capture=capture), keep)
        return
    rooms = {"geometry": geometry, "fields": fields, "render": render}
    rooms |= {"scaling": scaling, "skipping": skipping, "uv": uv}
    operations = rooms[arguments.command].operations()
    report = run_suite(arguments.command, operations, settings, keep)
    if arguments.command == "uv" and arguments.into is not None:
        uv.write_page(report, arguments.into)
    yield scaling.with_exponents(report) if arguments.command == "scaling" else report


if __name__ == "__main__":
    sys.exit(main())
