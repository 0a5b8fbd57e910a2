"""xatlas as an engine for comparison."""

import numpy as np
from jaxtyping import Float, Int

from .uv_mesh import components


def xatlas_layout(
    verts: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    labels: Int[np.ndarray, "F"],
    size: int,
    margin: float,
) -> tuple[Float[np.ndarray, "F 3 2"], Int[np.ndarray, "F"]]:
    """Charts and packing of xatlas, one mesh per label.

    Args:
        verts: vertices.
        faces: vertex indices.
        labels: part of each face.
        size: texels along a side.
        margin: least distance of charts, texels.

    Returns:
        Coordinates per face corner in the unit square, and the chart of each face.
    """
    import xatlas

    atlas = xatlas.Atlas()
    rows = [np.flatnonzero(labels == label) for label in np.unique(labels)]
    for own in rows:
        used, local = np.unique(faces[own], return_inverse=True)
        atlas.add_mesh(verts[used].astype(np.float32), local.reshape(-1, 3).astype(np.uint32))
    charts = xatlas.ChartOptions()
    charts.fix_winding = True
    pack = xatlas.PackOptions()
    pack.padding = int(np.ceil(margin))
    pack.resolution = size
    # what xatlas calls a rotation swaps u and v, which turns the chart over
    pack.rotate_charts = False
    atlas.generate(charts, pack, False)
    corner = np.zeros((len(faces), 3, 2))
    ids = np.zeros((len(faces), 3), np.int64)
    start = 0
    # xatlas divides u by the width and v by the height: undone, then one common scale
    shape = np.array([atlas.width, atlas.height], float)
    for number, own in enumerate(rows):
        _, index, uv = atlas.get_mesh(number)
        corner[own] = uv[index].astype(np.float64) * shape / shape.max()
        ids[own] = index + start
        start += len(uv)
    chart = components(start, ids[:, [0, 1]].reshape(-1), ids[:, [1, 2]].reshape(-1))[ids[:, 0]]
    return corner, np.unique(chart, return_inverse=True)[1]
