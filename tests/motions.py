"""Random motions for the property tests, and strategies that draw them.

Nothing here is made by the code under test.
"""

import math
from dataclasses import dataclass

import oracles
import torch
from hypothesis import strategies as st
from torch import Tensor

seeds = st.integers(0, 2**31 - 1)


@dataclass(frozen=True)
class Motion:
    """x → R x + t, float64."""

    rotmat: Tensor
    shift: Tensor

    def __call__(self, points: Tensor) -> Tensor:
        return points @ self.rotmat.to(points).mT + self.shift.to(points)

    def turn(self, vectors: Tensor) -> Tensor:
        return vectors @ self.rotmat.to(vectors).mT

    def matrix(self, like: Tensor) -> Tensor:
        """4×4 in the dtype of a tensor."""
        return torch.from_numpy(oracles.affine(self.rotmat.numpy(), self.shift.numpy())).to(like)


def rotations(limit: float = math.pi) -> st.SearchStrategy[Tensor]:
    """Axis-angle vectors of any direction and an angle up to a limit, both ends often."""
    angle = st.one_of(st.sampled_from([0.0, 1e-8, 1e-3, limit]), st.floats(0.0, limit))
    return st.builds(lambda seed, a: a * unit(seed), seeds, angle)


def motions(reach: float = 2.0) -> st.SearchStrategy[Motion]:
    """Rigid motions with shifts up to a reach per axis."""
    numbers = st.floats(-reach, reach, width=32)
    return st.builds(
        lambda v, *t: Motion(
            torch.from_numpy(oracles.rodrigues(v.numpy())), torch.tensor(t, dtype=torch.float64)
        ),
        rotations(),
        *(numbers,) * 3,
    )


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def unit(seed: int) -> Tensor:
    """A direction, float64."""
    vector = torch.randn(3, generator=generator(seed), dtype=torch.float64)
    return vector / vector.norm()


def normal(seed: int, *shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64).to(dtype)


def shuffled(seed: int, count: int) -> Tensor:
    return torch.randperm(count, generator=generator(seed))


def close(found: Tensor, expected: Tensor, bound: float) -> None:
    """Equal within an absolute bound, in the unit of the numbers; NaN never is."""
    torch.testing.assert_close(found, expected, atol=bound, rtol=0)
