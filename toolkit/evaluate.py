"""Scores of an avatar on the held-out splits of its capture (METHOD section 11)."""

import csv
import io
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from .avatar import Avatar, View, view_of
from .captures.depth import true_depth
from .lpips import LPIPS
from .metrics import SHAPE, Protocol, Scores, aggregate, score_image
from .protocols import SPLITS, body_box_mask, held_out_pairs, shape_scores
from .render import render_view

__all__ = ["SHAPE", "SPLITS", "Evaluation", "ImageScore", "evaluate_split", "images_csv"]


@dataclass(frozen=True)
class ImageScore:
    """One evaluated image.

    Attributes:
        camera: camera index.
        frame: frame number.
        scores: region to metric to value, protocol ``strict``.
        seconds: wall-clock seconds of the rendering.
        rendered: [H, W, 3] uint8 picture.
        others: the same of other protocols, by name.
        shape: silhouette and depth, see :func:`monopart.toolkit.protocols.shape_scores`.
    """

    camera: int
    frame: int
    scores: Scores
    seconds: float
    rendered: Tensor
    others: Mapping[str, Scores] = field(default_factory=dict)
    shape: Mapping[str, float | None] = field(default_factory=dict)

    def by_protocol(self, protocol: str) -> Scores:
        """All scores: region to metric to value, of a protocol, or of the shape."""
        if protocol == SHAPE:
            return {"full": dict(self.shape)}
        return self.scores if protocol not in self.others else self.others[protocol]


@dataclass(frozen=True)
class Evaluation:
    """Scores of one split.

    Attributes:
        split: name of the split.
        protocol: name of the protocol.
        mean: region to metric to mean over images, of that protocol.
        images: every image in the order of the split.
        stats: summed counts of rays, samples and pairs.
        others: means under other protocols, by name; silhouette and depth under `SHAPE`.
    """

    split: str
    protocol: str
    mean: Scores
    images: list[ImageScore]
    stats: dict[str, int] = field(default_factory=dict)
    others: Mapping[str, Scores] = field(default_factory=dict)

    @property
    def means(self) -> dict[str, Scores]:
        """Protocol to region to metric to mean; the shape is one of them."""
        return {self.protocol: self.mean, **self.others}

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
    protocols: Sequence[Protocol] = ("strict",),
) -> Evaluation:
    """Render and score the images of a split: masked image over black.

    Args:
        avatar: the trained person.
        split: name of a held-out split, or of another split of the capture.
        lpips: the perceptual metric, or None for no such figures.
        pairs: (camera, frame) to use instead of all of the split.
        progress: called with (done, total).
        prune: see :func:`monopart.toolkit.render.render_view`; 0 is exact.
        protocols: names of protocols; ``strict`` is always there.

    Raises:
        InputError: no such split, or an image that cannot be read or scored.
    """
    record = avatar.record
    if pairs is None:
        pairs = held_out_pairs(record).get(split) or record.split(split).pairs()
    images: list[ImageScore] = []
    stats: Counter[str] = Counter()
    for camera, frame in pairs:
        view = view_of(record, camera, frame)
        start = time.perf_counter()
        picture = render_view(avatar, view, prune=prune)
        seconds = time.perf_counter() - start
        stats.update(picture.stats)
        # What is scored is what is saved: eight bits a channel.
        rendered = (picture.color * 255.0).round().to(torch.uint8).cpu()
        scores = _scores(avatar, view, (camera, frame), rendered, lpips, protocols)
        shape = shape_scores(
            picture, record.mask(camera, frame), view.camera, true_depth(record, camera, frame)
        )
        strict = scores.pop("strict")
        images.append(ImageScore(camera, frame, strict, seconds, rendered, scores, shape))
        if progress is not None:
            progress(len(images), len(pairs))
    mean = aggregate([i.scores for i in images])
    others = {
        name: aggregate([i.by_protocol(name) for i in images])
        for name in (*images[0].others, SHAPE)
    }
    return Evaluation(split, "strict", mean, images, dict(stats), others)


def _scores(
    avatar: Avatar,
    view: View,
    pair: tuple[int, int],
    rendered: Tensor,
    lpips: LPIPS | None,
    protocols: Sequence[Protocol],
) -> dict[str, Scores]:
    """Protocol to scores of one picture."""
    record = avatar.record
    pred, truth, mask = rendered.float() / 255.0, record.masked_image(*pair), record.mask(*pair)
    box = None
    if "boxed" in protocols:
        box = body_box_mask(record.body, view.pose, view.camera).cpu()
    names: list[Protocol] = ["strict", *(p for p in protocols if p != "strict")]
    return {name: score_image(pred, truth, mask, name, lpips, box) for name in names}


def images_csv(evaluation: Evaluation, camera_names: Sequence[str]) -> str:
    """One line per image: camera, frame, metrics named protocol_region_metric, seconds.

    Args:
        evaluation: scores of a split.
        camera_names: name of each camera of the capture.
    """
    columns = [
        (protocol, region, metric)
        for protocol, regions in evaluation.means.items()
        for region, scores in regions.items()
        for metric in scores
    ]
    file = io.StringIO()
    table = csv.writer(file, lineterminator="\n")
    table.writerow(["camera", "frame", *("_".join(c) for c in columns), "seconds"])
    for image in evaluation.images:
        values = (image.by_protocol(p)[r][m] for p, r, m in columns)
        cells = ["" if v is None else f"{v:.6g}" for v in values]
        table.writerow([camera_names[image.camera], image.frame, *cells, f"{image.seconds:.3f}"])
    return file.getvalue()
