"""The worst frames of a split, side by side with the truth; scores of its shape."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from .captures.records import CaptureRecord
from .evaluate import Evaluation
from .metrics import SHAPE
from .report_data import Number, WorstFrame
from .report_images import content_box, error_map, picture, shown
from .report_sections import escape, section, table, words

WORST = 10
"""Frames of a split that are shown."""
HEIGHT = 240  # pixels of a row of three pictures
_COLUMNS = {
    "mask_iou": ("IoU with the mask ↑", 4),
    "depth_mm": ("Depth error, mean, mm ↓", 1),
    "depth_median_mm": ("median, mm ↓", 1),
}


def worst_frames(
    record: CaptureRecord, evaluation: Evaluation, count: int = WORST
) -> list[WorstFrame]:
    """The images of a split with the lowest PSNR, the worst first.

    Args:
        record: the capture, for the photographs.
        evaluation: scores and pictures of the split.
        count: images at most.
    """

    def level(score: float | None) -> float:
        return -math.inf if score is None else score

    ranked = sorted(evaluation.images, key=lambda i: level(i.scores["full"]["psnr"]))
    return [
        WorstFrame(
            f"{record.camera_names[i.camera]}, frame {i.frame}",
            evaluation.split,
            side_by_side(i.rendered.numpy(), record.masked_image(i.camera, i.frame).numpy()),
            i.scores["full"],
        )
        for i in ranked[:count]
    ]


def side_by_side(rendered: Any, truth: Any, height: int = HEIGHT) -> UInt8[np.ndarray, "h w 3"]:
    """Rendered, truth and their difference (×4), cut to the person, in a row.

    Args:
        rendered: height width 3.
        truth: the same size.
        height: of the row, pixels.

    Raises:
        InputError: the sizes differ.

    >>> side_by_side(np.zeros((40, 20, 3)), np.zeros((40, 20, 3)), 80).shape
    (80, 120, 3)
    """
    top, bottom, left, right = content_box([rendered, truth])
    three = (shown(rendered), shown(truth), error_map(rendered, truth))
    row = np.concatenate([i[top:bottom, left:right] for i in three], 1)
    width = max(3, round(row.shape[1] * height / row.shape[0]))
    return np.asarray(cv2.resize(row, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def contact_sheet(frames: Sequence[WorstFrame]) -> UInt8[np.ndarray, "h w 3"]:
    """Worst frames below each other in two columns, each under a line of text.

    Args:
        frames: at least one.

    Returns:
        One picture, RGB.
    """
    width = max(f.image.shape[1] for f in frames) + 8
    tiles = []
    for frame in frames:
        tile = np.zeros((frame.image.shape[0] + 24, width, 3), np.uint8)
        tile[24:, : frame.image.shape[1]] = shown(frame.image)
        text = f"{frame.label}  {_psnr(frame.scores)}"
        font = cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(tile, text, (4, 16), font, 0.42, (255, 255, 255), 1, cv2.LINE_AA)
        tiles.append(tile)
    if len(tiles) % 2:
        tiles.append(np.zeros_like(tiles[0]))
    rows = [np.concatenate(tiles[i : i + 2], 1) for i in range(0, len(tiles), 2)]
    return np.concatenate(rows, 0)


def _psnr(scores: Mapping[str, Number | None]) -> str:
    value = scores.get("psnr")
    return "PSNR not defined" if value is None else f"{value:.2f} dB"


def worst_section(frames: Sequence[WorstFrame]) -> str:
    """The worst frames of every split, the worst first; nothing where none is given.

    Args:
        frames: of all splits.
    """
    if not frames:
        return ""
    body = ""
    for split in dict.fromkeys(f.split for f in frames):
        body += f'<h3 class="sub">{escape(words(split))}</h3><div class="worst">'
        for frame in (f for f in frames if f.split == split):
            made = picture(shown(frame.image))
            text = f"{frame.label}: {_psnr(frame.scores)}"
            body += (
                f'<figure><img src="{made.uri}" width="{made.size[1]}" height="{made.size[0]}" '
                f'alt="{escape(text)}" style="height:auto;max-width:100%">'
                f"<figcaption>{escape(text)}</figcaption></figure>"
            )
        body += "</div>"
    lead = (
        f"The {WORST} images of each split with the lowest PSNR (full image, strict), the worst "
        "first: rendered, ground truth, difference ×4."
    )
    return section("worst", "Worst frames", lead, body)


def shape_section(metrics: Mapping[str, Mapping[str, Any]]) -> str:
    """Silhouette and depth of every split, nothing where they were not measured.

    Args:
        metrics: of metrics.json.
    """
    rows: list[str] = []
    columns: dict[str, None] = {}
    for protocols in metrics.values():
        for name, value in protocols.get(SHAPE, {}).get("full", {}).items():
            if value is not None and name in _COLUMNS:
                columns[name] = None
    for split, protocols in metrics.items():
        scores = protocols.get(SHAPE, {}).get("full", {})
        if any(scores.get(name) is not None for name in columns):
            cells = "".join(_cell(scores.get(name), _COLUMNS[name][1]) for name in columns)
            rows.append(f'<tr><td class="name">{escape(words(split))}</td>{cells}</tr>')
    if not rows:
        return ""
    head = [("Split", False), *((_COLUMNS[name][0], True) for name in columns)]
    lead = (
        "Silhouette: pixels of opacity above one half against the mask. Depth: expected depth "
        "against the true one along the optical axis, where both are solid; only for captures that "
        "carry depth maps."
    )
    return section("shape", "Shape", lead, table(head, rows))


def _cell(value: float | None, digits: int) -> str:
    if value is None:
        return '<td class="n none">not known</td>'
    return f'<td class="n">{value:.{digits}f}</td>'
