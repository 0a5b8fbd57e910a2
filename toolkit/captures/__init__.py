"""Captures: folders of images, masks, cameras and body poses, read into records."""

from dataclasses import replace
from pathlib import Path

from monopart.geometry.errors import InputError

from .checks import CaptureCheck, check_capture, describe
from .colmap import read_colmap, write_colmap
from .easymocap import read_easymocap, write_easymocap
from .frames import Frame, Split
from .reading import Reading
from .records import CaptureRecord, Progress
from .subjects import SUBJECTS, Subject, subject
from .zju_mocap import read_zju_mocap

__all__ = [
    "SUBJECTS",
    "CaptureCheck",
    "CaptureRecord",
    "Frame",
    "Progress",
    "Reading",
    "Split",
    "Subject",
    "check_capture",
    "describe",
    "read_capture",
    "read_colmap",
    "read_easymocap",
    "read_zju_mocap",
    "subject",
    "write_colmap",
    "write_easymocap",
]


def read_capture(
    path: str | Path,
    params: str | None = None,
    body: str | Path | None = None,
    reading: Reading | None = None,
) -> CaptureRecord:
    """Read a capture in any layout that is known; today that of ZJU-MoCap and MonoCap.

    Args:
        path: folder of the capture.
        params: folder of the body track inside it, where it is not the layout's own.
        body: body file that the poses belong to, where it is not the capture's own.
        reading: subject, sizes and more; `params` and `body` go before what it says of them.

    Returns:
        The record, in house conventions (metres, pixel centres at +½).

    Raises:
        InputError: no folder, no layout that is known, or a fault in the capture.
    """
    root = Path(path)
    if not root.is_dir():
        found = "a file" if root.exists() else "nothing"
        raise InputError(f"{root}: expected the folder of a capture, found {found}; check the path")
    if (root / "annots.npy").is_file():
        how = reading or Reading()
        if params is not None:
            how = replace(how, params=params)
        if body is not None:
            how = replace(how, body=str(body))
        return read_zju_mocap(root, how)
    inside = ", ".join(sorted(p.name for p in root.iterdir())[:6]) or "nothing"
    raise InputError(
        f"{root}: expected annots.npy (ZJU-MoCap layout: annots.npy, images, mask, new_params), "
        f"found {inside}; name the folder that holds annots.npy"
    )
