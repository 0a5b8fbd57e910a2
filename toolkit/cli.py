"""The program ``monopart``: reads the command line, runs a command, turns errors into one line.

Nothing heavy is imported here: help must be there at once, and an extra that is missing is said.
"""

import os
import sys
from collections.abc import Sequence

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
    try:
        from .arguments import parse

        parse(sys.argv[1:] if argv is None else argv).run()
    except MonopartError as error:
        return _fail(str(error))
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if not missing or missing == "monopart":
            raise
        return _fail(f"the package {missing} is not installed; install it by {INSTALL}")
    except KeyboardInterrupt:
        print("monopart: interrupted", file=sys.stderr)
        return INTERRUPTED
    return None


def _fail(message: str) -> int:
    print(f"monopart: error: {' '.join(message.split())}", file=sys.stderr)
    return BAD_INPUT


if __name__ == "__main__":
    sys.exit(main())
