"""Warp's own closest-point query, written as its documentation does: a peer of our kernels."""

from typing import Any, no_type_check

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})


@no_type_check
@wp.kernel
def plain_query(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    face: wp.array(dtype=wp.int32),
    bary: wp.array(dtype=wp.vec2),
):
    """One thread per point."""
    i = wp.tid()
    hit = wp.mesh_query_point_no_sign(mesh, points[i], 1.0e6)
    face[i] = hit.face
    bary[i] = wp.vec2(hit.u, hit.v)


class PlainMesh:
    """A ``wp.Mesh`` with one plain launch per query."""

    def __init__(self, verts: np.ndarray, faces: np.ndarray, points: np.ndarray) -> None:
        """Build the tree and the output arrays."""
        from monopart.geometry.kernels.launch import init

        init()
        self.verts = wp.array(verts, dtype=wp.vec3, device="cpu")
        indices = wp.array(faces.reshape(-1), dtype=wp.int32, device="cpu")
        self.mesh = wp.Mesh(points=self.verts, indices=indices)
        self.points = wp.array(points, dtype=wp.vec3, device="cpu")
        self.face = wp.zeros(len(points), dtype=wp.int32, device="cpu")
        self.bary = wp.zeros(len(points), dtype=wp.vec2, device="cpu")

    def update(self, verts: np.ndarray) -> None:
        """Move the vertices and refit."""
        self.verts.assign(verts)
        self.mesh.refit()

    def query_points(self, points: np.ndarray) -> tuple[Any, Any]:
        """Faces and the first two barycentrics of other points."""
        if len(points) != len(self.face):
            self.face = wp.zeros(len(points), dtype=wp.int32, device="cpu")
            self.bary = wp.zeros(len(points), dtype=wp.vec2, device="cpu")
        self.points = wp.array(points, dtype=wp.vec3, device="cpu", copy=False)
        return self.query()

    def query(self) -> tuple[Any, Any]:
        """Faces and the first two barycentrics."""
        wp.launch(
            plain_query,
            dim=len(self.face),
            inputs=[self.mesh.id, self.points, self.face, self.bary],
            device="cpu",
        )
        return self.face.numpy(), self.bary.numpy()
