"""Stress of similarities and of one mesh laid on another."""

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.alignment import Similarity, align

from .stability_cases import DOUBLE, Family, Stress, Way
from .stability_graphs import moved, plain
from .stability_meshes import ball
from .stability_rotations import exact_rotmat


def _similar() -> Stress:
    """There and back, and the formula."""

    def run(given: tuple[float, float], points: Tensor) -> Tensor:
        turn = exact_rotmat(None, np.array([[0.3, -1.0, 0.7]]))[0]
        move = Similarity(given[0], turn, np.full(3, given[1]))
        there = move(points.double().numpy())
        return torch.from_numpy(np.concatenate((there, move.inverse()(there)), 1))

    def exact(given: tuple[float, float], points: np.ndarray) -> np.ndarray:
        turn = exact_rotmat(None, np.array([[0.3, -1.0, 0.7]]))[0]
        moved = np.stack([given[0] * (turn @ p) for p in points]) + given[1]
        return np.concatenate((moved, points), 1)

    shapes = (("1", 1.0, 1.0), ("1e-6", 1e-6, 0.0), ("1e6", 1e6, 0.0), ("1 km off", 1.0, 1e3))
    make = lambda g, n: (torch.randn(n, 3, generator=g, dtype=DOUBLE),)  # noqa: E731
    return Stress(
        name="similarity",
        title="similarities, there and back",
        domain="any scale above 0; the way back is as good as the last place of the way there",
        error="1, and the place over the scale",
        families=tuple(Family(f"scale {n}", make, extra=(s, a)) for n, s, a in shapes),
        ways=(Way("monopart", run, True, differentiable=False),),
        exact=exact,
        scale=lambda given, exact, p: 8 * max(1.0, given[0], given[1] / given[0]),
        wrt=(),
        cases=64,
    )


def _align() -> Stress:
    """A ball with bumps found again after a turn, in another size and place."""

    def run(given: tuple[float, float], verts: np.ndarray) -> np.ndarray:
        mesh, turn = ball(), exact_rotmat(None, np.array([[0.2, 0.3, -0.1]]))[0]
        shape = verts * np.array([1.0, 1.6, 0.7])
        there = given[0] * shape @ turn.T + given[1]
        found = align((shape, mesh.faces.numpy()), (there, mesh.faces.numpy()))
        return (found(shape) - there) / given[0]

    shapes = (("1e-6", 1e-6, 0.0), ("1, 1 km off", 1.0, 1e3))
    return Stress(
        name="align",
        title="one mesh laid on another",
        domain="meshes of one shape, of any size and place; good to the spacing of its 1500 points",
        error="the size of the mesh",
        families=tuple(Family(f"size {n}", moved(ball()), extra=(s, a)) for n, s, a in shapes),
        ways=(plain(run),),
        exact=lambda given, verts: np.zeros_like(verts),
        wrt=(),
        cases=8,
        limit=0.05,
        double=0.05,
    )


def stresses() -> list[Stress]:
    """Operations that lay meshes on others."""
    return [_similar(), _align()]
