"""Doubts about training pictures that can be read and yet spoil an avatar: one sentence each."""

import math

import torch
from torch import Tensor

from monopart.geometry.rotations import axis_angle_to_rotmat, rotation_angle

from .cache import Pictures
from .checks import share_on_mask
from .records import CaptureRecord

DARK, BRIGHT = 4.0, 251.0
"""Mean of 0..255 over the person below and above which a picture shows nothing."""
ON_MASK, IN_BOX = 0.8, 0.7
"""Share of the body's vertices on the mask, and of the mask in the body's box, of a sound track."""
SPARSE = 4  # every fourth pixel and line says how bright a picture is
LOOKED_AT = 8  # frames whose body is compared with the mask
TURNED = 60.0
"""Degrees between two headings from which on they show where light comes from."""
MARGIN = 0.12  # of the longer side of the body's box, for hair and clothes


def picture_doubts(record: CaptureRecord, pictures: Pictures, patch: int) -> list[str]:
    """What looks wrong in training pictures.

    Args:
        record: the capture.
        pictures: its training pictures, in the order of `Split.pairs`.
        patch: edge of the training patches, pixels.

    Returns:
        One sentence for each doubt, empty where there is none.
    """
    pairs = record.split("train").pairs()
    count, found = len(pairs), []
    frames = len(record.split("train").frames)
    if frames == 1:
        found.append("There is one training frame: poses, and what it does not show, are guesses.")
    means = _means(pictures)
    for name, bad in (("black", means < DARK), ("white", means > BRIGHT)):
        if bool(bad.any()):
            found.append(
                f"The person is {name} in {int(bad.sum())} of {count} training images (first: "
                f"{_named(record, pairs[int(bad.nonzero()[0, 0])])}); are these the right images "
                "and masks?"
            )
    found += _twins(record, pictures, pairs)
    found += _off_body(record, pictures, pairs)
    height, width = record.image_size
    if patch > min(height, width):
        found.append(
            f"train.patch is {patch} pixels, the images are {width} by {height}: patches are cut."
        )
    return found


def heading_doubts(record: CaptureRecord) -> list[str]:
    """Whether the person turns so little that light cannot be told from colour.

    Args:
        record: the capture.

    Returns:
        One sentence, or none where the headings of the training frames differ enough.
    """
    turns = torch.stack([record.poses[f].rotation for f in record.split("train").frames])
    rotmats = axis_angle_to_rotmat(turns)
    angles = rotation_angle(*torch.broadcast_tensors(rotmats[:, None], rotmats[None]))
    widest = math.degrees(float(angles.max()))
    if widest >= TURNED:
        return []
    return [
        f"The person turns by {widest:.0f} degrees in the training frames, which hardly tells "
        "light from colour: at other headings colours may be wrong; "
        "--set appearance.light=false leaves the light out."
    ]


def _named(record: CaptureRecord, pair: tuple[int, int]) -> str:
    return f"camera {record.camera_names[pair[0]]}, frame {pair[1]}"


def _means(pictures: Pictures) -> Tensor:
    """Mean of each picture over its mask, 0..255; the middle where the mask is empty."""
    masks = pictures.masks[:, ::SPARSE, ::SPARSE, None]
    total = (pictures.images[:, ::SPARSE, ::SPARSE].float() * masks).sum((1, 2, 3))
    count = masks.sum((1, 2, 3))
    return torch.where(count > 0, total / (3 * count.clamp(min=1)), 127.0)


def _twins(record: CaptureRecord, pictures: Pictures, pairs: list[tuple[int, int]]) -> list[str]:
    """Pictures that are the same though the poses of their frames are not."""
    some = pictures.images[:, ::SPARSE, ::SPARSE]
    sums = some.sum((1, 2, 3), dtype=torch.int64).tolist()
    first: dict[int, int] = {}
    for row, key in enumerate(sums):
        other = first.setdefault(key, row)
        if other == row or not torch.equal(pictures.images[row], pictures.images[other]):
            continue
        a, b = record.poses[pairs[row][1]], record.poses[pairs[other][1]]
        if not torch.equal(a.pose, b.pose) or not torch.equal(a.translation, b.translation):
            return [
                f"{_named(record, pairs[other])} and {_named(record, pairs[row])} are the same "
                "picture though their poses differ: are the frames numbered as the poses?"
            ]
    return []


def _off_body(record: CaptureRecord, pictures: Pictures, pairs: list[tuple[int, int]]) -> list[str]:
    """Bodies that lie off their masks, and masks that show more than a body."""
    on, within = [], []
    for row in range(0, len(pairs), max(1, len(pairs) // LOOKED_AT)):
        mask = pictures.masks[row]
        share, pixels = share_on_mask(record, pairs[row], mask)
        on.append(share)
        if not len(pixels) or not bool(mask.any()):
            continue
        low, high = pixels.amin(0), pixels.amax(0)
        border = MARGIN * float((high - low).amax())
        place = mask.nonzero().flip(-1) + 0.5
        inside = ((place > low - border) & (place < high + border)).all(-1)
        within.append(float(inside.float().mean()))
    found = []
    if sum(on) < ON_MASK * len(on):
        found.append(
            f"Only {100 * sum(on) / len(on):.0f} % of the body lies on the masks, where a sound "
            "track has 90 % and more: poses, cameras or masks are off."
        )
    if within and sum(within) < IN_BOX * len(within):
        found.append(
            f"Only {100 * sum(within) / len(within):.0f} % of the masks lies around the body: are "
            "they inverted, or is somebody else in the picture?"
        )
    return found
