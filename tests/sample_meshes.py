"""Small meshes for tests: primitives, and meshes that are broken in one known way."""

import dataclasses
import itertools

import numpy as np

from monopart.tools.meshio import Mesh, Skeleton


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


def cube() -> Mesh:
    """Two triangles a side, wound outwards."""
    verts = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = [t for a, b, c, d in quads for t in ([a, b, c], [a, c, d])]
    return Mesh(verts - 0.5, np.array(faces), name="cube")


def sphere(rings: int = 8, sides: int = 12, radius: float = 1.0) -> Mesh:
    """A globe with poles on the y axis."""
    up = np.linspace(0, np.pi, rings + 1)[1:-1, None]
    round_ = np.linspace(0, 2 * np.pi, sides, endpoint=False)[None]
    x, y = np.sin(up) * np.cos(round_), np.cos(up) + 0 * round_
    z = np.sin(up) * np.sin(round_)
    verts = np.stack([x, y, z], -1).reshape(-1, 3)
    verts = np.vstack([verts, [0, 1, 0], [0, -1, 0]]) * radius
    top, bottom = len(verts) - 2, len(verts) - 1
    faces = []
    for j in range(sides):
        k = (j + 1) % sides
        faces.append([top, k, j])
        last = (rings - 2) * sides
        faces.append([bottom, last + j, last + k])
        for i in range(rings - 2):
            a, b = i * sides + j, i * sides + k
            faces += [[a, b, b + sides], [a, b + sides, a + sides]]
    return Mesh(verts, np.array(faces), name="sphere")


def torus(major: int = 16, minor: int = 8) -> Mesh:
    """A ring around the y axis."""
    u, v = np.meshgrid(
        np.linspace(0, 2 * np.pi, major, endpoint=False),
        np.linspace(0, 2 * np.pi, minor, endpoint=False),
        indexing="ij",
    )
    wide = 1 + 0.3 * np.cos(v)
    verts = np.stack([wide * np.cos(u), 0.3 * np.sin(v), wide * np.sin(u)], -1).reshape(-1, 3)
    faces = []
    for i, j in itertools.product(range(major), range(minor)):
        a, b = i * minor + j, (i + 1) % major * minor + j
        c, d = (i + 1) % major * minor + (j + 1) % minor, i * minor + (j + 1) % minor
        faces += [[a, c, b], [a, d, c]]
    return Mesh(verts, np.array(faces), name="torus")


def joined(*meshes: Mesh) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0, *(m.num_verts for m in meshes)])
    faces = [m.faces + start for m, start in zip(meshes, starts, strict=False)]
    verts = np.concatenate([m.verts for m in meshes])
    return Mesh(verts, np.concatenate(faces), name="several")


def changed(mesh: Mesh, **fields: object) -> Mesh:
    """The mesh with other fields."""
    return dataclasses.replace(mesh, **fields)


def shifted(mesh: Mesh, *by: float) -> Mesh:
    """The mesh moved."""
    return changed(mesh, verts=mesh.verts + np.array(by))


def rigged() -> Mesh:
    """A sphere between two joints, weights by height."""
    ball = sphere()
    share = np.clip(0.5 + ball.verts[:, 1], 0, 1)
    joints = np.array([[0.0, -1, 0], [0, 0, 0]])
    skeleton = Skeleton(("root", "tip"), (-1, 0), joints)
    weights = np.stack([1 - share, share], 1)
    return changed(ball, weights=weights, skeleton=skeleton, name="rigged")


def sample_meshes() -> dict[str, Mesh]:
    """More than twenty meshes; all but the first few have a fault."""
    ball, box = sphere(), cube()
    flat, flat_faces = grid(4)
    sheet = Mesh(flat, flat_faces, name="sheet")
    nan = ball.verts.copy()
    nan[5] = np.nan
    pole = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1]])
    fan = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    needle = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]])
    uv = np.tile(np.array([[0.0, 0], [1, 0], [0, 1]]), (sheet.num_faces, 1, 1))
    one_uv = sheet.verts[sheet.faces][..., :2] / 2 + 0.5
    return {
        "sphere": ball,
        "cube": box,
        "torus": torus(),
        "rigged": rigged(),
        "two spheres": joined(ball, shifted(ball, 3.0, 0, 0)),
        "tiny": changed(ball, verts=ball.verts * 1e-30),
        "huge": changed(ball, verts=ball.verts * 1e30),
        "far away": shifted(ball, 1e6, 0, 0),
        "seams": Mesh(
            ball.verts[ball.faces].reshape(-1, 3), np.arange(ball.faces.size).reshape(-1, 3)
        ),
        "sheet": sheet,
        "sheet with texture": changed(sheet, corner_uv=one_uv),
        "hole": changed(ball, faces=ball.faces[1:]),
        "empty": Mesh(np.zeros((0, 3)), np.zeros((0, 3), int)),
        "points": Mesh(ball.verts, np.zeros((0, 3), int)),
        "one face": Mesh(np.eye(3), np.array([[0, 1, 2]])),
        "NaN": changed(ball, verts=nan),
        "all NaN": changed(ball, verts=ball.verts * np.nan),
        "infinite": changed(ball, verts=np.where(ball.verts == 1, np.inf, ball.verts)),
        "collapsed": changed(ball, verts=ball.verts * 0),
        "degenerate": Mesh(needle, np.array([[0, 1, 2], [0, 1, 3], [0, 0, 3]])),
        "branching": Mesh(pole, fan),
        "duplicate faces": changed(ball, faces=np.vstack([ball.faces, ball.faces[:2]])),
        "unused vertex": changed(ball, verts=np.vstack([ball.verts, [[5.0, 5, 5]]])),
        "turned face": changed(ball, faces=np.vstack([ball.faces[:1, ::-1], ball.faces[1:]])),
        "inside out": changed(ball, faces=ball.faces[:, ::-1]),
        "pinched": joined_at_a_vertex(box),
        "cutting": joined(ball, shifted(ball, 0.9, 0.123, 0.077)),
        "overlapping texture": changed(sheet, corner_uv=uv),
        "turned texture": changed(sheet, corner_uv=one_uv * [-1, 1]),
        "bad weights": changed(rigged(), weights=rigged().weights * [1, -0.5]),
        "no weights": changed(rigged(), weights=rigged().weights * 0),
    }


def joined_at_a_vertex(box: Mesh) -> Mesh:
    """Two boxes that share one corner vertex."""
    both = joined(box, shifted(box, 1.0, 1.0, 1.0))
    faces = both.faces.copy()
    faces[faces == 8] = 7  # the lowest corner of the second is the highest of the first
    return changed(both, faces=faces)
