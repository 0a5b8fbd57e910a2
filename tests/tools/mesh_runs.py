"""Runs of monopart-mesh inside the test process."""

import hashlib

from monopart.tools import cli

PREFIX = "monopart-mesh: error: "


def run(capsys, *argv):
    """Exit code, stdout and stderr."""
    capsys.readouterr()
    code = cli.main([str(a) for a in argv])
    seen = capsys.readouterr()
    return code or 0, seen.out, seen.err


def refused(capsys, *argv):
    """The one line of an error, without its prefix."""
    code, _, err = run(capsys, *argv)
    lines = err.splitlines()
    assert code == 2 and len(lines) == 1 and lines[0].startswith(PREFIX), err
    return lines[0].removeprefix(PREFIX)


def hashes(folder):
    """Name and hash of every file."""
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.iterdir()}
