"""Closest surface point and nearest vertex: ours and the libraries that people use for them.

An adapter gets a `SurfaceData`, builds its structure, and offers ``query`` (faces and
barycentrics) and, where the library can, ``update`` (other vertices).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np

from monopart.geometry.surface import SurfaceIndex

from .bodies import SurfaceData, barycentrics
from .registry import Method, load, load_open3d

Found = tuple[np.ndarray, np.ndarray]
"""Faces [N] and barycentrics [N, 3]."""


class Peer(ABC):
    """A search structure of some library."""

    @abstractmethod
    def __init__(self, data: SurfaceData) -> None:
        """Build it."""

    @abstractmethod
    def update(self, verts: Any) -> None:
        """Move the vertices."""

    @abstractmethod
    def query(self) -> Any:
        """Search all points."""


def _single(data: SurfaceData) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return data.points.numpy(), data.verts.numpy(), data.faces.numpy()


class Ours(Peer):
    """`monopart.geometry.surface.SurfaceIndex`."""

    backend = "auto"

    def __init__(self, data: SurfaceData) -> None:
        """Build the tree."""
        self.points = data.points
        self.index = SurfaceIndex(data.verts, data.faces, self.backend)

    def update(self, verts: Any) -> None:
        """Refit the tree."""
        self.index.refit(verts)

    def query(self) -> Found:
        """Faces and barycentrics."""
        hit = self.index.query(self.points)
        return hit.face.numpy(), hit.bary.numpy()


class OursPlain(Ours):
    """The brute-force reference in plain torch."""

    backend = "torch"


class WarpPlain(Peer):
    """Warp's own mesh query on one thread."""

    def __init__(self, data: SurfaceData) -> None:
        """Build the tree."""
        from .warp_plain import PlainMesh

        points, verts, faces = _single(data)
        self.mesh = PlainMesh(verts, faces, points)

    def update(self, verts: Any) -> None:
        """Refit the tree."""
        self.mesh.update(verts.numpy())

    def query(self) -> Found:
        """Faces and barycentrics."""
        face, two = self.mesh.query()
        return face, np.concatenate([two, 1.0 - two.sum(1, keepdims=True)], 1)


class Open3D(Peer):
    """Open3D's ray-casting scene (Embree)."""

    def __init__(self, data: SurfaceData) -> None:
        """Build the scene."""
        self.o3d = load_open3d()
        points, verts, faces = _single(data)
        self.points = self.o3d.core.Tensor(points)
        self.faces = self.o3d.core.Tensor(faces.astype(np.uint32))
        self._build(verts)

    def _build(self, verts: np.ndarray) -> None:
        self.scene = self.o3d.t.geometry.RaycastingScene()
        self.scene.add_triangles(self.o3d.core.Tensor(verts), self.faces)

    def update(self, verts: Any) -> None:
        """Build anew: the scene has no refit."""
        self._build(verts.numpy())

    def query(self) -> Found:
        """Faces and barycentrics."""
        found = self.scene.compute_closest_points(self.points)
        two = found["primitive_uvs"].numpy()
        bary = np.concatenate([1.0 - two.sum(1, keepdims=True), two], 1)
        return found["primitive_ids"].numpy(), bary


class Libigl(Peer):
    """libigl's tree in double precision."""

    def __init__(self, data: SurfaceData) -> None:
        """Build the tree."""
        self.igl = load("igl")
        self.points, verts, faces = data.arrays
        self.faces = faces
        self._build(verts)

    def _build(self, verts: np.ndarray) -> None:
        self.verts = np.ascontiguousarray(verts, dtype=np.float64)
        self.tree = self.igl.AABB()
        self.tree.init(self.verts, self.faces)

    def update(self, verts: Any) -> None:
        """Build anew: the tree has no refit."""
        self._build(verts.numpy())

    def query(self) -> Found:
        """Faces and barycentrics."""
        _, face, on = self.tree.squared_distance(self.verts, self.faces, self.points)
        return face, barycentrics(on, self.verts[self.faces[face]])


class Trimesh(Peer):
    """trimesh's proximity query over an R-tree."""

    def __init__(self, data: SurfaceData) -> None:
        """Build the tree."""
        self.trimesh = load("trimesh")
        self.points, verts, self.faces = data.arrays
        self._build(verts)

    def _build(self, verts: np.ndarray) -> None:
        self.mesh = self.trimesh.Trimesh(verts, self.faces, process=False)
        _ = self.mesh.triangles_tree

    def update(self, verts: Any) -> None:
        """Build anew: a mesh drops its tree when its vertices move."""
        self._build(verts.double().numpy())

    def query(self) -> Found:
        """Faces and barycentrics."""
        on, _, face = self.trimesh.proximity.closest_point(self.mesh, self.points)
        return face, self.trimesh.triangles.points_to_barycentric(self.mesh.triangles[face], on)


class Fcpw(Peer):
    """FCPW with a vectorised tree; the result stays in its own list."""

    def __init__(self, data: SurfaceData) -> None:
        """Build the scene."""
        self.fcpw = load("fcpw")
        points, verts, faces = _single(data)
        self.count = len(points)
        self.points = np.asfortranarray(points)
        self.radii = np.full(len(points), np.inf, np.float32)
        self.faces = np.asfortranarray(faces.astype(np.int32))
        self._build(verts)

    def _build(self, verts: np.ndarray) -> None:
        self.scene = self.fcpw.scene_3D()
        self.scene.set_object_count(1)
        self.scene.set_object_vertices(np.asfortranarray(verts), 0)
        self.scene.set_object_triangles(self.faces, 0)
        self.scene.build(self.fcpw.aggregate_type.bvh_surface_area, True)

    def update(self, verts: Any) -> None:
        """Build anew: faster than its refit through Python lists."""
        self._build(verts.numpy())

    def query(self) -> Any:
        """FCPW's list of interactions, not read out."""
        found = self.fcpw.interaction_3D_list()
        self.scene.find_closest_points(self.points, self.radii, found)
        return found


class FcpwRead(Fcpw):
    """FCPW, its results read out one by one, as its Python interface wants it."""

    def query(self) -> Found:
        """Faces and barycentrics."""
        return read_fcpw(super().query())


def read_fcpw(found: Any) -> Found:
    """Faces and barycentrics of a list of interactions."""
    face = np.array([hit.primitive_index for hit in found], np.int64)
    two = np.array([hit.uv for hit in found]).reshape(-1, 2)
    return face, np.concatenate([two, 1.0 - two.sum(1, keepdims=True)], 1)


def _query(adapter: type[Peer]) -> Callable[[Any], Callable[[], Any]]:
    def prepare(data: SurfaceData) -> Callable[[], Any]:
        return adapter(data).query

    return prepare


def _moving(adapter: type[Peer]) -> Callable[[Any], Callable[[], Any]]:
    """Other vertices and a query, the structure built for those of another pose."""

    def prepare(data: SurfaceData) -> Callable[[], Any]:
        peer = adapter(data)
        peer.update(data.other)

        def call() -> Any:
            peer.update(data.verts)
            return peer.query()

        return call

    return prepare


def surface_methods(moving: bool = False) -> tuple[Method, ...]:
    """Methods of the closest surface point, for still or for moving vertices."""
    wrap = _moving if moving else _query
    small = 40_000
    slow = Method(
        *("monopart torch (reference)", wrap(OursPlain)), ours=True, largest=1024, single=True
    )
    return (
        Method("monopart", wrap(Ours), ours=True),
        *(() if moving else (slow,)),
        Method("Warp, plain query", wrap(WarpPlain), ("warp",), "pip install warp-lang"),
        Method("Open3D", wrap(Open3D), ("open3d",), "pip install open3d"),
        Method("libigl (float64)", wrap(Libigl), ("igl",), "pip install libigl"),
        Method(
            "trimesh",
            wrap(Trimesh),
            ("trimesh", "rtree"),
            "pip install trimesh rtree",
            largest=small,
            rare=True,
        ),
        Method(
            *("fcpw", wrap(Fcpw), ("fcpw",), "pip install fcpw"),
            read=read_fcpw,
        ),
        Method(
            *("fcpw, read out", wrap(FcpwRead), ("fcpw",), "pip install fcpw"),
            largest=small,
        ),
    )


def judge_surface(data: SurfaceData, found: Found) -> dict[str, float]:
    """How much farther than the exact closest point the reported point lies, metres."""
    face, bary = (np.asarray(x) for x in found)
    points, verts, faces = data.arrays
    on = (bary.astype(np.float64)[..., None] * verts[faces[face.astype(np.int64)]]).sum(1)
    gap = np.abs(np.linalg.norm(points - on, axis=1) - data.distance)
    return {"error": float(gap.max())}


def nearest_methods() -> tuple[Method, ...]:
    """Methods of the nearest vertex; the closest surface point stands beside them."""
    return (
        Method("monopart closest surface", _query(Ours), ours=True),
        Method("scipy cKDTree", _scipy, ("scipy",), "pip install scipy"),
        Method("pykdtree", _pykdtree, ("pykdtree",), "pip install pykdtree"),
        Method("Open3D nearest neighbour", _open3d_nearest, ("open3d",), "pip install open3d"),
        Method("torch cdist", _cdist, largest=40_000),
    )


def _scipy(data: SurfaceData) -> Callable[[], Any]:
    tree = load("scipy.spatial").cKDTree(data.verts.numpy())
    points = data.points.numpy()
    return lambda: tree.query(points)[1]


def _pykdtree(data: SurfaceData) -> Callable[[], Any]:
    tree = load("pykdtree.kdtree").KDTree(data.verts.numpy())
    points = data.points.numpy()
    return lambda: tree.query(points)[1].astype(np.int64)


def _open3d_nearest(data: SurfaceData) -> Callable[[], Any]:
    core = load_open3d().core
    search = core.nns.NearestNeighborSearch(core.Tensor(data.verts.numpy()))
    search.knn_index()
    points = core.Tensor(data.points.numpy())
    return lambda: search.knn_search(points, 1)[0].numpy()[:, 0]


def _cdist(data: SurfaceData) -> Callable[[], Any]:
    import torch

    def call() -> np.ndarray:
        best = [torch.cdist(part, data.verts).argmin(1) for part in data.points.split(2048)]
        return torch.cat(best).numpy()

    return call


def judge_nearest(data: SurfaceData, found: Any) -> dict[str, float]:
    """Mean distance, beyond the exact one, of what was found, and how wrong its weights are."""
    points, verts, faces = data.arrays
    weights = data.body.weights.double().numpy()
    if isinstance(found, tuple):
        face, bary = found[0], found[1].astype(np.float64)
        on = (bary[..., None] * verts[faces[face]]).sum(1)
        own = (bary[..., None] * weights[faces[face]]).sum(1)
    else:
        on, own = verts[found], weights[found]
    gap = np.linalg.norm(points - on, axis=1) - data.distance
    variation = 0.5 * np.abs(own - data.nearest_weights).sum(1)
    return {
        "error": float(np.abs(gap).mean()),
        "weights p99": float(np.quantile(variation, 0.99)),
    }
