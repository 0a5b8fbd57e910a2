"""Slow and plain float64 references, written as loops; each room of the tests adds its section."""

import numpy as np

# --- rotations, forward kinematics, linear blend skinning ---------------------------------------


def rodrigues(axis_angle: np.ndarray) -> np.ndarray:
    """Rotation matrix of one axis-angle vector, radians."""
    v = np.asarray(axis_angle, dtype=np.float64)
    angle = float(np.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = v / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # 1 - cos as 2 sin² of the half angle keeps its digits for small angles
    return np.eye(3) + np.sin(angle) * cross + 2 * np.sin(angle / 2) ** 2 * cross @ cross


def affine(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """4×4 matrix of x → R x + t."""
    result = np.eye(4)
    result[:3, :3] = rotation
    result[:3, 3] = translation
    return result


def forward_kinematics(
    parents: tuple[int, ...], rotations: np.ndarray, joints: np.ndarray
) -> np.ndarray:
    """Rest-to-posed 4×4 of each joint: chain of [R | offset to the parent], rest undone."""
    world: list[np.ndarray] = []
    for j, parent in enumerate(parents):
        offset = joints[j] - (joints[parent] if parent >= 0 else 0.0)
        local = affine(rotations[j], offset)
        world.append(local if parent < 0 else world[parent] @ local)
    return np.stack([w @ affine(np.eye(3), -joints[j]) for j, w in enumerate(world)])


def linear_blend_skinning(
    verts: np.ndarray, weights: np.ndarray, transforms: np.ndarray
) -> np.ndarray:
    """Vertices moved by the weighted sum of the joints' images of them."""
    result = np.zeros((len(verts), 3))
    for v, point in enumerate(verts):
        homogeneous = np.array([*point, 1.0])
        for j, transform in enumerate(transforms):
            if weights[v, j] != 0.0:
                result[v] += weights[v, j] * (transform @ homogeneous)[:3]
    return result


def pose_body(
    arrays: dict[str, np.ndarray], pose: np.ndarray, betas: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Local vertices, posed joints and joint transforms of a body in SMPL form, axis-angle pose."""
    a = {name: np.asarray(array, dtype=np.float64) for name, array in arrays.items()}
    shaped = a["v_template"].copy()
    for b, beta in enumerate(betas):
        shaped += float(beta) * a["shapedirs"][:, :, b]
    joints = a["J_regressor"] @ shaped
    parents = tuple(-1 if j == 0 else int(p) for j, p in enumerate(a["kintree_table"][0]))
    rotations = np.stack([rodrigues(r) for r in pose])
    transforms = forward_kinematics(parents, rotations, joints)
    bent = shaped.copy()
    column = 0
    for rotation in rotations[1:]:
        for entry in (rotation - np.eye(3)).ravel():
            bent += entry * a["posedirs"][:, :, column]
            column += 1
    posed_joints = np.stack(
        [t[:3, :3] @ j + t[:3, 3] for t, j in zip(transforms, joints, strict=True)]
    )
    return linear_blend_skinning(bent, a["weights"], transforms), posed_joints, transforms


def random_body(seed: int, num_verts: int = 40, pose_blend: bool = True) -> dict[str, np.ndarray]:
    """Arrays of a small random body of 5 joints under their SMPL names, float64."""
    rng = np.random.default_rng(seed)
    parents = [4294967295, 0, 0, 1, 3]
    num_joints = len(parents)
    weights = rng.random((num_verts, num_joints)) ** 4
    regressor = rng.random((num_joints, num_verts)) ** 4
    posedirs = rng.normal(size=(num_verts, 3, 9 * (num_joints - 1))) * 0.01
    num_faces = 2 * num_verts
    return {
        "v_template": rng.normal(size=(num_verts, 3)),
        "f": np.stack([rng.permutation(num_verts)[:3] for _ in range(num_faces)]),
        "weights": weights / weights.sum(1, keepdims=True),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "kintree_table": np.array([parents, range(num_joints)], dtype=np.int64),
        "shapedirs": rng.normal(size=(num_verts, 3, 4)) * 0.05,
        "posedirs": posedirs if pose_blend else np.zeros_like(posedirs),
    }


# --- closest points on triangles ----------------------------------------------------------------


def _closest_on_segment(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    square = float((b - a) @ (b - a))
    along = 0.0 if square == 0.0 else min(max(float((p - a) @ (b - a)) / square, 0.0), 1.0)
    return a + along * (b - a)


def closest_on_triangle(p: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Nearest point of a triangle, degenerate or not: the foot on its plane, or of an edge."""
    a, b, c = (np.asarray(corner, dtype=np.float64) for corner in triangle)
    candidates = [_closest_on_segment(p, *edge) for edge in ((a, b), (b, c), (c, a))]
    normal = np.cross(b - a, c - a)
    square = float(normal @ normal)
    if square > 0.0:
        foot = p - normal * float((p - a) @ normal) / square
        sides = [np.cross(v - u, foot - u) @ normal for u, v in ((a, b), (b, c), (c, a))]
        if min(sides) >= 0.0:
            candidates.append(foot)
    return min(candidates, key=lambda q: float((p - q) @ (p - q)))


def closest_on_mesh(
    points: np.ndarray, verts: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Nearest surface points and their distances, over every face."""
    found = np.zeros((len(points), 3))
    distance = np.full(len(points), np.inf)
    for i, p in enumerate(np.asarray(points, dtype=np.float64)):
        for face in faces:
            q = closest_on_triangle(p, verts[face])
            gap = float(np.sqrt((p - q) @ (p - q)))
            if gap < distance[i]:
                found[i], distance[i] = q, gap
    return found, distance


def sphere(radius: float, rings: int, sectors: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and outward faces of a latitude-longitude sphere about the origin."""
    polar = np.pi * np.arange(1, rings) / rings
    turn = 2 * np.pi * np.arange(sectors) / sectors
    body = [(np.sin(t) * np.cos(f), np.cos(t), -np.sin(t) * np.sin(f)) for t in polar for f in turn]
    verts = radius * np.array([(0.0, 1.0, 0.0), *body, (0.0, -1.0, 0.0)])
    last = len(verts) - 1
    faces = []
    for s in range(sectors):
        n = (s + 1) % sectors
        faces.append((0, 1 + s, 1 + n))
        faces.append((last, last - sectors + n, last - sectors + s))
        for r in range(rings - 2):
            a, b = 1 + r * sectors + s, 1 + r * sectors + n
            faces += [(a, a + sectors, b), (b, a + sectors, b + sectors)]
    return verts, np.array(faces)
