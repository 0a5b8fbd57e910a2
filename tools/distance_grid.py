"""Distances to a mesh on a grid, with bounds that hold at every point, not only at the nodes.

A distance changes by at most the length of a step. So a value at a node bounds all others, and the
interpolation of the eight nodes of a cell is off by at most √3/2 of the spacing: it is a mean of
values, each off by at most the way to its node, and by Jensen Σ bᵢ |x − xᵢ| ≤ √(Σ bᵢ |x − xᵢ|²) =
h √(Σ t(1 − t)) over the three axes, at most h √3/2.
"""

import io
import math
import os
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from monopart.geometry.atomic import write_bytes
from monopart.geometry.errors import InputError
from monopart.geometry.mesh_graph import weld_by_place
from monopart.geometry.weight_transfer import closest_faces

from .meshio import Mesh
from .topology import topology

_CHUNK = 1 << 17
_LARGEST = 1 << 28  # nodes
Progress = Callable[[int, int], None]
"""Called with how many nodes are done and how many there are."""


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """Distances at the nodes of a grid, and between them with bounds.

    Attributes:
        origin: [3] place of the first node.
        spacing: distance of neighbouring nodes.
        values: [X, Y, Z] distances at the nodes, float32.
        signed: negative inside; else all are ≥ 0.
    """

    origin: Float[np.ndarray, "3"]
    spacing: float
    values: Float[np.ndarray, "X Y Z"]
    signed: bool

    @property
    def rounding(self) -> float:
        """How far a stored value may be off by its digits."""
        # half a unit in the last place, and as much again for the arithmetic of a query
        return float(np.abs(self.values).max(initial=0.0)) * 2.0**-23

    @property
    def bound(self) -> float:
        """No interpolated value inside the grid is off by more."""
        return math.sqrt(3) / 2 * self.spacing + self.rounding

    def query(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
        """Distance of points, and what it is at least and at most.

        Args:
            points: anywhere; outside the grid bounds are wider and the value is their middle.

        Returns:
            Interpolated distance, lower bound and upper bound; the true one is between them.
        """
        shape = np.array(self.values.shape)
        place = (points - self.origin) / self.spacing
        cell = np.clip(np.floor(place), 0, np.maximum(shape - 2, 0)).astype(np.int64)
        share = place - cell
        lower, upper = np.full(len(points), -np.inf), np.full(len(points), np.inf)
        value = np.zeros(len(points))
        for corner in np.ndindex(2, 2, 2):
            node = np.minimum(cell + corner, shape - 1)
            stored = self.values[tuple(node.T)].astype(np.float64)
            way = np.linalg.norm(points - (self.origin + self.spacing * node), axis=1)
            lower = np.maximum(lower, stored - way)
            upper = np.minimum(upper, stored + way)
            value += stored * np.where(corner, share, 1 - share).prod(1)
        lower, upper = lower - self.rounding, upper + self.rounding
        lower = lower if self.signed else np.maximum(lower, 0.0)
        outside = ((share < 0) | (share > 1)).any(1)
        value = np.where(outside, 0.5 * (lower + upper), np.clip(value, lower, upper))
        return value, lower, upper

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the grid as npz, whole or not at all."""
        buffer = io.BytesIO()
        arrays = {"origin": self.origin, "spacing": self.spacing, "values": self.values}
        np.savez_compressed(buffer, signed=self.signed, bound=self.bound, **arrays)
        return write_bytes(path, buffer.getvalue())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "DistanceGrid":
        """Read what `save` wrote; nothing in it is executed."""
        try:
            with np.load(io.BytesIO(Path(path).read_bytes()), allow_pickle=False) as file:
                values = file["values"]
                origin, spacing = file["origin"].astype(np.float64), float(file["spacing"])
                signed = bool(file["signed"])
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(
                f"{path}: expected a distance grid as written by bake, found none ({error})"
            ) from error
        fits = values.ndim == 3 and origin.shape == (3,) and min(values.shape) > 0
        if not fits or values.dtype != np.float32 or not spacing > 0:
            raise InputError(
                f"{path}: expected a grid of float32 of three axes, found {values.dtype} "
                f"{values.shape}; bake it again"
            )
        return cls(origin, spacing, values, signed)


def _check_closed(mesh: Mesh) -> None:
    shape = topology(weld_by_place(mesh.verts)[mesh.faces], mesh.num_verts)
    faults = len(shape.open_edges) + len(shape.turned_edges) + len(shape.branching_edges)
    if faults:
        raise InputError(
            f"{mesh.name}: faces: expected a closed surface, wound one way, for signed distances, "
            f"found {faults} edges that are open, turned or branching; mend it or ask for "
            "unsigned ones"
        )


def distance_grid(
    mesh: Mesh,
    spacing: float,
    *,
    margin: float = 0.1,
    signed: bool = True,
    progress: Progress | None = None,
) -> DistanceGrid:
    """Distances to a mesh at the nodes of a grid around it, exact in float64 and then rounded.

    Args:
        mesh: finite, with faces.
        spacing: distance of neighbouring nodes, in the unit of the mesh.
        margin: how far the grid reaches beyond the box of the mesh.
        signed: negative inside; the mesh must be closed and wound one way.
        progress: called after every piece of the work.

    Returns:
        The grid.

    Raises:
        InputError: a damaged or open mesh, a spacing that is not positive, or too many nodes.

    >>> flat = Mesh(np.eye(3), np.array([[0, 1, 2]]))
    >>> grid = distance_grid(flat, 0.5, signed=False)
    >>> round(grid.bound, 3)
    0.433
    """
    mesh.require()
    if not (math.isfinite(spacing) and spacing > 0 and math.isfinite(margin) and margin >= 0):
        raise InputError(
            f"spacing, margin: expected a positive spacing and a margin ≥ 0, found {spacing} and "
            f"{margin}; give lengths in the unit of the mesh"
        )
    used = mesh.verts[mesh.faces].reshape(-1, 3)
    low, high = used.min(0) - margin, used.max(0) + margin
    shape = np.ceil((high - low) / spacing) + 1
    if not shape.prod() <= _LARGEST:
        raise InputError(
            f"spacing: expected a grid of at most {_LARGEST} nodes, found {shape.prod():.3g}; "
            "take a larger spacing"
        )
    if signed:
        _check_closed(mesh)
    size = tuple(int(n) for n in shape)
    values = np.zeros(size, np.float32)
    flat = values.reshape(-1)
    for start in range(0, flat.size, _CHUNK):
        index = np.arange(start, min(start + _CHUNK, flat.size))
        nodes = low + spacing * np.stack(np.unravel_index(index, size), 1)
        flat[index] = _distances(mesh, nodes, signed)
        if progress is not None:
            progress(int(index[-1]) + 1, flat.size)
    return DistanceGrid(low, float(spacing), values, signed)


def _distances(mesh: Mesh, points: np.ndarray, signed: bool) -> np.ndarray:
    import igl

    distance = closest_faces(points, mesh.verts, mesh.faces)[2]
    if not signed:
        return distance
    turns = igl.fast_winding_number(mesh.verts, mesh.faces, np.ascontiguousarray(points))
    # closed: whole numbers but for rounding, and of either sign for a mesh that is inside out
    return np.where(np.abs(turns) > 0.5, -distance, distance)
