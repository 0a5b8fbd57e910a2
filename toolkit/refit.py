"""Scores of a refined avatar in two columns that are never mixed: poses as given, and refit.

A frame that was trained on has its learned pose. Any other frame is fitted with the avatar held, to
the image of the training camera, which is not the image under test. Where that camera took none, or
is itself under test, the fit uses the test image, and a column of its own says so.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch

from monopart.geometry.body import BodyPose

from .avatar import Avatar
from .captures.records import CaptureRecord
from .corrections import PoseCorrections, frame_times
from .evaluate import Evaluation, evaluate_split
from .lpips import LPIPS
from .metrics import Scores, aggregate
from .pose_alignment import Shots, align_poses
from .refine import RefinedPoses, with_poses

Column = Literal["refit (learned)", "refit (training camera)", "refit (uses the test image)"]


@dataclass(frozen=True)
class RefitScores:
    """Scores of the same images at poses as given and at refit ones.

    Attributes:
        split: name of the split.
        column: what the poses were fitted to.
        images: number of images.
        given: mean scores at the poses of the capture.
        refit: mean scores at the fitted poses.
    """

    split: str
    column: Column
    images: int
    given: Scores
    refit: Scores


def fit_camera(record: CaptureRecord, camera: int, frame: int) -> int:
    """The camera whose image a frame is fitted to: the training camera where it took one.

    Args:
        record: the capture.
        camera: the camera under test.
        frame: the frame.
    """
    for trained in record.split("train").cameras:
        entry = record.frames.get((trained, frame))
        if entry is not None and entry.image_path.is_file() and entry.mask_path.is_file():
            return trained
    return camera


def column_of(avatar: Avatar, camera: int, frame: int) -> Column:
    """Which column an image belongs to.

    Args:
        avatar: the trained person.
        camera: the camera under test.
        frame: the frame.
    """
    if frame in avatar.memory.frames:
        return "refit (learned)"
    if fit_camera(avatar.record, camera, frame) == camera:
        return "refit (uses the test image)"
    return "refit (training camera)"


def refit_poses(
    avatar: Avatar,
    frames: tuple[int, ...],
    camera: int,
    progress: Callable[[int, int], None] | None = None,
) -> dict[int, BodyPose]:
    """Fit the poses of frames to the images of one camera; the avatar is held.

    Args:
        avatar: the trained person.
        frames: frames of the capture, ascending.
        camera: the camera.
        progress: called with (done, total) steps.

    Returns:
        Pose by frame.
    """
    record, spec = avatar.record, avatar.config.refine
    fix = PoseCorrections(len(frames), record.body.num_joints).to(avatar.device)
    fix.couple(frame_times(frames, record.fps), spec.drift, spec.jitter)
    refined = RefinedPoses(avatar, frames, fix)
    images = torch.stack([record.image(camera, f) for f in frames])
    shots = Shots(
        (images * 255.0).round().to(torch.uint8),
        torch.stack([record.mask(camera, f) for f in frames]),
        [record.cameras[camera]] * len(frames),
        range(len(frames)),
    )
    for step in range(spec.refit_steps):
        align_poses(refined, shots)
        if progress is not None:
            progress(step + 1, spec.refit_steps)
    return refined.corrected()


def refit_scores(
    avatar: Avatar,
    given: Evaluation,
    lpips: LPIPS | None,
    progress: Callable[[int, int], None] | None = None,
) -> list[RefitScores]:
    """Score the images of an evaluation again at refit poses.

    Args:
        avatar: the trained person with its learned poses.
        given: the evaluation at the poses as given.
        lpips: the perceptual metric, or None.
        progress: called with (done, total).

    Returns:
        One entry for each column that has images.
    """
    groups: dict[tuple[Column, int], list[tuple[int, int]]] = {}
    for image in given.images:
        pair = image.camera, image.frame
        column = column_of(avatar, *pair)
        source = -1 if column == "refit (learned)" else fit_camera(avatar.record, *pair)
        groups.setdefault((column, source), []).append(pair)
    before = {(i.camera, i.frame): i.scores for i in given.images}
    found: dict[Column, list[tuple[Scores, Scores]]] = {}
    done = 0
    fitted: dict[tuple[int, tuple[int, ...]], dict[int, BodyPose]] = {}
    for (column, source), pairs in groups.items():
        frames, person = tuple(sorted({f for _, f in pairs})), avatar
        if source >= 0:
            if (source, frames) not in fitted:
                fitted[source, frames] = refit_poses(avatar, frames, source)
            person = with_poses(avatar, fitted[source, frames])
        scores = evaluate_split(person, given.split, lpips, pairs).images
        after = [(before[i.camera, i.frame], i.scores) for i in scores]
        found.setdefault(column, []).extend(after)
        done += len(pairs)
        if progress is not None:
            progress(done, len(given.images))
    return [
        RefitScores(
            given.split,
            column,
            len(both),
            aggregate([b for b, _ in both]),
            aggregate([a for _, a in both]),
        )
        for column, both in found.items()
    ]


def refit_table(rows: Sequence[RefitScores]) -> str:
    """Text: a line for each split and column, the scores as given beside the refit ones.

    Args:
        rows: the scores.
    """
    lines = []
    for row in rows:
        for region, given in row.given.items():
            lines.append(
                f"{row.split} {region}: as given {_cell(given)} | {row.column} "
                f"{_cell(row.refit[region])} ({row.images} images)"
            )
    return "\n".join(lines)


def _cell(scores: dict[str, float | None]) -> str:
    shown = []
    for name, digits, unit in (("psnr", 2, " dB"), ("ssim", 4, ""), ("lpips", 4, "")):
        value = scores[name]
        shown.append("-" if value is None else f"{value:.{digits}f}{unit}")
    return " / ".join(shown)
