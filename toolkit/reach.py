"""How far clothes and hair stand out from the body: the radius of each part's shell.

A skirt or a ponytail that hangs outside the shell is cut off, and a shell that is wide everywhere
costs samples everywhere. The masks of the training frames say which parts need more.
"""

import dataclasses

import numpy as np
import torch

from monopart.geometry.parts import PartMap

from .captures.cache import Pictures
from .captures.frames import spread
from .captures.records import CaptureRecord
from .config import Config
from .part_picture import nearest_part, part_picture

IMAGES = 24  # training images that are looked at, evenly spread
MOST = 2.0  # a part reaches at most so many times the radius: masks have stray islands
SHARE = 1e-4  # part of all masks that must lie outside before a part is given more
COVERED = 0.98  # part of what a part has outside that its radius takes in
MARGIN = 0.005  # metres beyond, so that a ray at the rim has some way inside


def reaching(config: Config, record: CaptureRecord, pictures: Pictures, table: PartMap) -> Config:
    """The configuration with the radius of each part from the masks.

    Args:
        config: the configuration.
        record: the capture.
        pictures: its training images.
        table: the parts.
    """
    spec = config.geometry
    radii = measured_reach(record, pictures, table, spec.radius)
    return dataclasses.replace(config, geometry=dataclasses.replace(spec, part_radius=radii))


def measured_reach(
    record: CaptureRecord, pictures: Pictures, table: PartMap, radius: float
) -> tuple[float, ...]:
    """Radius of each part that takes in what the masks show of it.

    The distance of a pixel is that to the silhouette of the naked body, at the depth of the part
    there; a pixel is given to the part that is nearest to it in the picture.

    Args:
        record: the capture, for cameras and poses.
        pictures: its training images.
        table: the parts.
        radius: least radius, metres.

    Returns:
        Radii between ``radius`` and ``MOST`` times it, metres, rounded to millimetres.
    """
    outside: list[list[np.ndarray]] = [[] for _ in table.names]
    total = 0
    for row, (camera, frame) in spread([*enumerate(record.split("train").pairs())], IMAGES):
        mask = pictures.masks[row].numpy()
        total += int(mask.sum())
        for part, far in enumerate(_distances(record, camera, frame, mask, table)):
            outside[part].append(far[(far > radius) & (far < MOST * radius)])
    return tuple(_radius(np.concatenate(far), total, radius) for far in outside)


def _radius(far: np.ndarray, total: int, radius: float) -> float:
    if len(far) < SHARE * total or not len(far):
        return radius
    wanted = float(np.quantile(far, COVERED)) + MARGIN
    return round(min(wanted, MOST * radius), 3)


def _distances(
    record: CaptureRecord, camera: int, frame: int, mask: np.ndarray, table: PartMap
) -> list[np.ndarray]:
    """Metres from the silhouette of the body of the pixels of the mask outside it, per part."""
    view = record.cameras[camera]
    with torch.no_grad():
        posed = record.body(record.poses[frame])
        _, depth = view.project(posed.verts_world)
    owner, pixels = nearest_part(part_picture(record.body, posed, view, table))
    part_of = table.vertex_parts(record.body.weights).cpu()
    depth, found = depth.cpu(), []
    for part in range(len(table.names)):
        own = depth[part_of == part]
        metres = float(own.mean() if len(own) else depth.mean()) / float(view.K[0, 0])
        found.append(pixels[mask & (owner == part) & (pixels > 0)] * metres)
    return found
