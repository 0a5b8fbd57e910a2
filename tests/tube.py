"""A small body for tests: a closed tube of three bones."""

import torch

from monopart.geometry.body import BodyModel
from monopart.geometry.kinematics import KinematicTree


def tube(dtype: torch.dtype = torch.float64) -> BodyModel:
    """A closed tube of three bones along y, 1 m long, 10 cm thick."""
    rings, sides = 13, 8
    angle = torch.arange(sides, dtype=dtype) * (2 * torch.pi / sides)
    circle = 0.1 * torch.stack([angle.cos(), torch.zeros(sides, dtype=dtype), -angle.sin()], -1)
    height = torch.linspace(0, 1, rings, dtype=dtype)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=dtype)
    verts = (circle + height[:, None, None] * up).reshape(-1, 3)
    verts = torch.cat([verts, 0 * up[None], up[None]])
    faces = []
    for k in range(rings - 1):
        for i in range(sides):
            a, b = k * sides + i, k * sides + (i + 1) % sides
            faces += [[a, b, b + sides], [a, b + sides, a + sides]]
    last = (rings - 1) * sides
    for i in range(sides):
        j = (i + 1) % sides
        faces += [[rings * sides, j, i], [rings * sides + 1, last + i, last + j]]
    y = verts[:, 1]
    first, second = (1 - 3 * (y - 0.17)).clamp(0, 1), (3 * (y - 0.5)).clamp(0, 1)
    weights = torch.stack([first, 1 - first - second, second], -1).clamp(min=0)
    weights = weights / weights.sum(-1, keepdim=True)
    regressor = torch.zeros(3, len(verts), dtype=dtype)
    for j, ring in enumerate((0, 4, 8)):
        regressor[j, ring * sides : (ring + 1) * sides] = 1 / sides
    return BodyModel(
        v_template=verts,
        faces=torch.tensor(faces),
        weights=weights,
        tree=KinematicTree.from_parents([-1, 0, 1]),
        joint_regressor=regressor,
        shapedirs=torch.zeros(len(verts), 3, 1, dtype=dtype),
        posedirs=torch.zeros(len(verts), 3, 18, dtype=dtype),
    )
