"""Stress of textures: from coordinates to the surface, texels, gutters, look-up, other meshes."""

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.uv import UVMap
from monopart.geometry.uv_lookup import UVIndex, transfer_uv
from monopart.geometry.uv_measure import uv_report
from monopart.geometry.uv_texture import fill_gutter, sample_texture, texel_map

from .stability_cases import DOUBLE, Family, Inputs, Stress, Way
from .stability_meshes import Mesh
from .stability_rotations import Make

_SIDE = 4  # squares along a side of the sheet below

# --- a layout whose answers are known: a square sheet, two faces a square ----------------------


def sheet(squash: float = 1.0, lift: float = 0.0) -> Mesh:
    """The unit square in the plane, folded by a height, squashed along y; eighths of it exact."""
    at = torch.arange(_SIDE + 1, dtype=DOUBLE) / _SIDE
    y, x = torch.meshgrid(at, at, indexing="ij")
    z = lift * (1 - 2 * (x - 0.5).abs())
    verts = torch.stack((x, squash * y, z), -1).reshape(-1, 3)
    faces = []
    for r in range(_SIDE):
        for c in range(_SIDE):
            a = r * (_SIDE + 1) + c
            b = a + _SIDE + 1
            faces += [(a, a + 1, b + 1), (a, b + 1, b)]
    return Mesh(verts, torch.tensor(faces))


def _flat(mesh: Mesh) -> Tensor:
    return mesh.verts[mesh.faces][..., :2].contiguous()


def _in_square(kind: str) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        points = torch.rand(count, 2, generator=generator, dtype=DOUBLE)
        if kind == "edges":
            points[:, 0] = (points[:, 0] * _SIDE).round() / _SIDE
        elif kind == "corners":
            points = (points * _SIDE).round() / _SIDE
        elif kind == "diagonals":
            points[:, 1] = points[:, 0]
        elif kind == "outside":
            points = points + 1.5
        elif kind in ("infinite", "NaN"):
            points = torch.full_like(points, torch.inf if kind == "infinite" else torch.nan)
        return (points,)

    return make


def _locate() -> Stress:
    """A point of the texture comes back to the place of the sheet with the same coordinates."""

    def run(squash: float, points: Tensor) -> tuple[Tensor, Tensor]:
        mesh = sheet(squash, 0.3)
        uv = UVMap((_flat(mesh)).to(points))
        scaled = points * points.new_tensor([1.0, squash])
        hit = UVIndex(uv).locate(scaled, 1e-6 if points.dtype == torch.float32 else 1e-9)
        return hit.point(mesh.verts.to(points), mesh.faces), hit.found

    def exact(squash: float, points: np.ndarray) -> np.ndarray:
        x, y = np.nan_to_num(points, posinf=0.0).T
        return np.stack((x, squash * y, 0.3 * (1 - 2 * np.abs(x - 0.5))), 1)

    kinds = ("inside", "edges", "corners", "diagonals", "outside", "infinite", "NaN")
    families = [Family(k, _in_square(k), extra=1.0, smooth=k == "inside", step=1e-9) for k in kinds]
    for squash in (1e-3, 1e-6):
        made = _in_square("inside")
        families.append(Family(f"squashed {squash:g}", made, extra=squash, smooth=False))
    return Stress(
        name="uv_locate",
        title="from texture coordinates to the surface",
        domain="any points of a layout without overlaps; outside of charts and of the square, and "
        "where it is not finite, nothing is found (masked)",
        error="1, the edge of the texture",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=exact,
        scale=lambda squash, exact, points: 2.0,
        cases=128,
    )


# --- texels ------------------------------------------------------------------------------------


def _texels() -> Stress:
    """Values given per corner that are linear over the sheet, at the middle of every texel."""

    def run(size: int, slope: Tensor) -> Tensor:
        uv = UVMap(_flat(sheet()).to(slope))
        values = uv.corner_uv @ slope[0, :2] + slope[0, 2]
        return texel_map(uv, size).of_corners(values[..., None]).reshape(-1, 1)

    def exact(size: int, slope: np.ndarray) -> np.ndarray:
        v, u = (np.mgrid[:size, :size] + 0.5) / size
        return (slope[0, 0] * u + slope[0, 1] * v + slope[0, 2]).reshape(-1, 1)

    def slopes(size: float) -> Make:
        return lambda g, n: (size * torch.randn(1, 3, generator=g, dtype=DOUBLE),)

    shapes = (("7 texels", 7, 1.0), ("8, middles on edges", 8, 1.0), ("one texel", 1, 1.0))
    shapes = (*shapes, ("values 1e-30", 7, 1e-30), ("values 1e30", 7, 1e30))
    families = [
        Family(n, slopes(v), extra=s, smooth="1e" not in n, step=1e-6) for n, s, v in shapes
    ]
    return Stress(
        name="texel_map",
        title="values of corners at texels",
        domain="any layout; texels between the charts are 0",
        error="largest value",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=exact,
        scale=lambda size, exact, slope: np.abs(slope).sum(),
        rows_apart=False,
        cases=8,
    )


def _gutter() -> Stress:
    """Holes of textures, filled ring by ring."""

    def run(mask: Tensor, texture: Tensor) -> Tensor:
        return fill_gutter(texture, mask, 3).reshape(-1, texture.shape[2])

    def exact(mask: Tensor, texture: np.ndarray) -> np.ndarray:
        image, there = np.where(mask.numpy()[..., None], texture, 0.0), mask.numpy().copy()
        for _ in range(3):
            before, known = image.copy(), there.copy()
            for r, c in zip(*np.nonzero(~known), strict=True):
                rows, cols = slice(max(r - 1, 0), r + 2), slice(max(c - 1, 0), c + 2)
                if known[rows, cols].any():
                    image[r, c] = before[rows, cols][known[rows, cols]].mean(0)
                    there[r, c] = True
        return image.reshape(-1, texture.shape[2])

    def colours(mask: Tensor, size: float, hole: float | None = None) -> Make:
        def make(generator: torch.Generator, count: int) -> Inputs:
            texture = size * torch.rand(*mask.shape, 3, generator=generator, dtype=DOUBLE)
            if hole is not None:
                texture[~mask] = hole
            return (texture,)

        return make

    generator = torch.Generator().manual_seed(4)
    some = torch.rand(9, 9, generator=generator) > 0.7
    one = torch.zeros(9, 9, dtype=torch.bool)
    one[0, 0] = True
    shapes = (
        *(("holes", some, 1.0, None), ("one texel known", one, 1.0, None)),
        *(("none known", one & False, 1.0, None), ("all known", one | True, 1.0, None)),
        *(("NaN in holes", some, 1.0, torch.nan), ("infinite in holes", some, 1.0, torch.inf)),
        *(("1e-30", some, 1e-30, None), ("1e30", some, 1e30, None)),
    )
    families = [
        Family(n, colours(m, s, h), extra=m, smooth="1e" not in n and "in holes" not in n)
        for n, m, s, h in shapes
    ]
    return Stress(
        name="fill_gutter",
        title="gutters of textures",
        domain="colours below 1e37 where texels are covered; what stands elsewhere is not read",
        error="largest colour",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=exact,
        scale=lambda mask, exact, texture: max(np.abs(exact).max(), 1e-30),
        rows_apart=False,
        cases=8,
    )


_CHARTS = torch.zeros(8, 8, dtype=torch.long)
_CHARTS[:, 4:] = 1
_CHARTS[:, 7] = -1


def exact_look_up(extra: None, texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Texel by texel, shares of other charts left out."""
    out, own = np.zeros((len(uv), 3)), _chart_of(torch.from_numpy(uv)).numpy()
    for i, (u, v) in enumerate(uv):
        if not np.isfinite((u, v)).all() or own[i] < 0:
            continue
        x, y, total = u * 8 - 0.5, v * 8 - 0.5, 0.0
        for row in (np.floor(y), np.floor(y) + 1):
            for col in (np.floor(x), np.floor(x) + 1):
                r, c = int(np.clip(row, 0, 7)), int(np.clip(col, 0, 7))
                share = (1 - abs(x - col)) * (1 - abs(y - row))
                if _CHARTS[r, c] == own[i] and share > 0:
                    out[i] += share * texture[r, c]
                    total += share
        out[i] /= total if total > 0 else 1.0
    return out


def _coordinates(kind: str) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        texture = torch.rand(8, 8, 3, generator=generator, dtype=DOUBLE)
        uv = 0.06 + 0.85 * torch.rand(count, 2, generator=generator, dtype=DOUBLE)
        if kind == "middles":
            uv = ((uv * 8).floor() + 0.5) / 8
        elif kind == "border of charts":
            uv[:, 0] = 0.5
        elif kind == "0 and 1":
            uv = uv.round()
        elif kind == "outside":
            uv = 20 * uv - 10
        elif kind in ("infinite", "NaN"):
            uv = torch.full_like(uv, torch.inf if kind == "infinite" else torch.nan)
        return texture, uv

    return make


def _sampled() -> Stress:
    """Bilinear look-up over two charts that lie beside each other."""

    def run(extra: None, texture: Tensor, uv: Tensor) -> Tensor:
        return sample_texture(texture, uv, _chart_of(uv), _CHARTS)

    kinds = ("inside", "middles", "border of charts", "0 and 1", "outside", "infinite", "NaN")
    families = [Family(k, _coordinates(k), smooth=k == "inside", step=1e-9) for k in kinds]
    return Stress(
        name="sample_texture",
        title="look-up that keeps to its chart",
        domain="any coordinates; no colour (0) where none of the four texels is of the chart, far "
        "outside and where they are not finite; the gradient jumps at the middles of texels",
        error="largest colour times the texels of a side: the slope of the look-up",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=exact_look_up,
        scale=lambda extra, exact, texture, uv: 8.0,
        wrt=(0, 1),
        rows_apart=False,
        cases=96,
    )


def _chart_of(uv: Tensor) -> Tensor:
    """The left half is chart 0, the right one 1, points that are not finite keep chart 0."""
    return (uv[:, 0].detach().nan_to_num(0.0, 0.0, 0.0) >= 0.5).long()


# --- from mesh to mesh, figures of layouts -----------------------------------------------------


def _transfer() -> Stress:
    """The map of the sheet brought to the same sheet, its faces named from other corners."""

    def run(given: tuple[float, float], shift: Tensor) -> Tensor:
        mesh = sheet(given[0], 0.3 * given[0])
        verts = (given[1] * mesh.verts).to(shift) + shift
        uv = UVMap(
            (mesh.verts[mesh.faces][..., :2] / torch.tensor([1.0, given[0]], dtype=DOUBLE)).to(
                shift
            )
        )
        other = mesh.faces.roll(1, 1).flip(0)
        return transfer_uv(verts, mesh.faces, uv, verts, other).corner_uv.reshape(-1, 2)

    def exact(given: tuple[float, float], shift: np.ndarray) -> np.ndarray:
        mesh = sheet()
        return _flat(Mesh(mesh.verts, mesh.faces.roll(1, 1).flip(0))).reshape(-1, 2).numpy()

    shapes = (
        *(("1 m", 1.0, 1.0, 0.0), ("1 mm", 1.0, 1e-3, 0.0), ("1 km", 1.0, 1e3, 0.0)),
        *(("squashed 1e-2", 1e-2, 1.0, 0.0), ("1 km away", 1.0, 1.0, 1e3)),
    )
    families = [Family(n, _shifted(away), extra=(squash, size)) for n, squash, size, away in shapes]
    return Stress(
        name="transfer_uv",
        title="a map brought to another mesh",
        domain="meshes of one surface; vertices and map are constants; coordinates are as good as "
        "the last place of a vertex over the size of a face",
        error="1, and the place over the height of a face, in the texture",
        families=tuple(families),
        ways=(Way("monopart", run, True, differentiable=False),),
        exact=exact,
        scale=lambda given, exact, shift: (
            4 + 4 * np.abs(shift).max() / (given[0] * given[1]) + 4 / given[0]
        ),
        wrt=(),
        cases=8,
        limit=2e-6,
    )


def _shifted(away: float) -> Make:
    return lambda g, n: (away * torch.ones(1, 3, dtype=DOUBLE),)


_FIGURES = ("angle_mean", "area_mean", "packing", "symmetric_dirichlet")


def _figures() -> Stress:
    """Figures of a flat sheet of any size and place: they are known."""

    def run(size: float, shift: Tensor) -> Tensor:
        mesh = sheet()
        verts = (size * mesh.verts).to(shift) + shift
        report = uv_report(verts, mesh.faces, 0.5 * _flat(mesh).to(shift), 1024)
        told = [getattr(report, name) for name in _FIGURES]
        told += [report.seam_length / size, report.texels_per_metre * size / 512]
        counts = [report.charts, report.flips, report.overlaps]
        return torch.tensor([[*told, *counts]], dtype=DOUBLE)

    def exact(size: float, shift: np.ndarray) -> np.ndarray:
        return np.array([[1.0, 1.0, 0.25, 4.0, 4.0, 1.0, 1.0, 0.0, 0.0]])

    shapes = (("1 m", 1.0, 0.0), ("1e-6 m", 1e-6, 0.0), ("1e6 m", 1e6, 0.0), ("1 km off", 1.0, 1e3))
    return Stress(
        name="uv_report",
        title="figures of a layout",
        domain="any size and place; as good as the last place of a vertex over the size of a face",
        error="1, and four times the place over the size",
        families=tuple(Family(n, _shifted(away), extra=size) for n, size, away in shapes),
        ways=(Way("monopart", run, True, differentiable=False),),
        exact=exact,
        scale=lambda size, exact, shift: 8 * (1 + 4 * np.abs(shift).max() / size),
        wrt=(),
        cases=8,
    )


def stresses() -> list[Stress]:
    """Operations on textures."""
    return [_locate(), _texels(), _gutter(), _sampled(), _transfer(), _figures()]
