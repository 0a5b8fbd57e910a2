"""``python -m examples.gaussian_avatar CAPTURE --seconds 60 --out DIR``."""

import sys
from collections.abc import Sequence

import tyro

from monopart.geometry import MonopartError

from .train import main


def run(arguments: Sequence[str] | None = None) -> int:
    """Exit code: 0, or 2 after one line about bad input."""
    try:
        tyro.cli(main, args=arguments, config=(tyro.conf.PositionalRequiredArgs,))
    except MonopartError as problem:
        print(problem, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(run())
