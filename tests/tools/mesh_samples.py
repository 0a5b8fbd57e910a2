"""Meshes for the tests of the mesh tools, with every attribute that a format may hold."""

import numpy as np

from monopart.tools.meshio import Mesh, Skeleton


def tube(rings=6, sides=8, name="Rohr é 管"):
    """A bent tube with caps left open, a seam in its UVs, three joints, colours and a texture."""
    rng = np.random.default_rng(3)
    angle = 2 * np.pi * np.arange(sides) / sides
    height = np.linspace(0, 1, rings)
    around = np.stack([np.cos(angle), np.zeros(sides), np.sin(angle)], axis=1) * 0.2
    verts = (around[None] + height[:, None, None] * np.array([0.1, 1, 0])).reshape(-1, 3)
    verts = verts + rng.normal(scale=1e-3, size=verts.shape)
    faces, uv = [], []
    for ring in range(rings - 1):
        for side in range(sides):
            a, b = ring * sides + side, ring * sides + (side + 1) % sides
            c, d = a + sides, b + sides
            u0, u1 = side / sides, (side + 1) / sides
            v0, v1 = height[ring] * 0.9, height[ring + 1] * 0.9
            faces += [[a, c, b], [b, c, d]]
            uv += [[[u0, v0], [u0, v1], [u1, v0]], [[u1, v0], [u0, v1], [u1, v1]]]
    raw = rng.random((len(verts), 3)) ** 4
    weights = raw / raw.sum(axis=1, keepdims=True)
    joints = np.array([[0.0, 0, 0], [0.05, 0.5, 0], [0.1, 1, 0]])
    pixels = rng.integers(0, 256, size=(5, 7, 3)) / 255
    return Mesh(
        verts,
        np.array(faces),
        corner_uv=np.array(uv),
        weights=weights,
        skeleton=Skeleton(("Wurzel", "mitte ü", "end"), (-1, 0, 1), joints),
        colors=rng.integers(0, 256, size=(len(verts), 3)) / 255,
        texture=pixels,
        name=name,
    )


def cube(size=1.0, name="cube"):
    """Twelve outward triangles."""
    verts = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * size
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = [[q[i] for i in t] for q in quads for t in ((0, 1, 2), (0, 2, 3))]
    return Mesh(verts, np.array(faces), name=name)


def many_joints(count=300):
    """Each vertex bound to seven of many joints, which need two bytes each."""
    rng = np.random.default_rng(1)
    verts = rng.normal(size=(40, 3))
    weights = np.zeros((40, count))
    for row in weights:
        row[rng.choice(count, 7, replace=False)] = rng.random(7) + 0.05
    weights[0, :7], weights[0, 7:] = 1, 0
    skeleton = Skeleton(
        tuple(f"j{n}" for n in range(count)),
        tuple(range(-1, count - 1)),
        rng.normal(size=(count, 3)),
    )
    faces = rng.permutation(40)[:39].reshape(13, 3)
    return Mesh(verts, faces, weights=weights / weights.sum(1, keepdims=True), skeleton=skeleton)
