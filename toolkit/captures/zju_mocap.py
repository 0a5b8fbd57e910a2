"""Reader of the ZJU-MoCap folder layout: `annots.npy`, images, masks, body parameters."""

import os
from pathlib import Path

from monopart.geometry.errors import InputError

from .annots import camera_names_of, cameras_of, pictures_of, read_annots
from .frames import Frame, Split
from .images import describe_size, read_image
from .reading import Reading
from .records import CaptureRecord
from .scaling import camera_at, scaled_size
from .splits import Pictures, read_splits, subject_splits
from .subjects import Subject
from .tracks import check_vertices, read_body, read_poses, track_folder, vertex_paths_of

MASKS = ("mask", "mask_cihp", "schp")


def read_zju_mocap(path: str | Path, reading: Reading | None = None) -> CaptureRecord:
    """Read a capture in the layout of ZJU-MoCap; images and masks are read later, on demand.

    Intrinsics in `annots.npy` put pixel centres at whole numbers and lengths in millimetres: half a
    pixel is added to cx and cy, and T is divided by 1000. The stem of an image file numbers its
    frame. The first three angles of `poses` are the local rotation of the root joint, before Rh.

    A subject of ZJU-MoCap or MonoCap brings its own splits, folders and scales (`subjects`). For
    another capture they are in `splits.json`; where that is missing too, training is with camera 4
    (camera 0 where there are fewer) on every fifth of the first 500 frames, `novel_view` on the
    other cameras at every sixth training frame, `novel_pose` on them at every fifth later frame.

    Args:
        path: folder of the capture.
        reading: how; each choice that is left out is the subject's, else the first of `new_params`,
            `params`, `smpl_params`; `body.npz` in the capture, else the body that ships with the
            package; images of the stored size.

    Returns:
        The record at the size for training (`for_test` gives the other); of every split all image
        and mask files are known to exist.

    Raises:
        InputError: anything missing, damaged or contradictory, in one line that names the file.
    """
    root = Path(path)
    reading = (reading or Reading()).resolved(root)
    person = reading.known_subject(root)
    annots = root / "annots.npy"
    cams, ims = read_annots(annots)
    pictures = pictures_of(annots, ims, len(cams["K"]))
    model = read_body(root, reading.body)
    track = track_folder(root, reading.params, person)
    poses = read_poses(track, sorted({frame for _, frame in pictures}), model)
    fps = stored_size = None
    if person is None:
        splits, fps, stored_size = read_splits(root, pictures, set(poses))
    else:
        splits = subject_splits(root, person, pictures, set(poses))
    frames = _frames(root, pictures, splits, person)
    size = _image_size(frames, splits["train"], root, stored_size)
    raw = cameras_of(annots, cams, size)
    scale, test_scale = _scales(reading, person)
    legacy = bool(reading.legacy_pixels)
    record = CaptureRecord(
        root=root,
        name=root.resolve().name,
        cameras=[camera_at(camera, scale, legacy) for camera in raw],
        camera_names=camera_names_of(pictures, len(raw)),
        poses=poses,
        body=model,
        splits=splits,
        fps=fps,
        image_size=scaled_size(size, scale, legacy),
        frames=frames,
        raw_cameras=raw,
        params=track.name,
        vertex_paths=vertex_paths_of(root, track.name, poses),
        scale=scale,
        test_scale=test_scale,
        legacy_pixels=legacy,
        resize_masks=person is not None and person.resize_masks,
        subject=None if person is None else person.name,
        body_path=None if reading.body is None else Path(reading.body),
    )
    check_vertices(record)
    return record


def _scales(reading: Reading, person: Subject | None) -> tuple[float, float]:
    """Sizes for training and comparison, of the stored size."""
    own = (1.0, 1.0) if person is None else (person.train_scale, person.test_scale)
    asked = (reading.scale, reading.test_scale)
    train, test = (o if a is None else float(a) for a, o in zip(asked, own, strict=True))
    return train, test


def _frames(
    root: Path, pictures: Pictures, splits: dict[str, Split], person: Subject | None
) -> dict[tuple[int, int], Frame]:
    """Files of every picture; those that a split names must exist."""
    order = MASKS if person is None else person.masks
    folders = [root / name for name in order if (root / name).is_dir()]
    if person is None:  # only of the subjects is it known that their kinds of masks may be mixed
        folders = folders[:1]
    if not folders:
        raise InputError(
            f"{root}: expected masks in {', '.join(order)}, found no such folder; add the masks"
        )
    if "train" not in splits:
        raise InputError(
            f"{root}: expected images with body parameters to train on, found none; add the "
            f"parameters, named by frame number"
        )
    used = {pair: name for name, split in splits.items() for pair in split.pairs()}
    frames, masks = {}, _Masks(folders)
    for pair, name in pictures.items():
        frames[pair] = Frame(pair[1], pair[0], root / name, masks.path(Path(name)))
        if pair in used:
            _check_exists(frames[pair], used[pair])
    return frames


class _Masks:
    """Finds masks; looks into each folder once."""

    def __init__(self, folders: list[Path]) -> None:
        self.folders = folders
        self.places: dict[Path, list[tuple[Path, frozenset[str]]]] = {}

    def path(self, image: Path) -> Path:
        """The first mask of an image that exists; where there is none, one that could.

        Args:
            image: relative path of the image.
        """
        name, places = f"{image.stem}.png", self._places(image.parent)
        found = next((place / name for place, names in places if name in names), None)
        return self.folders[0] / _beside(image.parent)[-1] / name if found is None else found

    def _places(self, parent: Path) -> list[tuple[Path, frozenset[str]]]:
        if parent not in self.places:
            folders = [f / place for f in self.folders for place in _beside(parent)]
            listed = [(f, frozenset(os.listdir(f) if f.is_dir() else ())) for f in folders]
            self.places[parent] = listed
        return self.places[parent]


def _beside(parent: Path) -> list[Path]:
    """Folders of a mask, seen from that of its image: with and without a leading `images`."""
    return [parent, Path(*parent.parts[1:])] if parent.parts[:1] == ("images",) else [parent]


def _check_exists(frame: Frame, split: str) -> None:
    """Refuses a picture whose files are not there."""
    for kind, path in (("image", frame.image_path), ("mask", frame.mask_path)):
        if not path.is_file():
            raise InputError(
                f"{path}: expected the {kind} of camera {frame.camera}, frame {frame.index} "
                f"({split}), found no file; add it or take it out of splits.json"
            )


def _image_size(
    frames: dict[tuple[int, int], Frame], train: Split, root: Path, stored: tuple[int, ...] | None
) -> tuple[int, int]:
    """(height, width) of the first training image; what `splits.json` states must agree."""
    first = frames[train.pairs()[0]].image_path
    height, width = read_image(first).shape[:2]
    if stored is not None and sorted(stored) != sorted((height, width)):
        raise InputError(
            f"{root / 'splits.json'}: expected image_size as the images have it "
            f"({describe_size((height, width))}, {first.name}), found {list(stored)}; correct it, "
            f"and K with it, to the stored images"
        )
    return height, width
