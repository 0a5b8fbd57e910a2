"""Meshes on which unwrapping is compared: the body, its parts, finer and coarser ones, rings."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.body import BodyModel
from monopart.geometry.parts import PartMap


@dataclass(frozen=True, eq=False)
class UnwrapData:
    """A mesh, and the parts by which it may be cut first."""

    verts: Tensor
    faces: Tensor
    parts: Tensor
    """Part of each face; one part where the mesh has none."""


def _plain(verts: np.ndarray, faces: np.ndarray) -> UnwrapData:
    rows = torch.from_numpy(np.ascontiguousarray(faces)).long()
    return UnwrapData(torch.from_numpy(verts).float(), rows, torch.zeros(len(rows)).long())


def body_data() -> UnwrapData:
    """The default body and its six parts."""
    body = BodyModel.default()
    return UnwrapData(
        body.v_template, body.faces, PartMap.preset("six").face_parts(body.weights, body.faces)
    )


def part_data(part: int) -> UnwrapData:
    """One of the six parts of the default body as a mesh of its own, with holes."""
    body = body_data()
    used, faces = body.faces[body.parts == part].unique(return_inverse=True)
    return UnwrapData(body.verts[used], faces, torch.zeros(len(faces)).long())


def thinned(data: UnwrapData, count: int) -> UnwrapData:
    """A mesh of about so many faces; parts are those of the faces that remain."""
    import igl

    verts = np.asfortranarray(data.verts.double().numpy())
    rows = np.asfortranarray(data.faces.numpy().astype(np.int32))
    found = igl.qslim(verts, rows, count)
    mesh = _plain(np.asarray(found[0]), np.asarray(found[1]))
    return UnwrapData(mesh.verts, mesh.faces, data.parts[torch.from_numpy(found[2]).long()])


def finer(data: UnwrapData, times: int) -> UnwrapData:
    """A mesh, smooth (Loop), of four times as many faces for each time."""
    import igl

    verts, faces = igl.loop(data.verts.double().numpy(), data.faces.numpy(), times)
    mesh = _plain(np.asarray(verts), np.asarray(faces))
    return UnwrapData(mesh.verts, mesh.faces, _nearest_parts(data, mesh))


def _nearest_parts(data: UnwrapData, mesh: UnwrapData) -> Tensor:
    """Part of the old face next to the middle of each new one."""
    from scipy.spatial import KDTree

    old = data.verts[data.faces].mean(1).numpy()
    new = mesh.verts[mesh.faces].mean(1).numpy()
    return data.parts[torch.from_numpy(KDTree(old).query(new)[1])]


def smpl_like() -> UnwrapData:
    """The body with 13 776 faces and 6890 vertices, as many as SMPL has."""
    return thinned(finer(body_data(), 1), 13_776)


def large_body() -> UnwrapData:
    """The body with 200 000 faces."""
    return thinned(finer(body_data(), 3), 200_000)


def torus(major: int, minor: int) -> UnwrapData:
    """A ring of 2 · major · minor faces."""
    i, j = np.meshgrid(np.arange(major), np.arange(minor), indexing="ij")
    a, b = 2 * np.pi * i / major, 2 * np.pi * j / minor
    ring = 1 + 0.4 * np.cos(b)
    verts = np.stack([ring * np.cos(a), ring * np.sin(a), 0.4 * np.sin(b)], -1).reshape(-1, 3)

    def at(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return (x % major * minor + y % minor).reshape(-1)

    p, q, r, s = at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)
    return _plain(verts, np.concatenate([np.stack([p, q, r], 1), np.stack([p, r, s], 1)]))


def genus_two() -> UnwrapData:
    """Two rings that are one surface."""
    import igl

    sizes = (29, 17, 9)
    axes = [np.linspace(-e, e, n) for e, n in zip((2.8, 1.6, 0.6), sizes, strict=True)]
    x, y, z = np.meshgrid(*axes, indexing="ij")

    def tube(c: float) -> np.ndarray:
        return np.hypot(np.hypot(x - c, y) - 1, z) - 0.42

    field = np.minimum(tube(-1.1), tube(1.1)).transpose(2, 1, 0).reshape(-1)
    grid = np.stack([x, y, z], -1).transpose(2, 1, 0, 3).reshape(-1, 3)
    verts, faces = igl.marching_cubes(field, np.ascontiguousarray(grid), *sizes, 0.0)[:2]
    return _plain(np.asarray(verts), np.asarray(faces))


def with_holes() -> UnwrapData:
    """A sphere with three holes."""
    import igl

    verts, faces = igl.icosahedron()
    for _ in range(4):
        verts, faces = igl.upsample(verts, faces)
    verts, faces = np.asarray(verts), np.asarray(faces)
    verts = verts / np.linalg.norm(verts, axis=1, keepdims=True)
    centre, keep = verts[faces].mean(1), np.ones(len(faces), bool)
    for hole in ([1, 0, 0], [0, 1, 0], [-0.6, -0.6, 0.53]):
        keep &= np.linalg.norm(centre - np.array(hole), axis=1) > 0.35
    return _plain(verts, faces[keep])


MESHES: dict[str, tuple[str, Callable[[], UnwrapData]]] = {
    "body": ("default body", body_data),
    "ring": ("ring", lambda: torus(60, 30)),
    "two_rings": ("two rings in one", genus_two),
    "holes": ("sphere with three holes", with_holes),
    "smpl_size": ("body of SMPL's size", smpl_like),
    **{f"part_{i}": (f"part {i} of six alone", partial(part_data, i)) for i in range(6)},
    "large": ("body of 200 000 faces", large_body),
}
"""By the name for the command line: what it is called, and how it is made."""
