"""Pictures of meshes: front and back, coloured or textured, and the layout of their UVs."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from .colors import (
    PLAIN,
    checker_color,
    face_distortion,
    heat_color,
    part_color,
    texture_color,
    unit_box,
)
from .meshio import Mesh
from .raster import Raster, rasterise

_FINE = 2  # samples along the side of a pixel
_PAPER = np.array([1.0, 1.0, 1.0])
_FAULT = np.array([0.86, 0.10, 0.12])
_LIGHT = np.array([0.35, 0.55, 0.76])
Image = np.ndarray


@dataclass(frozen=True)
class Panel:
    """One picture of several, with what is written above it."""

    title: str
    image: Image


@dataclass(frozen=True, eq=False)
class View:
    """A mesh seen from the front and from the back, ready to be coloured."""

    rasters: tuple[Raster, Raster]
    shade: tuple[Image, Image]

    def colored(self, corner_color: Float[np.ndarray, "F 3 3"]) -> Image:
        """Both sides with colours of the face corners."""
        return self._joined([r.of_corners(corner_color) for r in self.rasters])

    def by_uv(
        self, corner_uv: Float[np.ndarray, "F 3 2"], texture: Float[np.ndarray, "H W 3"] | None
    ) -> Image:
        """Both sides with a texture, or with the checker board."""
        uvs = [r.of_corners(corner_uv) for r in self.rasters]
        if texture is None:
            return self._joined([checker_color(uv) for uv in uvs])
        return self._joined([texture_color(texture, uv) for uv in uvs])

    def _joined(self, colors: Sequence[Image]) -> Image:
        sides = []
        for raster, shade, color in zip(self.rasters, self.shade, colors, strict=True):
            shown = np.where((raster.face >= 0)[..., None], color * shade[..., None], _PAPER)
            sides.append(_smaller(shown))
        return np.concatenate(sides, axis=1)


def view(mesh: Mesh, size: int = 640, on_top: np.ndarray | None = None) -> View:
    """Look at a mesh along z from both sides, y up, scaled to fill the picture.

    Args:
        mesh: the mesh; what is not finite is not seen.
        size: width of the picture in pixels; each side takes half of it, and a flat mesh is given
            less height.
        on_top: faces that nothing hides, (F) bool.

    Returns:
        The two sides.
    """
    verts = unit_box(mesh.verts)
    height, width = size * _FINE, size * _FINE // 2
    tall, wide = max(_extent(verts, 1), 1e-9), max(_extent(verts, 0), 1e-9)
    scale = 0.94 * min(height / tall, width / wide)
    height = min(height, int(tall * scale * 1.06) // _FINE * _FINE + 40 * _FINE)
    lift = np.zeros(mesh.num_faces) if on_top is None else np.where(on_top, -1e3, 0.0)
    rasters, shades = [], []
    for side in (1.0, -1.0):
        x = width / 2 + side * scale * verts[:, 0]
        y = height / 2 - scale * verts[:, 1]
        corners = np.stack([x, y], axis=1)[mesh.faces]
        raster = rasterise(
            corners, (-side * verts[:, 2])[mesh.faces] + lift[:, None], height, width
        )
        rasters.append(raster)
        shades.append(_shade(verts, mesh.faces, raster, side))
    return View((rasters[0], rasters[1]), (shades[0], shades[1]))


def _extent(verts: np.ndarray, axis: int) -> float:
    values = verts[np.isfinite(verts).all(axis=1), axis]
    return float(np.ptp(values)) if len(values) else 1.0


def _shade(verts: np.ndarray, faces: np.ndarray, raster: Raster, side: float) -> Image:
    with np.errstate(invalid="ignore"):
        a, b, c = (verts[faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        normal = np.nan_to_num(normal / np.where(length > 0, length, 1))
    light = np.abs(normal @ (_LIGHT * np.array([side, 1, side])))
    out = np.ones(raster.face.shape)
    seen = raster.face >= 0
    out[seen] = 0.5 + 0.5 * np.minimum(light[raster.face[seen]], 1)
    return out


def _smaller(image: Image) -> Image:
    height, width = (n // _FINE for n in image.shape[:2])
    return (
        image[: height * _FINE, : width * _FINE]
        .reshape(height, _FINE, width, _FINE, 3)
        .mean(axis=(1, 3))
    )


def uv_panels(mesh: Mesh, size: int = 640) -> list[Panel]:
    """Layout with checker board and distortion, each also on the surface.

    Args:
        mesh: with texture coordinates.
        size: of each panel in pixels.

    Returns:
        Four panels: layout, its distortion, surface, its distortion.
    """
    if mesh.corner_uv is None:
        return []
    raster = _uv_raster(mesh.corner_uv, size)
    energy = face_distortion(mesh)
    heat = np.repeat(heat_color(energy, 4.0, 5.0)[:, None], 3, axis=1)
    seen = view(mesh, size)
    return [
        Panel("UV layout", _layout(raster, checker_color(raster.of_corners(mesh.corner_uv)), mesh)),
        Panel(
            "distortion (symmetric Dirichlet, blue 4, red 5 and above)",
            _layout(raster, raster.of_corners(heat), mesh),
        ),
        Panel("front and back", seen.by_uv(mesh.corner_uv, None)),
        Panel("distortion on the surface", seen.colored(heat)),
    ]


def _uv_raster(corner_uv: np.ndarray, size: int) -> Raster:
    """The unit square, or all of the layout where it is larger."""
    finite = corner_uv[np.isfinite(corner_uv).all(axis=(1, 2))].reshape(-1, 2)
    low = np.minimum(finite.min(axis=0, initial=0.0), 0.0)
    span = max(float((np.maximum(finite.max(axis=0, initial=1.0), 1.0) - low).max()), 1e-9)
    corners = (corner_uv - low) / span
    corners = np.stack([corners[..., 0], 1 - corners[..., 1]], axis=-1) * (size * _FINE)
    return rasterise(corners, np.zeros(corners.shape[:2]), size * _FINE, size * _FINE)


def _layout(raster: Raster, color: Image, mesh: Mesh) -> Image:
    """Charts on grey paper, with a dark line around each."""
    from .bake_uv import uv_charts

    label = np.full(raster.face.shape, -1, dtype=np.int64)
    inside = raster.face >= 0
    if mesh.corner_uv is not None:
        label[inside] = uv_charts(mesh)[raster.face[inside]]
    border = np.zeros(label.shape, dtype=bool)
    border[1:] |= label[1:] != label[:-1]
    border[:, 1:] |= label[:, 1:] != label[:, :-1]
    shown = np.where(inside[..., None], color, 0.93)
    return _smaller(np.where(border[..., None], 0.15, shown))


def part_panels(
    mesh: Mesh, face_part: Int[np.ndarray, "F"], names: Sequence[str], size: int = 640
) -> list[Panel]:
    """Parts in their colours, front and back.

    Args:
        mesh: the mesh.
        face_part: part of each face.
        names: of the parts.
        size: of the panel in pixels.

    Returns:
        One panel.
    """
    color = np.repeat(part_color(face_part)[:, None], 3, axis=1)
    return [Panel(", ".join(names), view(mesh, size).colored(color))]


def fault_panels(
    mesh: Mesh, faults: Sequence[tuple[str, Sequence[int]]], size: int = 640
) -> list[Panel]:
    """The mesh in grey, the places of faults in red.

    Args:
        mesh: the mesh; one of points alone is drawn as it is.
        faults: what is counted ("faces", "pairs of faces", "vertices", "edges") and its numbers.
        size: of the panel in pixels.

    Returns:
        One panel.
    """
    if not mesh.num_faces:
        return surface_panels(mesh, "points", size)
    bad = np.zeros(mesh.num_faces, dtype=bool)
    verts = np.zeros(mesh.num_verts, dtype=bool)
    for of, indices in faults:
        chosen = np.asarray(indices, dtype=np.int64)
        if "face" in of:
            bad[chosen[chosen < mesh.num_faces]] = True
        elif "vert" in of or "edge" in of:
            verts[chosen[chosen < mesh.num_verts]] = True
    bad |= verts[mesh.faces].any(axis=1)
    color = np.where(bad[:, None], _FAULT, PLAIN)
    title = (
        "faults (red, the worst of each kind, seen through the surface)"
        if bad.any()
        else "no fault to be seen"
    )
    corner_color = np.repeat(color[:, None], 3, axis=1)
    return [Panel(title, view(mesh, size, bad).colored(corner_color))]


def surface_panels(mesh: Mesh, title: str, size: int = 640) -> list[Panel]:
    """The mesh as it is: with its texture, its colours, the joints that move it, or plain.

    Args:
        mesh: the mesh.
        title: what to write above it.
        size: of the panel in pixels.

    Returns:
        One panel; a point cloud is drawn as small crosses.
    """
    if not mesh.num_faces:
        mesh = _crosses(mesh)
    seen = view(mesh, size)
    if mesh.texture is not None and mesh.corner_uv is not None:
        return [Panel(title, seen.by_uv(mesh.corner_uv, mesh.texture))]
    if mesh.colors is not None:
        return [Panel(title, seen.colored(mesh.colors[mesh.faces]))]
    if mesh.weights is not None and mesh.weights.shape[1]:
        mixed = np.nan_to_num(mesh.weights) @ part_color(np.arange(mesh.weights.shape[1]))
        return [Panel(title, seen.colored(np.clip(mixed, 0, 1)[mesh.faces]))]
    return [Panel(title, seen.colored(np.broadcast_to(PLAIN, (mesh.num_faces, 3, 3))))]


def _crosses(mesh: Mesh) -> Mesh:
    """A small triangle at each point, for a picture."""
    verts = unit_box(mesh.verts)
    corners = np.array([[-1.0, -0.6, 0], [1, -0.6, 0], [0, 1, 0]]) * 0.004
    every = (verts[:, None] + corners).reshape(-1, 3)
    colors = None if mesh.colors is None else np.repeat(mesh.colors, 3, axis=0)
    return dataclasses.replace(
        mesh,
        verts=every,
        faces=np.arange(len(every)).reshape(-1, 3),
        corner_uv=None,
        weights=None,
        skeleton=None,
        colors=colors,
    )


def sheet(panels: Sequence[Panel]) -> Image:
    """Panels side by side, two in a row, each below its title.

    Args:
        panels: at least one.

    Returns:
        One picture.
    """
    from PIL import Image as Pillow
    from PIL import ImageDraw

    rows = [panels[n : n + 2] for n in range(0, len(panels), 2)]
    band, gap = 22, 8
    width = max(sum(p.image.shape[1] + gap for p in row) for row in rows) + gap
    height = sum(max(p.image.shape[0] for p in row) + band + gap for row in rows) + gap
    paper = Pillow.new("RGB", (width, height), "white")
    pen = ImageDraw.Draw(paper)
    top = gap
    for row in rows:
        left = gap
        for panel in row:
            pen.text((left, top + 4), panel.title, fill=(40, 40, 40))
            pixels = np.rint(np.clip(panel.image, 0, 1) * 255).astype(np.uint8)
            paper.paste(Pillow.fromarray(pixels), (left, top + band))
            left += panel.image.shape[1] + gap
        top += max(p.image.shape[0] for p in row) + band + gap
    return np.asarray(paper).astype(np.float64) / 255


def grid_panels(values: Float[np.ndarray, "X Y Z"], size: int = 640) -> list[Panel]:
    """Slices through the middle of a grid of distances: blue inside or near, a dark line at 0.

    Args:
        values: distances at the nodes.
        size: of each panel in pixels.

    Returns:
        Two panels, seen from the front and from the side.
    """
    middle = [n // 2 for n in values.shape]
    slices = {
        "from the front (x, y)": values[:, :, middle[2]].T[::-1],
        "from the side (z, y)": values[middle[0]][::-1],
    }
    high = float(np.abs(values).max(initial=0.0))
    panels = []
    for title, plane in slices.items():
        many = max(1, size // max(plane.shape))
        shown = np.repeat(np.repeat(plane, many, axis=0), many, axis=1)
        color = heat_color(shown, min(float(values.min(initial=0.0)), 0.0), max(high, 1e-12))
        inside = shown < 0
        border = np.zeros(inside.shape, dtype=bool)
        border[1:] |= inside[1:] != inside[:-1]
        border[:, 1:] |= inside[:, 1:] != inside[:, :-1]
        panels.append(Panel(title, np.where(border[..., None], 0.1, color)))
    return panels
