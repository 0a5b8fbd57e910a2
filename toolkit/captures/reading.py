"""How a capture is to be read: what the caller asks, what its capture.json states, what it is."""

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from monopart.geometry.errors import InputError

from .subjects import Subject, recognise, subject

FILE = "capture.json"
"""Optional file of a capture that states some of these choices."""

_KINDS: dict[str, tuple[str, tuple[type, ...]]] = {
    **dict.fromkeys(("params", "body", "subject"), ("a text", (str,))),
    **dict.fromkeys(("scale", "test_scale"), ("a number", (int, float))),
    "legacy_pixels": ("true or false", (bool,)),
}


@dataclass(frozen=True)
class Reading:
    """Choices of reading; None leaves one to capture.json, then to the subject, then to the data.

    The same entries may stand in the file `capture.json` of a capture. A run records those it was
    trained with, so that it is opened in the same way.
    """

    params: str | None = None
    """Folder of the body track inside the capture."""
    body: str | None = None
    """Body file that the poses belong to; in capture.json relative to the capture."""
    subject: str | None = None
    """Name of a subject of `subjects.SUBJECTS`, whose protocol then holds."""
    scale: float | None = None
    """Size of the images that train, of the stored size, above 0 and at most 1."""
    test_scale: float | None = None
    """Size of the images that are compared, likewise; that of `scale` where only this is stated."""
    legacy_pixels: bool | None = None
    """Scale images as the authors of the data sets do: no half pixel in K, nearest masks."""

    def resolved(self, root: Path) -> "Reading":
        """With what the capture's own file states, where nothing was asked for.

        Args:
            root: folder of the capture.

        Returns:
            The choices.

        Raises:
            InputError: a damaged file, an unknown entry, a value that cannot be used.
        """
        stated = _stated(root / FILE)
        mine = {k: v for k, v in dataclasses.asdict(self).items() if v is not None}
        if "scale" in mine and "test_scale" not in mine:
            mine["test_scale"] = mine["scale"]
        if "scale" in stated and "test_scale" not in stated:
            stated["test_scale"] = stated["scale"]
        both = dataclasses.replace(Reading(), **{**stated, **mine})
        for name in ("scale", "test_scale"):
            value = getattr(both, name)
            if value is not None and not (math.isfinite(value) and 0 < value <= 1):
                raise InputError(
                    f"{name}: expected a factor above 0 and at most 1, found {value}; give e.g. 0.5"
                )
        return both

    def known_subject(self, root: Path) -> Subject | None:
        """The subject that is asked for or, with no splits.json, the one the folder is named after.

        Args:
            root: folder of the capture.

        Returns:
            The subject; None where the capture is another.

        Raises:
            InputError: no such subject.
        """
        if self.subject is not None:
            return subject(self.subject)
        if (root / "splits.json").is_file():
            return None
        return recognise(root.resolve().name)


def _stated(path: Path) -> dict[str, Any]:
    """Entries of a capture.json; none where there is no file."""
    if not path.is_file():
        return {}
    try:
        stated = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        found = " ".join(str(error).split())
        raise InputError(f"{path}: expected JSON, found {found}; correct or remove it") from error
    if not isinstance(stated, dict) or not set(stated) <= set(_KINDS):
        extra = sorted(set(stated) - set(_KINDS)) if isinstance(stated, dict) else "another"
        raise InputError(
            f"{path}: expected an object with some of {', '.join(_KINDS)}, found {extra}; correct "
            f"the file"
        )
    for name, value in stated.items():
        if type(value) not in _KINDS[name][1]:
            raise InputError(
                f"{path}: expected {_KINDS[name][0]} in {name}, found {value!r}; correct it"
            )
    if "body" in stated:
        stated["body"] = str(path.parent / stated["body"])
    return stated
