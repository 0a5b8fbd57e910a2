"""The ten subjects of the paper as data: cameras, frames, folders and scales of each, by name.

The figures are facts of the ZJU-MoCap (refined) and MonoCap releases and of the protocol in which
their published numbers were made (METHOD section 10); nothing here reads a file.
"""

import re
from dataclasses import dataclass

from monopart.geometry.errors import InputError

FRAME_STEP = 5
"""Frames between two training frames, and between two frames of novel poses."""
TRAIN_FRAMES = 100
"""Training frames of a subject: they span its first 500 frames."""
NOVEL_VIEW_STEP = 6
"""Training frames between two frames at which held-out cameras are compared: 17 of the 100."""
NOVEL_POSE_FRAMES = 50
"""Frames of novel poses at most: the paper holds out one for two that train."""
ON_TRAINING_CAMERA = "novel_pose_training_camera"
"""Split of the novel poses seen by the training camera, as the authors' code scores them."""


@dataclass(frozen=True)
class Subject:
    """One person of a public data set, and the protocol of its published numbers."""

    name: str
    """`377` … `394` or `lan`, `marc`, `olek`, `vlad`."""
    dataset: str
    """`zju_mocap` or `monocap`."""
    folders: tuple[str, ...]
    """Names of the folder in the releases."""
    train_camera: int
    """Position of the camera that trains."""
    test_cameras: tuple[int, ...]
    """Positions of the cameras that are compared."""
    first_frame: int
    """Number of the first frame: the stem of its file, not its place in a list."""
    params: tuple[str, ...]
    """Folders of the body track, the first that exists is read; its vertices lie in the folder
    with `vertices` for `params` in its name."""
    test_scale: float
    """Size of the images that are compared, of the stored size."""
    train_scale: float = 0.5
    """Size of the images that train, of the stored size."""
    masks: tuple[str, ...] = ("schp", "mask_cihp", "mask")
    """Folders of masks; each picture takes the first that holds its mask."""
    resize_masks: bool = True
    """Masks of another size than their image are brought to its size by nearest neighbour."""


def _zju(number: int) -> Subject:
    return Subject(
        name=str(number),
        dataset="zju_mocap",
        folders=(f"my_{number}", f"CoreView_{number}"),
        train_camera=4,
        test_cameras=tuple(c for c in range(23) if c != 4),
        first_frame=0,
        params=("smpl_params", "new_params", "params"),
        test_scale=0.5,
    )


def _monocap(name: str, folder: str, train: int, test: tuple[int, ...], first: int) -> Subject:
    return Subject(
        name=name,
        dataset="monocap",
        folders=(folder, name),
        train_camera=train,
        test_cameras=test,
        first_frame=first,
        params=("params", "new_params", "smpl_params"),
        test_scale=1.0,
    )


SUBJECTS: dict[str, Subject] = {
    s.name: s
    for s in (
        *(_zju(number) for number in (377, 386, 387, 392, 393, 394)),
        _monocap("lan", "lan_images620_1300", 0, tuple(range(1, 11)), 0),
        _monocap("marc", "marc_images35000_36200", 0, tuple(range(1, 11)), 0),
        _monocap("olek", "olek_images0812", 44, (*range(0, 50, 5), 49), 1),
        _monocap("vlad", "vlad_images1011", 66, tuple(range(0, 101, 10)), 1),
    )
}
"""All subjects by name, in the order of the paper's tables."""


def subject(name: str) -> Subject:
    """A subject by its name or by the name of its folder in the releases.

    Args:
        name: such as `377`, `my_377` or `olek_images0812`; case does not matter.

    Returns:
        The subject.

    Raises:
        InputError: no such subject.

    >>> subject("my_377").train_camera, subject("Olek").first_frame
    (4, 1)
    """
    found = recognise(name)
    if found is None:
        raise InputError(
            f"subject: expected one of {', '.join(SUBJECTS)}, found {name!r}; name one of them, or "
            f"leave it out and describe the capture in splits.json"
        )
    return found


def recognise(folder: str) -> Subject | None:
    """The subject that a folder is named after.

    Args:
        folder: name of a folder, without its path.

    Returns:
        The subject; None where the name is not one of the releases'.

    >>> recognise("CoreView_392").name, recognise("actor_a")
    ('392', None)
    """
    plain = folder.lower()
    for each in SUBJECTS.values():
        if plain == each.name or plain in (name.lower() for name in each.folders):
            return each
    zju = re.fullmatch(r"zju[-_]?(?:mocap)?[-_]?(\d{3})", plain)
    return SUBJECTS.get(zju[1]) if zju else None
