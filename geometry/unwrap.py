"""Texture coordinates for any triangle mesh: seams, charts without flips or overlaps, packing."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypedDict, Unpack, cast

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from .errors import InputError
from .uv import UVMap
from .uv_measure import UVReport, report_of_arrays

Method = Literal["slim", "arap", "lscm", "harmonic"]
Engine = Literal["monopart", "xatlas"]
GRID = 2.0**-24
"""Coordinates are whole multiples of this: exact in float32, so that tests of them are exact."""


_LINE = 1e-14
"""Area, in squares of the extent, below which a surface counts as a line."""
_SIMPLE = 16 * np.pi
"""Total curvature up to which a mesh is a simple shape: four times that of a sphere."""


class UnwrapOptions(TypedDict, total=False):
    """Keyword arguments of `unwrap`."""

    target: float
    """Mean symmetric Dirichlet energy to reach (4 keeps all lengths); fewer charts above. 4.03."""
    method: Method
    """"slim" never flips a face; the others are quick, and may flip and overlap."""
    engine: Engine
    """"monopart", or "xatlas" for comparison."""
    size: int
    """Texels along a side of the texture; 2048."""
    margin: float
    """Least distance of charts, texels; 4."""
    symmetric: bool
    """Mirror the seams of a mesh that has a mirror plane; True."""
    max_charts: int | None
    """Make no more charts than this for the sake of the target; no limit."""
    chart_share: float | None
    """Largest part of the surface in one chart: small charts pack tighter. None: by the target,
    for a simple shape a half."""


@dataclass(frozen=True, eq=False)
class UVLayout:
    """Texture coordinates of a mesh and what they are worth."""

    corner_uv: Float[Tensor, "F 3 2"]
    """Coordinates per face corner, in the unit square."""
    charts: Int[Tensor, "F"]
    """Chart of each face."""
    report: UVReport
    """Flips, overlaps, distortion, seams, packing."""

    @property
    def uv(self) -> UVMap:
        """The map, for look-up."""
        return UVMap(self.corner_uv)


_DEFAULTS = UnwrapOptions(
    target=4.03,
    method="slim",
    engine="monopart",
    size=2048,
    margin=4.0,
    symmetric=True,
    max_charts=None,
    chart_share=None,
)


def unwrap(
    verts: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    *,
    parts: Int[Tensor, "P"] | None = None,
    progress: Callable[[str, float], None] | None = None,
    **options: Unpack[UnwrapOptions],
) -> UVLayout:
    """Lay a mesh into the unit square, without a flipped face and without overlap.

    Edges of one face, of three and more, or between faces of opposite sense become seams first,
    so open, non-manifold and disjoint meshes are welcome. The same input gives the same layout.

    Args:
        verts: vertices, metres, finite.
        faces: vertex indices.
        parts: label of each face, (F); no chart crosses from one to another.
        progress: called with the name of a stage and the share of it that is done.
        **options: `UnwrapOptions`: target 4.03, method "slim", engine "monopart", size 2048,
            margin 4, symmetric True, max_charts None, chart_share None.

    Returns:
        Coordinates (dtype and device of `verts`; multiples of 2⁻²⁴), charts and report.

    Raises:
        InputError: empty or wrong faces, vertices that are not finite, unknown options.

    Reference:
        Rabinovich et al. 2017 (SLIM); Smith et al. 2019 (its Newton steps); Erickson and
        Whittlesey 2005 (cutting to a disc).

    >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    >>> faces = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    >>> report = unwrap(verts, faces).report
    >>> report.flips, report.overlaps
    (0, 0)
    """
    chosen = _checked(options)
    points, corners, labels = _arrays(verts, faces, parts)
    if chosen["engine"] == "xatlas":
        from .uv_xatlas import xatlas_layout

        corner_uv, chart = xatlas_layout(points, corners, labels, chosen["size"], chosen["margin"])
    else:
        corner_uv, chart = _layout(points, corners, labels, chosen, progress)
    corner_uv = np.round(corner_uv / GRID) * GRID
    report = report_of_arrays(points, corners, corner_uv, chosen["size"])
    return UVLayout(
        torch.from_numpy(corner_uv).to(verts), torch.from_numpy(chart).to(faces.device), report
    )


def _checked(options: UnwrapOptions) -> Any:
    unknown = sorted(set(options) - set(_DEFAULTS))
    if unknown:
        raise InputError(
            f"unwrap: expected options among {', '.join(_DEFAULTS)}, found {', '.join(unknown)}"
        )
    chosen = cast("dict[str, Any]", _DEFAULTS | options)
    for name, known in (
        ("method", ("slim", "arap", "lscm", "harmonic")),
        ("engine", ("monopart", "xatlas")),
    ):
        if chosen[name] not in known:
            raise InputError(f"{name}: expected one of {', '.join(known)}, found {chosen[name]!r}")
    if not chosen["target"] > 4:
        raise InputError(
            f"target: expected more than 4 (an isometry), found {chosen['target']}; 4.03 is usual"
        )
    if chosen["size"] < 16 or not 0 <= chosen["margin"] <= chosen["size"] / 16:
        raise InputError(
            f"size, margin: expected 16 texels or more and a margin of at most a sixteenth, found "
            f"{chosen['size']} and {chosen['margin']}; enlarge the texture"
        )
    chosen["margin"] = float(chosen["margin"])
    share = chosen["chart_share"]
    if share is not None and not 0 < share <= 1:
        raise InputError(f"chart_share: expected a number in (0, 1], found {chosen['chart_share']}")
    return chosen


def _arrays(
    verts: Tensor, faces: Tensor, parts: Tensor | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    points, corners = verts.detach().double().cpu().numpy(), faces.cpu().numpy().astype(np.int64)
    if len(corners) == 0:
        raise InputError("faces: expected at least one triangle, found none")
    if corners.min() < 0 or corners.max() >= len(points):
        raise InputError(
            f"faces: expected vertex indices 0..{len(points) - 1}, found {corners.min()}.."
            f"{corners.max()}; give the vertices that the faces name"
        )
    if not np.isfinite(points).all():
        raise InputError("verts: expected finite numbers, found NaN or infinity; clean the mesh")
    twice = (corners == np.roll(corners, -1, 1)).any(1)
    if twice.any():
        raise InputError(
            f"faces: expected three different vertices each, found face {int(np.argmax(twice))} "
            f"with one twice ({int(twice.sum())} such faces); remove them"
        )
    if parts is not None and parts.shape != (len(corners),):
        raise InputError(
            f"parts: expected one label per face, ({len(corners)},), found {tuple(parts.shape)}"
        )
    labels = np.zeros(len(corners), np.int64) if parts is None else parts.cpu().numpy()
    return points, corners, labels


def _unit(corners: np.ndarray) -> float:
    """The root of the area: a unit for every tolerance, whatever that of the input; 1 of a point.

    Of a line it is far above the root of what rounding leaves of the area.
    """
    extent = float(np.ptp(corners, axis=(0, 1)).max())
    if extent == 0:
        return 1.0
    span = 2.0 ** np.floor(np.log2(extent))  # changes no digit
    side = (corners[:, 1:] - corners[:, :1]) / span
    area = float(np.linalg.norm(np.cross(side[:, 0], side[:, 1]), axis=1).sum()) / 2
    return float(np.sqrt(max(area, _LINE)) * span)


def _layout(
    verts: np.ndarray,
    faces: np.ndarray,
    labels: np.ndarray,
    chosen: dict[str, Any],
    progress: Callable[[str, float], None] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Charts of our engine, packed."""
    from .uv_charts import atlas_by_method, first_atlas, shared_out
    from .uv_pack import packed
    from .uv_refine import refined
    from .uv_seams import Surface

    tell = progress or (lambda stage, share: None)
    places = (verts - verts[faces].mean((0, 1))) / _unit(verts[faces])
    tell("seams", 0.0)
    surface = Surface.of(places, faces, chosen["symmetric"])
    share = chosen["chart_share"]
    if share is None:
        # a simple shape needs few charts: small ones would only add seams
        simple = surface.curvature <= _SIMPLE
        share = 0.5 if simple else min(1.0, 0.15 * ((chosen["target"] - 4) / 0.03) ** 0.5)
    seams = shared_out(surface, surface.edges.seams_of_labels(labels), share)
    tell("flatten", 0.0)
    if chosen["method"] == "slim":
        atlas = refined(first_atlas(surface, seams), chosen["target"], chosen["max_charts"], tell)
    else:
        atlas = atlas_by_method(surface, seams, chosen["method"])
    tell("pack", 0.0)
    packing = packed(atlas.corner_uv, atlas.cut.chart, chosen["size"], chosen["margin"])
    uv = packing.place(atlas.uv, atlas.cut.vert_chart)
    tell("pack", 1.0)
    return uv[atlas.cut.faces], atlas.cut.chart
