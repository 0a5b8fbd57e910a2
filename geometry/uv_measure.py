"""What a UV layout is worth: flips, overlaps, distortion, seams, packing, texel density."""

from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from .errors import InputError
from .uv_energy import RestShape, singular_values
from .uv_mesh import MeshEdges, components
from .uv_overlap import face_signs, overlapping_pairs


@dataclass(frozen=True)
class UVReport:
    """Figures of a layout; means and percentiles are weighted by area on the surface."""

    charts: int
    """Number of charts: faces joined by edges that are no seams."""
    flips: int
    """Faces of no or negative area in the texture, exact."""
    overlaps: int
    """Pairs of faces that share area in the texture, exact."""
    angle_mean: float
    """Mean ratio of the larger to the smaller stretch; 1 keeps angles."""
    angle_p99: float
    """Its 99th percentile."""
    area_mean: float
    """Mean factor by which areas differ from the common scale, up or down; 1 keeps areas."""
    area_p99: float
    """Its 99th percentile."""
    symmetric_dirichlet: float
    """Mean of |J|² + |J⁻¹|² at the best common scale; 4 keeps all lengths, infinite with flips."""
    seam_length: float
    """Length of the edges on the surface whose two sides lie apart, and of borders, metres."""
    packing: float
    """Share of the unit square that faces cover."""
    texels_per_metre: float
    """Texels of the texture per metre on the surface, square root of the ratio of areas."""
    size: int
    """Texels along a side of the texture, of which the density speaks."""

    def to_dict(self) -> dict[str, int | float]:
        """The figures by name, for JSON."""
        return asdict(self)


def uv_report(
    verts: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    corner_uv: Float[Tensor, "F 3 2"],
    size: int = 2048,
) -> UVReport:
    """Measure a layout, ours or another's.

    Args:
        verts: vertices, metres.
        faces: vertex indices.
        corner_uv: coordinates per face corner.
        size: texels along a side of the texture.

    Returns:
        The figures.

    Raises:
        InputError: shapes that do not agree, or coordinates that are not finite.

    >>> import torch
    >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> faces = torch.tensor([[0, 1, 2]])
    >>> report = uv_report(verts, faces, verts[faces][..., :2] / 2)
    >>> report.charts, report.flips, round(report.symmetric_dirichlet, 3), report.packing
    (1, 0, 4.0, 0.125)
    """
    if corner_uv.shape != (len(faces), 3, 2):
        raise InputError(
            f"corner_uv: expected ({len(faces)}, 3, 2), as many rows as faces, found "
            f"{tuple(corner_uv.shape)}; pass one pair for each corner of each face"
        )
    if not bool(corner_uv.isfinite().all()):
        raise InputError("corner_uv: expected finite numbers, found NaN or infinity; unwrap again")
    return report_of_arrays(
        verts.detach().double().cpu().numpy(),
        faces.cpu().numpy(),
        corner_uv.detach().double().cpu().numpy(),
        size,
    )


def report_of_arrays(
    verts: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    corner_uv: Float[np.ndarray, "F 3 2"],
    size: int,
) -> UVReport:
    """The same for arrays.

    Args:
        verts: vertices, metres.
        faces: vertex indices.
        corner_uv: coordinates per face corner, finite.
        size: texels along a side of the texture.

    Returns:
        The figures.
    """
    edges = MeshEdges.of(faces)
    seams = seams_of_layout(edges, corner_uv)
    pairs = edges.face_pairs[~seams]
    chart = components(len(faces), pairs[:, 0], pairs[:, 1])
    side = verts[edges.verts[:, 0]] - verts[edges.verts[:, 1]]
    figures = distortion(verts, faces, corner_uv)
    edge1, edge2 = corner_uv[:, 1] - corner_uv[:, 0], corner_uv[:, 2] - corner_uv[:, 0]
    uv_area = np.abs(edge1[:, 0] * edge2[:, 1] - edge1[:, 1] * edge2[:, 0]).sum() / 2
    area = RestShape.of(verts, faces).area.sum()
    density = size * float(np.sqrt(uv_area / area)) if len(faces) else 0.0
    return UVReport(
        charts=int(chart.max(initial=-1)) + 1,
        flips=int((face_signs(corner_uv) <= 0).sum()),
        overlaps=len(overlapping_pairs(corner_uv)),
        **figures,
        seam_length=float(np.linalg.norm(side, axis=1)[seams].sum()),
        packing=float(uv_area),
        texels_per_metre=density,
        size=size,
    )


def seams_of_layout(edges: MeshEdges, corner_uv: Float[np.ndarray, "F 3 2"]) -> np.ndarray:
    """Edges whose two sides lie apart in the texture, and those that join no two faces.

    Args:
        edges: of the mesh.
        corner_uv: coordinates per face corner.

    Returns:
        Mask of the edges.
    """
    seams = ~edges.joinable
    flat = corner_uv.reshape(-1, 2)
    half = edges.sides[~seams]
    after = half - half % 3 + (half + 1) % 3
    same = (flat[half[:, 0]] == flat[after[:, 1]]) & (flat[after[:, 0]] == flat[half[:, 1]])
    seams[~seams] = ~same.all(1)
    return seams


def distortion(
    verts: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    corner_uv: Float[np.ndarray, "F 3 2"],
) -> dict[str, float]:
    """Distortion of a layout at its best common scale.

    Args:
        verts: vertices.
        faces: vertex indices.
        corner_uv: coordinates per face corner.

    Returns:
        The figures of `UVReport` that speak of distortion.
    """
    names = ("angle_mean", "angle_p99", "area_mean", "area_p99")
    if len(faces) == 0:
        return dict.fromkeys((*names, "symmetric_dirichlet"), 0.0)
    rest = RestShape.of(verts, faces)
    large, small = singular_values(rest.jacobians(corner_uv))
    weight = rest.area / rest.area.sum()
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        angle = np.where(small > 0, large / small, np.inf)
        stretch = (weight * (large**2 + small**2)).sum()
        shrink = (weight * np.where(small > 0, 1 / large**2 + 1 / small**2, np.inf)).sum()
        ratio = np.abs(large * small) * shrink_scale(stretch, shrink)
        area = np.maximum(ratio, 1 / ratio)
        energy = float(2 * np.sqrt(stretch * shrink))
    figures = [weighted_mean(angle, weight), weighted_quantile(angle, weight, 0.99)]
    figures += [weighted_mean(area, weight), weighted_quantile(area, weight, 0.99)]
    return dict(zip(names, figures, strict=True)) | {"symmetric_dirichlet": energy}


def shrink_scale(stretch: float, shrink: float) -> float:
    """Square of the factor that brings a layout to its best scale.

    Args:
        stretch: mean of |J|².
        shrink: mean of |J⁻¹|².

    Returns:
        The factor of areas; where a face is flipped, that which makes the mean of |J|² two.
    """
    return float(np.sqrt(shrink / stretch)) if np.isfinite(shrink) else 2.0 / max(stretch, 1e-300)


def weighted_mean(values: np.ndarray, weight: np.ndarray) -> float:
    """Mean of the finite values; infinite ones are told by the flips.

    Args:
        values: numbers.
        weight: of each.

    Returns:
        The mean.
    """
    good = np.isfinite(values)
    return float((values[good] * weight[good]).sum() / max(weight[good].sum(), 1e-300))


def weighted_quantile(values: np.ndarray, weight: np.ndarray, share: float) -> float:
    """Value that a share of the weight does not exceed.

    Args:
        values: numbers.
        weight: of each.
        share: in [0, 1].

    Returns:
        The value.
    """
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    return float(values[order][min(np.searchsorted(total, share * total[-1]), len(order) - 1)])
