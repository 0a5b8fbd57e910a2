"""Scores of an avatar on the held-out splits of its capture (METHOD section 11)."""

import csv
import io
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from .avatar import Avatar, view_of
from .captures.subjects import ON_TRAINING_CAMERA
from .lpips import LPIPS
from .metrics import Scores, aggregate, score_image
from .render import render_view

SPLITS = ("novel_view", "novel_pose", ON_TRAINING_CAMERA)


@dataclass(frozen=True)
class ImageScore:
    """One evaluated image.

    Attributes:
        camera: camera index.
        frame: frame number.
        scores: region to metric to value.
        seconds: wall-clock seconds of the rendering.
        rendered: [H, W, 3] uint8 picture.
    """

    camera: int
    frame: int
    scores: Scores
    seconds: float
    rendered: Tensor


@dataclass(frozen=True)
class Evaluation:
    """Scores of one split.

    Attributes:
        split: name of the split.
        protocol: name of the protocol.
        mean: region to metric to mean over images.
        images: every image in the order of the split.
        stats: summed counts of rays, samples and pairs.
    """

    split: str
    protocol: str
    mean: Scores
    images: list[ImageScore]
    stats: dict[str, int] = field(default_factory=dict)

    @property
    def seconds_per_frame(self) -> float:
        """Median wall-clock seconds of a rendering."""
        return float(torch.tensor([i.seconds for i in self.images]).median())


def evaluate_split(
    avatar: Avatar,
    split: str,
    lpips: LPIPS | None,
    pairs: list[tuple[int, int]] | None = None,
    progress: Callable[[int, int], None] | None = None,
    prune: float = 0.0,
) -> Evaluation:
    """Render and score the images of a split, ``strict`` protocol: masked image over black.

    Args:
        avatar: the trained person.
        split: name of a split of the capture.
        lpips: the perceptual metric, or None for no such figures.
        pairs: (camera, frame) to use instead of all of the split.
        progress: called with (done, total).
        prune: see :func:`monopart.toolkit.render.render_view`; 0 is exact.
    """
    record = avatar.record
    pairs = record.split(split).pairs() if pairs is None else pairs
    images: list[ImageScore] = []
    stats: Counter[str] = Counter()
    for camera, frame in pairs:
        start = time.perf_counter()
        picture = render_view(avatar, view_of(record, camera, frame), prune=prune)
        seconds = time.perf_counter() - start
        stats.update(picture.stats)
        # What is scored is what is saved: eight bits a channel.
        rendered = (picture.color * 255.0).round().to(torch.uint8).cpu()
        truth, mask = record.masked_image(camera, frame), record.mask(camera, frame)
        scores = score_image(rendered.float() / 255.0, truth, mask, "strict", lpips)
        images.append(ImageScore(camera, frame, scores, seconds, rendered))
        if progress is not None:
            progress(len(images), len(pairs))
    mean = aggregate([i.scores for i in images])
    return Evaluation(split, "strict", mean, images, dict(stats))


def images_csv(evaluation: Evaluation, camera_names: Sequence[str]) -> str:
    """One line per image: camera, frame, each metric of each region, seconds of the rendering.

    Args:
        evaluation: scores of a split.
        camera_names: name of each camera of the capture.
    """
    columns = [(r, m) for r, scores in evaluation.mean.items() for m in scores]
    file = io.StringIO()
    table = csv.writer(file, lineterminator="\n")
    table.writerow(["camera", "frame", *(f"{r}_{m}" for r, m in columns), "seconds"])
    for image in evaluation.images:
        values = (image.scores[r][m] for r, m in columns)
        cells = ["" if v is None else f"{v:.6g}" for v in values]
        table.writerow([camera_names[image.camera], image.frame, *cells, f"{image.seconds:.3f}"])
    return file.getvalue()
