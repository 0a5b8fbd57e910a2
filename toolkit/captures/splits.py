"""Which cameras and frames train and test: `splits.json`, or the data set's own choice."""

import json
from pathlib import Path

from monopart.geometry.errors import InputError

from .frames import Split
from .subjects import (
    FRAME_STEP,
    NOVEL_POSE_FRAMES,
    NOVEL_VIEW_STEP,
    ON_TRAINING_CAMERA,
    TRAIN_FRAMES,
    Subject,
)

TRAIN_CAMERA = 4
"""The data set's own choice for monocular training."""
FALLBACK_CAMERA = 0
"""Training camera of a capture with fewer cameras."""
STEP, TRAIN_SPAN = FRAME_STEP, FRAME_STEP * TRAIN_FRAMES

Pictures = dict[tuple[int, int], str]
"""Path of the image of each (camera, frame), relative to the capture."""


def read_splits(
    root: Path, pictures: Pictures, posed: set[int]
) -> tuple[dict[str, Split], float | None, tuple[int, ...] | None]:
    """Splits of a capture, and what else `splits.json` states.

    Args:
        root: folder of the capture.
        pictures: relative path of the image of each (camera, frame).
        posed: frames that have a body pose.

    Returns:
        Splits by name; frames per second, if stated; image size, if stated, in either order.

    Raises:
        InputError: a damaged file, no training split, an unknown camera or frame.
    """
    path = root / "splits.json"
    if not path.is_file():
        return _default_splits(pictures, posed), None, None
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        splits = {
            str(name): Split(tuple(map(int, s["cameras"])), tuple(map(int, s["frames"])))
            for name, s in stored.items()
            if isinstance(s, dict) and {"cameras", "frames"} <= set(s)
        }
        fps = float(stored["fps"]) if "fps" in stored else None
        size = tuple(map(int, stored["image_size"])) if "image_size" in stored else None
    except (ValueError, TypeError, AttributeError, OSError) as error:
        raise InputError(
            f"{path}: expected splits with lists of cameras and frames, found "
            f"{' '.join(str(error).split())}; correct the file"
        ) from error
    if not splits.get("train", Split((), ())).pairs():
        raise InputError(f"{path}: expected a split 'train' with images, found none; add it")
    for name, split in splits.items():
        _check_split(path, name, split, pictures, posed)
    return splits, fps, size


def _check_split(path: Path, name: str, split: Split, pictures: Pictures, posed: set[int]) -> None:
    """Refuses a split with a camera or frame that the capture does not list."""
    cameras, frames = {c for c, _ in pictures}, {f for _, f in pictures}
    for kind, wanted, known in (
        ("camera", split.cameras, cameras),
        ("frame", split.frames, frames),
    ):
        unknown = sorted(set(wanted) - known)
        if unknown:
            raise InputError(
                f"{path}: expected a {kind} from {min(known)} to {max(known)} in {name!r}, found "
                f"{unknown[0]}; take it out, or add it to annots.npy"
            )
    for pair in split.pairs():
        if pair not in pictures:
            raise InputError(
                f"{path}: expected an image of camera {pair[0]} at frame {pair[1]} in "
                f"annots.npy ({name!r} needs it), found none; take it out of the split"
            )
    without = sorted(set(split.frames) - posed)
    if without:
        raise InputError(
            f"{path}: expected body parameters for frame {without[0]} of {name!r}, found no file; "
            f"add {without[0]}.npy or take the frame out"
        )


def _default_splits(pictures: Pictures, posed: set[int]) -> dict[str, Split]:
    """The data set's own splits, of what the capture has; empty ones are left out."""
    numbers = sorted({f for _, f in pictures} & posed)
    cameras = sorted({c for c, _ in pictures})
    chosen = TRAIN_CAMERA if TRAIN_CAMERA in cameras else FALLBACK_CAMERA
    # counted from the first frame: two subjects of the kindred MonoCap set start at 1
    every = [n for n in numbers if (n - numbers[0]) % STEP == 0]
    train = tuple(n for n in every if n - numbers[0] < TRAIN_SPAN and (chosen, n) in pictures)
    later = tuple(n for n in every if n - numbers[0] >= TRAIN_SPAN)
    others = tuple(c for c in cameras if c != chosen)
    splits = {
        "train": Split((chosen,), train),
        "novel_view": Split(others, train[::NOVEL_VIEW_STEP]),
        "novel_pose": Split(others, later),
    }
    return {name: split for name, split in splits.items() if split.pairs()}


def subject_splits(
    root: Path, person: Subject, pictures: Pictures, posed: set[int]
) -> dict[str, Split]:
    """The splits of a subject of the public data sets, complete or refused.

    Args:
        root: folder of the capture.
        person: the subject.
        pictures: relative path of the image of each (camera, frame).
        posed: frames that have a body pose.

    Returns:
        `train`, `novel_view` and, where the capture goes on after the training frames, `novel_pose`
        (held-out cameras) and `novel_pose_training_camera`.

    Raises:
        InputError: a camera, frame or body pose of the protocol is missing.
    """
    numbers = {f for _, f in pictures}
    first = min(numbers)
    if first not in (0, 1):  # the releases count from one of the two
        raise _incomplete(root, person, f"frames from {person.first_frame}", f"frame {first} first")
    train = tuple(range(first, first + STEP * TRAIN_FRAMES, STEP))
    after = first + STEP * TRAIN_FRAMES
    later = tuple(range(after, max(numbers) + 1, STEP))[:NOVEL_POSE_FRAMES]
    chosen, others = (person.train_camera,), person.test_cameras
    splits = {
        "train": Split(chosen, train),
        "novel_view": Split(others, train[::NOVEL_VIEW_STEP]),
        "novel_pose": Split(others, later),
        ON_TRAINING_CAMERA: Split(chosen, later),
    }
    cameras = {c for c, _ in pictures}
    for name, split in splits.items():
        for camera in split.cameras:
            if camera not in cameras:
                found = f"cameras 0 to {max(cameras)}"
                raise _incomplete(root, person, f"camera {camera} ({name})", found)
        for frame in split.frames:
            if frame not in posed and frame in numbers:
                raise _incomplete(root, person, f"body parameters {frame}.npy ({name})", "no file")
        for camera, frame in split.pairs():
            if (camera, frame) not in pictures:
                wanted = f"camera {camera} at frame {frame} in annots.npy ({name})"
                raise _incomplete(root, person, wanted, "none")
    return {name: split for name, split in splits.items() if split.pairs()}


def _incomplete(root: Path, person: Subject, wanted: str, found: str) -> InputError:
    return InputError(
        f"{root}: expected {wanted} of subject {person.name}, found {found}; restore the data set, "
        f"or describe what there is in splits.json"
    )
