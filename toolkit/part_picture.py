"""Which part of the body a camera sees at each pixel."""

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int

from monopart.geometry.body import BodyModel, PosedBody
from monopart.geometry.cameras import Camera
from monopart.geometry.parts import PartMap


def part_picture(
    body: BodyModel, posed: PosedBody, camera: Camera, table: PartMap
) -> Int[np.ndarray, "h w"]:
    """The part that a camera sees at each pixel, -1 for none: faces drawn from far to near.

    Args:
        body: the body model.
        posed: one posed body.
        camera: the camera.
        table: the parts.
    """
    pixels, depth = camera.project(posed.verts_world)
    faces = body.faces.cpu()
    corners, far = pixels.cpu()[faces], depth.cpu()[faces]
    part = table.face_parts(body.weights, body.faces).cpu()
    seen = (far > 0).all(-1)
    order = torch.nonzero(seen).squeeze(-1)[far[seen].mean(-1).argsort(descending=True)]
    picture = np.full(camera.size, -1, np.int32)
    # sixteenths of a pixel; OpenCV counts from the centre of the first pixel
    points = ((corners - 0.5).clamp(-1e4, 1e4) * 16).round().int().numpy()
    for face, k in zip(order.tolist(), part[order].tolist(), strict=True):
        cv2.fillConvexPoly(picture, points[face], k, shift=4)
    return picture


def nearest_part(
    picture: Int[np.ndarray, "h w"],
) -> tuple[Int[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """The part of the nearest pixel that has one, and how far it is.

    Args:
        picture: from :func:`part_picture`.

    Returns:
        Parts and distances in pixels, 0 where the pixel has a part; -1 and infinity where none has.
    """
    known = picture >= 0
    if not known.any():
        return picture, np.full(picture.shape, np.inf, np.float32)
    distance, label = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.asarray(label, np.int64)
    part_of = np.zeros(int(nearest.max()) + 1, np.int32)
    part_of[nearest[known]] = picture[known]
    return part_of[nearest], np.asarray(distance, np.float32)
