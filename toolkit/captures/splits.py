"""Which cameras and frames train and test: `splits.json`, or the data set's own choice."""

import json
from pathlib import Path

from monopart.geometry.errors import InputError

from .records import Split

TRAIN_CAMERA = 4
"""The data set's own choice for monocular training."""
FALLBACK_CAMERA = 0
"""Training camera of a capture with fewer cameras."""
STEP, TRAIN_SPAN, NOVEL_VIEW_STEP = 5, 500, 6  # frames; frames; training frames

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
