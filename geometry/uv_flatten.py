"""First maps of discs into the plane: Tutte, harmonic, conformal, as rigid as possible, SLIM."""

from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from .uv_energy import RestShape, face_energy, flat_triangles
from .uv_mesh import CutMesh
from .uv_newton import factorised

Method = Literal["slim", "arap", "lscm", "harmonic"]
_SLIM_START = 12
_ARAP_STEPS = 20


def circle_border(cut: CutMesh, verts: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "W 2"]:
    """Coordinates of the border of each disc on a circle of the area of the disc, by arc length.

    Args:
        cut: the cut mesh; every chart is a disc.
        verts: vertices of the mesh.

    Returns:
        Coordinates of all vertices of the cut mesh, zero inside.
    """
    flat = flat_triangles(verts, cut.edges.faces)
    area = np.bincount(cut.chart, flat[:, 0, 0] * flat[:, 1, 1] / 2, minlength=cut.num_charts)
    uv = np.zeros((len(cut.origin), 2))
    for ring in cut.loops():
        points = verts[cut.origin[ring]]
        side = np.linalg.norm(np.roll(points, -1, 0) - points, axis=1)
        side = side + max(1e-3 * side.mean(), 1e-30)
        angle = 2 * np.pi * (np.cumsum(side) - side) / side.sum()
        radius = np.sqrt(area[cut.vert_chart[ring[0]]] / np.pi)
        uv[ring] = radius * np.stack([np.cos(angle), np.sin(angle)], 1)
    return uv


def corner_weights(flat: Float[np.ndarray, "F 2 2"], kind: str) -> Float[np.ndarray, "F 3 2"]:
    """Weights of the sides of each triangle, from corner k to k + 1 and back.

    Args:
        flat: triangles laid into the plane.
        kind: "uniform", "mean_value" or "cotangent".

    Returns:
        Weights; entry (f, k, 0) is for corner k, entry (f, k, 1) for corner k + 1.
    """
    if kind == "uniform":
        return np.full((len(flat), 3, 2), 0.5)
    points = np.concatenate([np.zeros((len(flat), 1, 2)), flat.transpose(0, 2, 1)], 1)
    side = np.roll(points, -1, 1) - points
    length = np.linalg.norm(side, axis=-1)
    double = np.maximum(flat[:, 0, 0] * flat[:, 1, 1], 1e-300)[:, None]
    back = -np.roll(side, 1, 1)
    dot = (side * back).sum(-1)  # at corner k, between the sides to k + 1 and to k − 1
    if kind == "cotangent":
        half = np.roll(dot, -2, 1) / double / 2  # the corner opposite to side k
        return np.stack([half, half], -1)
    # tan(angle / 2) = (|a||b| − a·b) / (a × b), for either end of a side
    half_tan = (length * np.roll(length, 1, 1) - dot) / double
    here, there = half_tan / length, np.roll(half_tan, -1, 1) / length
    return np.stack([here, there], -1)


def laplacian(
    faces: Int[np.ndarray, "F 3"], count: int, flat: Float[np.ndarray, "F 2 2"], kind: str
) -> Any:
    """Sparse Laplacian over the vertices of a mesh; rows sum to zero.

    Args:
        faces: vertex indices.
        count: number of vertices.
        flat: the triangles laid into the plane.
        kind: of the weights.

    Returns:
        A `scipy.sparse.csc_matrix`, symmetric but for mean-value weights.
    """
    from scipy.sparse import coo_matrix, diags

    weight = corner_weights(flat, kind)
    start, end = faces.reshape(-1), np.roll(faces, -1, 1).reshape(-1)
    values = np.concatenate([weight[..., 0].reshape(-1), weight[..., 1].reshape(-1)])
    rows, cols = np.concatenate([start, end]), np.concatenate([end, start])
    matrix = coo_matrix((values, (rows, cols)), (count, count)).tocsc()
    return diags(np.asarray(matrix.sum(1)).ravel()) - matrix


def harmonic_map(
    cut: CutMesh, verts: Float[np.ndarray, "V 3"], kind: str = "cotangent"
) -> Float[np.ndarray, "W 2"]:
    """Each disc onto a circle: the border by arc length, the inside in equilibrium.

    Args:
        cut: the cut mesh; every chart is a disc.
        verts: vertices of the mesh.
        kind: of the weights; those of "uniform" and "mean_value" are positive and allow no flip.

    Returns:
        Coordinates of the vertices of the cut mesh.

    Reference:
        Tutte 1963; Floater 2003 (mean value).
    """
    uv = circle_border(cut, verts)
    inside = np.flatnonzero(cut.loop < 0)
    if len(inside) == 0:
        return uv
    matrix = laplacian(cut.faces, len(uv), flat_triangles(verts, cut.edges.faces), kind).tocsr()[
        inside
    ]
    ring = np.flatnonzero(cut.loop >= 0)
    right = -(matrix[:, ring] @ uv[ring])
    inner = matrix[:, inside].tocsc()
    uv[inside] = _solve(inner, right)
    return uv


def smoothed_inside(
    cut: CutMesh, flat: Float[np.ndarray, "F 2 2"], uv: Float[np.ndarray, "W 2"], free: np.ndarray
) -> Float[np.ndarray, "W 2"]:
    """Some vertices inside discs brought into equilibrium, the others held.

    Args:
        cut: the cut mesh.
        flat: its triangles laid into the plane.
        uv: coordinates of its vertices.
        free: mask of the vertices; those on the border are held too.

    Returns:
        Coordinates.

    Reference:
        Floater 2003 (mean value).
    """
    free = free & (cut.loop < 0)
    rows = np.flatnonzero(free[cut.faces].any(1))
    if len(rows) == 0:
        return uv
    used, local = np.unique(cut.faces[rows], return_inverse=True)
    matrix = laplacian(local.reshape(-1, 3), len(used), flat[rows], "mean_value").tocsr()
    inside = free[used]
    matrix = matrix[inside]
    out = uv.copy()
    out[used[inside]] = _solve(matrix[:, inside].tocsc(), -(matrix[:, ~inside] @ uv[used[~inside]]))
    return out


def _solve(matrix: Any, right: np.ndarray) -> np.ndarray:
    factors = factorised(matrix)
    out = factors.solve(right)
    # one correction: what is left of the residual decides whether tiny triangles flip
    return out + factors.solve(right - matrix @ out)


def disc_of(
    cut: CutMesh, chart: int, verts: Float[np.ndarray, "V 3"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One chart as a mesh of its own.

    Args:
        cut: the cut mesh.
        chart: number of the chart.
        verts: vertices of the mesh.

    Returns:
        Its vertices of the cut mesh (n), their places (n, 3), its faces in them (m, 3).
    """
    faces = cut.faces[cut.chart == chart]
    used, local = np.unique(faces, return_inverse=True)
    return used, verts[cut.origin[used]], local.reshape(-1, 3)


def slim_start(
    cut: CutMesh, verts: Float[np.ndarray, "V 3"], uv: Float[np.ndarray, "W 2"], charts: np.ndarray
) -> Float[np.ndarray, "W 2"]:
    """A few iterations of libigl's SLIM on some charts, from coordinates without a flip.

    Args:
        cut: the cut mesh.
        verts: vertices of the mesh.
        uv: coordinates of its vertices.
        charts: numbers of the charts.

    Returns:
        New coordinates; a chart that SLIM made worse keeps the old ones.

    Reference:
        Rabinovich, Poranne, Panozzo and Sorkine-Hornung 2017.
    """
    import igl

    out, rest = uv.copy(), RestShape.of(verts, cut.edges.faces)
    for chart in charts:
        used, places, faces = disc_of(cut, int(chart), verts)
        data = igl.slim_precompute(
            np.asfortranarray(places),
            np.asfortranarray(faces.astype(np.int32)),
            np.asfortranarray(uv[used]),
            igl.MappingEnergyType.SYMMETRIC_DIRICHLET,
            np.zeros(0, np.int32),
            np.zeros((0, 2), order="F"),
            0.0,
        )
        found = np.asarray(igl.slim_solve(data, _SLIM_START))[:, :2]
        jacobian = rest.of_faces(cut.chart == chart).jacobians(found[faces])
        if np.isfinite(face_energy(jacobian)).all():
            out[used] = found
    return out


def lscm_map(cut: CutMesh, verts: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "W 2"]:
    """Least-squares conformal maps by libigl, two far border vertices held; may flip faces.

    Args:
        cut: the cut mesh; every chart is a disc.
        verts: vertices of the mesh.

    Returns:
        Coordinates, each chart scaled to its area.
    """
    import igl

    uv = circle_border(cut, verts)
    for ring in cut.loops():
        used, places, faces = disc_of(cut, int(cut.vert_chart[ring[0]]), verts)
        local = np.searchsorted(used, ring)
        first = local[0]
        far = local[int(np.linalg.norm(places[local] - places[first], axis=1).argmax())]
        held = np.array([first, far], np.int64)
        gap = max(float(np.linalg.norm(places[far] - places[first])), 1e-30)
        found, _ = igl.lscm(places, faces.astype(np.int64), held, np.array([[0.0, 0], [gap, 0]]))
        uv[used] = _to_area(np.asarray(found), places, faces)
    return uv


def arap_map(cut: CutMesh, verts: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "W 2"]:
    """As-rigid-as-possible maps, from the harmonic one; may flip faces.

    Args:
        cut: the cut mesh; every chart is a disc.
        verts: vertices of the mesh.

    Returns:
        Coordinates.

    Reference:
        Liu et al. 2008, A local/global approach to mesh parameterization.
    """
    from scipy.sparse import diags

    flat = flat_triangles(verts, cut.edges.faces)
    rest = np.concatenate([np.zeros((len(flat), 1, 2)), flat.transpose(0, 2, 1)], 1)
    side = np.roll(rest, -1, 1) - rest
    weight = corner_weights(flat, "cotangent")[..., 0]
    matrix = laplacian(cut.faces, len(cut.origin), flat, "cotangent")
    hold = 1e-8 * np.abs(matrix.diagonal()).mean()
    factors = factorised((matrix + diags(np.full(len(cut.origin), hold))).tocsc())
    uv = harmonic_map(cut, verts)
    for _ in range(_ARAP_STEPS):
        now = np.roll(uv[cut.faces], -1, 1) - uv[cut.faces]
        cross = np.einsum("fk,fki,fkj->fij", weight, now, side)
        # the nearest rotation in the plane, by the angle of the conformal part
        angle = np.arctan2(cross[:, 1, 0] - cross[:, 0, 1], cross[:, 0, 0] + cross[:, 1, 1])
        cos, sin = np.cos(angle), np.sin(angle)
        turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
        pull = weight[..., None] * np.einsum("fij,fkj->fki", turn, side)
        right = hold * uv
        for axis in range(2):
            values = np.roll(pull[..., axis], 1, 1) - pull[..., axis]
            right[:, axis] += np.bincount(cut.faces.reshape(-1), values.reshape(-1), len(uv))
        uv = factors.solve(right)
    return uv


def _to_area(uv: np.ndarray, places: np.ndarray, faces: np.ndarray) -> np.ndarray:
    flat = flat_triangles(places, faces)
    wanted = float((flat[:, 0, 0] * flat[:, 1, 1]).sum())
    side = uv[faces[:, 1:]] - uv[faces[:, :1]]
    got = abs(float((side[:, 0, 0] * side[:, 1, 1] - side[:, 0, 1] * side[:, 1, 0]).sum()))
    return uv * np.sqrt(wanted / got) if got > 0 else uv


def flipped_charts(cut: CutMesh, uv: Float[np.ndarray, "W 2"]) -> Int[np.ndarray, "n"]:
    """Charts that hold a face of no or negative area.

    Args:
        cut: the cut mesh.
        uv: coordinates of its vertices.

    Returns:
        Numbers of the charts.
    """
    side = uv[cut.faces[:, 1:]] - uv[cut.faces[:, :1]]
    det = side[:, 0, 0] * side[:, 1, 1] - side[:, 0, 1] * side[:, 1, 0]
    size = np.abs(side).max((1, 2)) ** 2
    return np.unique(cut.chart[~(det > 1e-12 * size)])
