"""The program ``monopart``: reads the command line, runs a command, turns errors into one line.

Nothing heavy is imported here: help must be there at once, and an extra that is missing is said.
"""

import os
import sys
from collections.abc import Callable, Sequence

from monopart.geometry.errors import MonopartError

INSTALL = 'pip install "monopart[toolkit]"'
BAD_INPUT = 2
INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int | None:
    """Run the program.

    Args:
        argv: arguments after the program's name; those of the process if None.

    Returns:
        Exit code: None or 0 when all is well, 2 for bad input, 130 after an interrupt.
    """
    # Threads that wait must sleep, not spin: a busy machine would otherwise stall at each barrier.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

    def work() -> None:
        from .arguments import parse

        parse(sys.argv[1:] if argv is None else argv).run()

    return guarded("monopart", INSTALL, work)


def guarded(program: str, install: str, work: Callable[[], None]) -> int | None:
    """Run a program's work and turn what stops it into one line and an exit code.

    Args:
        program: name in front of the line.
        install: the command that brings a package that is missing.
        work: what the program does.

    Returns:
        None when all is well, 2 for bad input, 130 after an interrupt.
    """
    try:
        work()
    except MonopartError as error:
        return _fail(program, str(error))
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if not missing or missing == "monopart":
            raise
        return _fail(program, f"the package {missing} is not installed; install it by {install}")
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        return INTERRUPTED
    return None


def _fail(program: str, message: str) -> int:
    print(f"{program}: error: {' '.join(message.split())}", file=sys.stderr)
    return BAD_INPUT


if __name__ == "__main__":
    sys.exit(main())
