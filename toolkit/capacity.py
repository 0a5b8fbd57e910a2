"""Capacity of the parts from what the training frames show of them (MonoPartNeRF, section 3.1).

A part that fills more of the images and has more texture gets more rows of the hash table, and one
with more texture per pixel gets finer cells. The rows of all parts together are at most those of
the uniform allocation, so that the two can be compared.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch

from monopart.geometry.parts import PartMap

from .cache import NO_CACHE, Cache
from .captures.cache import Pictures, read_pictures
from .captures.frames import spread
from .captures.records import CaptureRecord
from .config import Config, FieldConfig
from .model import part_boxes
from .part_picture import nearest_part, part_picture
from .reach import reaching
from .scene import canonical_body
from .sizes import field_spec, part_radii

IMAGES = 12  # training images that are looked at, evenly spread
LEAST, MOST = 4, 3  # a level has at least 2^-4 and at most 2^3 times the uniform rows
FINER, COARSER = 0.5, 2.0  # bounds of a part's finest cell, of the uniform one
EDGE = 5  # pixels at the outline of the person whose gradients are not texture


@dataclass(frozen=True)
class Demand:
    """What the training images show of each part.

    Attributes:
        area: pixels of an average image.
        detail: mean change of brightness from pixel to pixel on the part, 0 to 1.
    """

    area: tuple[float, ...]
    detail: tuple[float, ...]


def as_asked(stored: Config, wanted: Config) -> Config:
    """A run's configuration as it was asked for: without what was measured of the parts.

    Args:
        stored: of a run folder.
        wanted: what it is compared with; capacities and radii that it names itself are kept.
    """
    field, shape = stored.field, stored.geometry
    if not (wanted.field.part_log2_size or wanted.field.part_finest):
        field = dataclasses.replace(field, part_log2_size=(), part_finest=())
    if not wanted.geometry.part_radius:
        shape = dataclasses.replace(shape, part_radius=())
    return dataclasses.replace(stored, field=field, geometry=shape)


def allocated(
    config: Config, record: CaptureRecord, pictures: Pictures | None = None, cache: Cache = NO_CACHE
) -> tuple[Config, list[dict[str, Any]]]:
    """The configuration with capacity and radius of each part, and a row per part for people.

    Args:
        config: the configuration; one that holds them already stays as it is.
        record: the capture.
        pictures: its training images where the caller has them.
        cache: where they are kept otherwise.

    Returns:
        The configuration, and for each part its name, radius, capacity and, where it was looked
        at, area and detail.
    """
    spec, table = config.field, PartMap.preset(config.geometry.parts, record.body.num_joints)
    if config.geometry.reach == "masks" and not config.geometry.part_radius:
        pictures = pictures or read_pictures(record, "train", cache)
        config = reaching(config, record, pictures, table)
    canonical = canonical_body(record)
    lo, hi = part_boxes(record.body, canonical, table, config.geometry)
    edges, demand = (hi - lo).amax(-1).tolist(), None
    if spec.allocation == "data" and not spec.part_log2_size:
        pictures = pictures or read_pictures(record, "train", cache)
        demand = measured(record, pictures, table)
        sizes, cells = allocate(demand, edges, spec)
        spec = dataclasses.replace(spec, part_log2_size=sizes, part_finest=cells)
        config = dataclasses.replace(config, field=spec)
    radii = part_radii(config.geometry, len(edges))
    rows = _rows(spec, edges, table.names, demand)
    return config, [row | {"radius": r} for row, r in zip(rows, radii, strict=True)]


def _rows(
    spec: FieldConfig, edges: Sequence[float], names: Sequence[str], demand: Demand | None
) -> list[dict[str, Any]]:
    field = field_spec(spec, len(names))
    rows = []
    for k, (name, grid) in enumerate(zip(names, field.grid_specs(edges), strict=True)):
        row = {
            "part": name,
            "log2_size": grid.log2_size,
            "finest": edges[k] / max(grid.resolutions),
            "rows": sum(grid.sizes),
        }
        if demand is not None:
            row |= {"area": demand.area[k], "detail": demand.detail[k]}
        rows.append(row)
    return rows


def allocate(
    demand: Demand, edges: Sequence[float], spec: FieldConfig
) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Table size (log2 of a level's rows) and finest cell of each part.

    Args:
        demand: what the images show; a part of area 0 gets the smallest table and coarse cells.
        edges: longest edge of each part's box, metres.
        spec: the uniform sizes, whose sum of rows is not exceeded.
    """
    parts = len(edges)
    uniform = dataclasses.replace(spec, part_log2_size=(), part_finest=())
    budget = sum(_counts(uniform, (spec.log2_size,) * parts, (spec.finest,) * parts, edges))
    need = [a * d for a, d in zip(demand.area, demand.detail, strict=True)]
    if not sum(need):
        return (spec.log2_size,) * parts, (spec.finest,) * parts
    mean = sum(need) / sum(demand.area)
    cells = tuple(spec.finest * _cell(n, d, mean) for n, d in zip(need, demand.detail, strict=True))
    low, high = max(spec.log2_size - LEAST, 3), spec.log2_size + MOST
    sizes = [low] * parts
    open_parts = {k for k in range(parts) if need[k] > 0}
    while open_parts:
        rows = _counts(uniform, tuple(sizes), cells, edges)
        # the part whose table is smallest for its need comes first
        k = min(open_parts, key=lambda i: rows[i] / need[i])
        sizes[k] += 1
        grown = _counts(uniform, tuple(sizes), cells, edges)
        if sizes[k] > high or sum(grown) > budget or grown[k] == rows[k]:
            sizes[k] -= 1
            open_parts.discard(k)
    return tuple(sizes), cells


def _cell(need: float, detail: float, mean: float) -> float:
    """Finest cell of a part, of the uniform one."""
    if need <= 0:
        return COARSER
    return min(max(math.sqrt(mean / detail), FINER), COARSER)


def _counts(
    spec: FieldConfig, sizes: tuple[int, ...], cells: tuple[float, ...], edges: Sequence[float]
) -> list[int]:
    """Rows of each part."""
    filled = dataclasses.replace(spec, part_log2_size=sizes, part_finest=cells)
    return [sum(grid.sizes) for grid in field_spec(filled, len(edges)).grid_specs(edges)]


def measured(record: CaptureRecord, pictures: Pictures, table: PartMap) -> Demand:
    """Area and texture of each part in some training images.

    Args:
        record: the capture, for cameras and poses.
        pictures: its training images.
        table: the parts.
    """
    chosen = spread([*enumerate(record.split("train").pairs())], IMAGES)
    area, change, inside = np.zeros((3, len(table.names)))
    for row, (camera, frame) in chosen:
        with torch.no_grad():
            posed = record.body(record.poses[frame])
        drawn = part_picture(record.body, posed, record.cameras[camera], table)
        mask = pictures.masks[row].numpy()
        label = np.where(mask, nearest_part(drawn)[0], -1)
        inner = cv2.erode(mask.astype(np.uint8), np.ones((EDGE, EDGE), np.uint8)).astype(bool)
        texture = _texture(pictures.images[row].numpy())
        for k in range(len(table.names)):
            area[k] += (label == k).sum() / len(chosen)
            change[k] += texture[inner & (label == k)].sum()
            inside[k] += (inner & (label == k)).sum()
    # A part so thin that all of it is outline counts as the others do.
    usual = change.sum() / max(inside.sum(), 1.0)
    thin = np.where(area > 0, usual, 0.0)
    detail = np.divide(change, inside, out=thin, where=inside > 0)
    return Demand(tuple(area.tolist()), tuple(detail.tolist()))


def _texture(image: np.ndarray) -> np.ndarray:
    """Change of brightness per pixel, in 0 to 1."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255.0
    right, down = (
        np.diff(grey, axis=1, append=grey[:, -1:]),
        np.diff(grey, axis=0, append=grey[-1:]),
    )
    return np.hypot(right, down)


def capacity_lines(rows: Sequence[dict[str, Any]]) -> list[str]:
    """The allocation as lines of text, one per part.

    Args:
        rows: from :func:`allocated`.

    >>> row = {"part": "head", "log2_size": 15, "finest": 0.002, "rows": 9, "radius": 0.06}
    >>> capacity_lines([row])
    ['part head: reaches 60 mm; 2^15 rows a level, 9 in all (100.0 %), finest cell 2.0 mm']
    """
    total, lines = max(sum(row["rows"] for row in rows), 1), []
    for row in rows:
        text = (
            f"part {row['part']}: reaches {1e3 * row['radius']:.0f} mm; "
            f"2^{row['log2_size']} rows a level, {row['rows']} in all "
            f"({100 * row['rows'] / total:.1f} %), finest cell {1e3 * row['finest']:.1f} mm"
        )
        if "area" in row:
            text += f"; {row['area']:.0f} pixels an image, detail {row['detail']:.4f}"
        lines.append(text)
    return lines
