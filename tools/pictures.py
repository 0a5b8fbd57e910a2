"""Pictures of meshes from front and back, coloured by face, drawn by a z-buffer in numpy."""

import colorsys
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from .raster import rasterise

_GROUND = 0.97
_COLORS = (
    (0.00, 0.45, 0.70),
    (0.90, 0.62, 0.00),
    (0.00, 0.62, 0.45),
    (0.80, 0.47, 0.65),
    (0.84, 0.37, 0.00),
    (0.34, 0.71, 0.91),
    (0.94, 0.89, 0.26),
    (0.45, 0.31, 0.22),
    (0.50, 0.50, 0.50),
    (0.60, 0.80, 0.40),
)


def part_colors(count: int) -> Float[np.ndarray, "n 3"]:
    """Colours that are told apart well, the first ten also by the colour-blind.

    Args:
        count: how many.

    Returns:
        sRGB in [0, 1].

    >>> part_colors(12).shape
    (12, 3)
    """
    more = [
        colorsys.hsv_to_rgb((0.1 + 0.618034 * k) % 1, 0.55 + 0.3 * (k % 2), 0.85 - 0.2 * (k % 3))
        for k in range(max(0, count - len(_COLORS)))
    ]
    return np.array([*_COLORS, *more], float)[:count].reshape(-1, 3)


def covered(
    screen: Float[np.ndarray, "f 3 2"], depth: Float[np.ndarray, "f 3"], size: tuple[int, int]
) -> Int[np.ndarray, "h w"]:
    """The face in the middle of each pixel: the nearest one.

    Args:
        screen: corners in pixels, x right and y down, (0, 0) the outer corner of the first pixel.
        depth: distance of each corner from the viewer.
        size: rows and columns of the picture.

    Returns:
        Face index, -1 where there is none.

    >>> covered(np.array([[[0.0, 0], [4, 0], [0, 4]]]), np.zeros((1, 3)), (2, 3)).tolist()
    [[0, 0, 0], [0, 0, 0]]
    """
    return rasterise(screen, depth, *size).face


def view(
    verts: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    colors: Float[np.ndarray, "f 3"],
    back: bool = False,
    height: int = 640,
) -> Float[np.ndarray, "h w 3"]:
    """A mesh seen along its z axis, y up, without perspective, shaded by a light at the viewer.

    Args:
        verts: vertices; those that are not finite and their faces are left out.
        faces: vertex indices.
        colors: sRGB of each face, in [0, 1].
        back: look from behind (from -z); else from the front (+z).
        height: rows of the picture.

    Returns:
        sRGB in [0, 1]; the width follows from the mesh.

    >>> view(np.eye(3), np.array([[0, 1, 2]]), np.ones((1, 3)), height=40).shape
    (40, 40, 3)
    """
    keep = np.asarray(np.isfinite(verts).all(axis=1))[faces].all(axis=1)
    faces, colors = faces[keep], colors[keep]
    if not len(faces):
        return np.full((height, height // 2, 3), _GROUND)
    used = verts[np.unique(faces)]
    size = max(float(np.abs(used).max()), 1e-300)
    points = np.where(np.isfinite(verts), verts, 0) / size * [1, 1, 1]
    used = used / size
    if back:
        points, used = points * [-1, 1, -1], used * [-1, 1, -1]
    low, high = used.min(0), used.max(0)
    fine = 2 * height
    scale = 0.94 * fine / max(high[1] - low[1], (high[0] - low[0]) / 4, 1e-12)
    width = int(np.clip(np.ceil((high[0] - low[0]) * scale / 0.94), fine // 8, 4 * fine)) // 2 * 2
    middle = 0.5 * (low + high)
    x = (points[:, 0] - middle[0]) * scale + width / 2
    y = (middle[1] - points[:, 1]) * scale + fine / 2
    seen = covered(np.stack([x, y], 1)[faces], -points[:, 2][faces], (fine, width))
    a, b, c = np.moveaxis(points[faces], 1, 0)
    normal = np.cross(b - a, c - a)
    facing = np.abs(normal[:, 2]) / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
    shaded = colors * (0.45 + 0.55 * facing)[:, None]
    image = np.full((fine, width, 3), _GROUND)
    image[seen >= 0] = shaded[seen[seen >= 0]]
    return image.reshape(height, 2, width // 2, 2, 3).mean((1, 3))


def front_and_back(
    verts: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    colors: Float[np.ndarray, "f 3"],
    legend: Sequence[tuple[str, Float[np.ndarray, "3"]]] = (),
    height: int = 640,
) -> Float[np.ndarray, "h w 3"]:
    """Both views side by side, with a legend of colours below.

    Args:
        verts: vertices, y up, front at +z.
        faces: vertex indices.
        colors: sRGB of each face, in [0, 1].
        legend: names and colours.
        height: rows of a view.

    Returns:
        sRGB in [0, 1].

    >>> front_and_back(np.eye(3), np.array([[0, 1, 2]]), np.ones((1, 3)), height=40).shape[2]
    3
    """
    views = [view(verts, faces, colors, back, height) for back in (False, True)]
    both = np.concatenate(views, 1)
    if not legend:
        return both
    return np.concatenate([both, _legend(legend, both.shape[1])], 0)


def _legend(legend: Sequence[tuple[str, np.ndarray]], width: int) -> np.ndarray:
    from PIL import Image, ImageDraw

    line, wide = 22, 160
    columns = max(1, width // wide)
    rows = -(-len(legend) // columns)
    ground = round(_GROUND * 255)
    image = Image.new("RGB", (width, rows * line + 8), (ground, ground, ground))
    draw = ImageDraw.Draw(image)
    for place, (name, color) in enumerate(legend):
        x, y = 10 + place % columns * wide, 4 + place // columns * line
        fill = tuple(int(255 * c) for c in color)
        draw.rectangle((x, y + 3, x + 14, y + 17), fill=fill)
        draw.text((x + 20, y + 4), name, fill=(30, 30, 30))
    return np.asarray(image, float) / 255
