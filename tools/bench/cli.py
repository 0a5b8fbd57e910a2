"""The program ``monopart-bench``: run time against error, ours and other libraries'."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from monopart.toolkit.cli import guarded

from .registry import Settings

INSTALL = 'pip install "monopart[toolkit,bench]"'
SUITES = {
    "geometry": "closest surface, inverse skinning, skinning, rotations, undistortion",
    "fields": "hash grid, compositing, networks",
    "training": "PSNR against seconds of every preset on CAPTURE",
    "render": "seconds per picture of RUN",
    "skipping": "samples that are left of a picture of RUN, and what a training step saves",
    "scaling": "time against rays, samples, frames, parts, vertices, threads",
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
            command.add_argument("capture", type=Path, metavar="CAPTURE")
            command.add_argument("--preset", action="append", default=[], metavar="NAME")
            command.add_argument("--seconds", type=float, default=240.0, metavar="S")
        elif name in ("render", "skipping"):
            command.add_argument("run", type=Path, metavar="RUN")
        if name == "geometry":
            command.add_argument("--poses", type=int, default=20, metavar="N")
        if name in ("geometry", "render", "skipping"):
            command.add_argument("--capture", type=Path, metavar="DIR")
        command.add_argument("--only", action="append", default=[], metavar="OPERATION")
        command.add_argument("--quick", action="store_true", help="tiny problems: does it run?")
        command.add_argument("--out", type=Path, default=Path("runs/bench"), metavar="DIR")
        command.add_argument("--threads", type=int, metavar="N", help="threads of torch and Warp")
        command.add_argument("--markdown", action="store_true", help="print Markdown, not a table")
    compare = commands.add_parser("compare", help="two reports side by side")
    compare.add_argument("a", type=Path, metavar="A.json")
    compare.add_argument("b", type=Path, metavar="B.json")
    show = commands.add_parser("show", help="print a report again")
    show.add_argument("report", type=Path, metavar="REPORT.json")
    show.add_argument("--markdown", action="store_true")
    cuda = commands.add_parser("cuda-sources", help="compile all kernels for CUDA, without a GPU")
    cuda.add_argument("--arch", type=int, action="append", default=[], metavar="SM")
    publish = commands.add_parser("publish", help="write reports into a page, in place")
    publish.add_argument("reports", type=Path, nargs="+", metavar="REPORT.json")
    publish.add_argument("--into", type=Path, default=Path("docs/benchmarks.md"), metavar="PAGE")
    return root


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
    return Settings(
        quick=arguments.quick,
        capture=getattr(arguments, "capture", None),
        run=getattr(arguments, "run", None),
        only=tuple(arguments.only),
        poses=max(1, getattr(arguments, "poses", 20)),
        presets=tuple(getattr(arguments, "preset", ())),
        seconds=getattr(arguments, "seconds", 240.0),
    )


def _suite(arguments: argparse.Namespace) -> None:
    import torch

    from .show import markdown, print_report, save_report

    if arguments.threads is not None:
        torch.set_num_threads(max(1, arguments.threads))
    settings, plots = _settings(arguments), {}
    if arguments.command == "training":
        from .training import run_training

        report, plots = run_training(settings)
    else:
        from . import fields, geometry, render, scaling, skipping
        from .suite import run_suite

        rooms = {"geometry": geometry, "fields": fields, "render": render}
        rooms |= {"scaling": scaling, "skipping": skipping}
        operations = rooms[arguments.command].operations()
        report = run_suite(
            arguments.command, operations, settings, lambda r: save_report(r, arguments.out)
        )
        if arguments.command == "scaling":
            report = scaling.with_exponents(report)
    path = save_report(report, arguments.out)
    for name, plot in plots.items():
        (arguments.out / name).write_text(plot, encoding="utf-8")
    if arguments.markdown:
        print(markdown(report), end="")
    else:
        print_report(report)
    print(f"written: {path}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
