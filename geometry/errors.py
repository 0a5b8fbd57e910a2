"""Errors that name the thing, what was expected, what was found and the fix."""


class MonopartError(Exception):
    """Base of every error raised on purpose; a command line prints it as one line, exit code 2."""


class InputError(MonopartError, ValueError):
    """A file or an argument is not what the function needs."""


class BackendError(MonopartError, RuntimeError):
    """A back end asked for by name is not available here."""
