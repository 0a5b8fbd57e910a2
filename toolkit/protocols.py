"""What is compared, and where: the held-out splits, and the box of the body in an image.

| split | frames | cameras |
|---|---|---|
| `novel_view` | of the training | that did not train |
| `novel_pose` | after the training | that did not train |
| `novel_pose_training_camera` | after the training | that trained: the authors' habit |
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.boxes import box_of, ray_box
from monopart.geometry.cameras import Camera
from monopart.geometry.errors import InputError

from .captures.records import CaptureRecord
from .render import Picture

SPLITS = ("novel_view", "novel_pose", "novel_pose_training_camera")
"""The held-out splits, in the order of the tables; a capture may lack some of them."""
BOX_MARGIN = 0.05
"""Margin of the body's box under protocol `boxed`, metres."""
SOLID = 0.5
"""Opacity from which a pixel counts as the person."""

Pairs = list[tuple[int, int]]
"""(camera, frame) of images."""


def held_out_pairs(record: CaptureRecord) -> dict[str, Pairs]:
    """The images of each held-out split of a capture; splits without images are absent.

    The split `novel_pose` of a capture is taken apart by its cameras: scores of the camera that
    trained are easier, and are never averaged with the others.

    Args:
        record: the capture.

    Returns:
        Name of the split to its images, in the order of the capture.

    Raises:
        InputError: an image of the training in a split.
    """
    own = {name: record.splits[name].pairs() if name in record.splits else [] for name in SPLITS}
    trained = record.split("train").cameras
    view, pose, habit = SPLITS
    pairs = {
        view: own[view],
        pose: [p for p in own[pose] if p[0] not in trained],
        habit: [p for p in own[pose] if p[0] in trained] + own[habit],
    }
    pairs = {name: list(dict.fromkeys(images)) for name, images in pairs.items() if images}
    seen = set(record.split("train").pairs())
    for name, images in pairs.items():
        for camera, frame in images:
            if (camera, frame) in seen:
                raise InputError(
                    f"{record.root}: expected held-out images in {name!r}, found camera {camera} "
                    f"at frame {frame}, which trains; take it out of one of the splits"
                )
    return pairs


def body_box_mask(body: BodyModel, pose: BodyPose, camera: Camera) -> Bool[Tensor, "h w"]:
    """Pixels whose ray meets the box around a posed body, widened by `BOX_MARGIN`.

    Args:
        body: the body.
        pose: its pose, unbatched.
        camera: the camera, without distortion.

    Returns:
        height width; the box is axis-aligned in the world.
    """
    with torch.no_grad():
        low, high = box_of(body(pose).verts_world, BOX_MARGIN)
        rays = camera.rays(camera.pixel_grid().to(low).reshape(-1, 2))
        hit = ray_box(rays, low, high)[2]
    return hit.reshape(camera.size)


def shape_scores(
    picture: Picture,
    mask: Bool[Tensor, "h w"],
    camera: Camera,
    depth: Float[Tensor, "h w"] | None = None,
) -> dict[str, float | None]:
    """How well the shape of a rendering fits: silhouette, and depth where it is known.

    Args:
        picture: the rendering, with opacity and depth.
        mask: the true silhouette.
        camera: its camera, without distortion.
        depth: true depth along the optical axis, metres, 0 where nothing is; None if not known.

    Returns:
        `mask_iou`: intersection over union of the mask and the pixels of opacity above one half;
        `depth_mm` and `depth_median_mm`: mean and median of the absolute error of the expected
        depth, millimetres, over the pixels where both are solid; None where not known.
    """
    opacity = picture.opacity.cpu()
    solid = opacity > SOLID
    union = int((solid | mask).sum())
    scores: dict[str, float | None] = {
        "mask_iou": int((solid & mask).sum()) / union if union else None,
        "depth_mm": None,
        "depth_median_mm": None,
    }
    if depth is None:
        return scores
    both = solid & (depth > 0)
    if not bool(both.any()):
        return scores
    directions = camera.rays(camera.pixel_grid().to(camera.R)).directions
    along = (directions @ camera.R[2]).cpu()  # camera z of a step of one metre along the ray
    found = picture.depth.cpu() / opacity.clamp_min(SOLID) * along
    error = 1e3 * (found - depth)[both].double().abs()
    return scores | {"depth_mm": error.mean().item(), "depth_median_mm": error.median().item()}
