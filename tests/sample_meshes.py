"""Small meshes for tests: primitives, and meshes that are broken in one known way."""

import itertools

import numpy as np


def grid(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A flat square of 2 n² triangles, an edge long, diagonals mirrored in x = 0."""
    x, y = np.meshgrid(np.linspace(-1, 1, n + 1), np.linspace(-1, 1, n + 1), indexing="ij")
    verts = np.stack([x, y, 0 * x], -1).reshape(-1, 3)
    faces = []
    for i, j in itertools.product(range(n), range(n)):
        a, b, c, d = (i * (n + 1) + j, (i + 1) * (n + 1) + j, 0, 0)
        c, d = b + 1, a + 1
        faces += [[a, b, c], [a, c, d]] if i < n // 2 else [[a, b, d], [b, c, d]]
    return verts, np.array(faces)
