"""What unseen poses borrow from the training frames, and from nowhere else."""

import math

import numpy as np
import oracles
import pytest
import torch
from torch import Tensor

from monopart.geometry.parts import PartMap
from monopart.toolkit.memory import PartMemory, PoseMemory


@pytest.fixture
def memory() -> PoseMemory:
    torch.manual_seed(0)
    return PoseMemory.build((10, 12, 14, 20, 21, 30), 0.4 * torch.randn(6, 5, 3))


def test_distance_is_the_root_of_squared_angles_without_the_root() -> None:
    poses = torch.zeros(2, 3, 3)
    poses[1, 0] = torch.tensor([1.0, 0.0, 0.0])  # the root does not count
    poses[1, 1] = torch.tensor([0.0, 0.3, 0.0])
    poses[1, 2] = torch.tensor([0.0, 0.0, 0.4])
    memory = PoseMemory.build((0, 1), poses)
    distance = memory.distances(torch.zeros(3, 3))
    assert torch.allclose(distance, torch.tensor([0.0, 0.5]), atol=1e-6)
    assert math.isclose(memory.width, 0.5, abs_tol=1e-6)


def test_a_training_frame_is_itself(memory: PoseMemory) -> None:
    rows, weights = memory.weights(14, torch.zeros(5, 3))
    assert rows.tolist() == [2]
    assert weights.tolist() == [1.0]


def test_an_unseen_pose_blends_the_nearest(memory: PoseMemory) -> None:
    pose = 0.3 * torch.randn(5, 3)
    rows, weights = memory.weights(99, pose)
    distance = memory.distances(pose)
    order = sorted(range(6), key=lambda i: float(distance[i]))[:5]
    assert rows.tolist() == order
    raw = [math.exp(-(float(distance[i]) ** 2) / (2 * memory.width**2)) for i in order]
    expected = torch.tensor([w / sum(raw) for w in raw])
    assert torch.allclose(weights, expected, atol=1e-5)


def test_one_training_frame_is_enough() -> None:
    memory = PoseMemory.build((7,), torch.zeros(1, 4, 3))
    rows, weights = memory.weights(None, torch.ones(4, 3))
    assert rows.tolist() == [0]
    assert weights.tolist() == [1.0]
    assert float(memory.time(0)) == 0.0


def test_time_runs_from_zero_to_one(memory: PoseMemory) -> None:
    assert memory.time(torch.arange(6)).tolist() == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1.0])


def part_distance(a: Tensor, b: Tensor, joints: tuple[int, ...]) -> float:
    """Root of the summed squared angles, by the oracle's rotations."""
    total = 0.0
    for j in joints:
        relative = oracles.rodrigues(a[j].numpy()).T @ oracles.rodrigues(b[j].numpy())
        total += math.acos(min(1.0, max(-1.0, (np.trace(relative) - 1) / 2))) ** 2
    return math.sqrt(total)


FRAMES = (3, 5, 8, 9, 12, 20, 21)
PARTS = PartMap.from_table({"trunk": (0, 1), "root": (2,), "arm": (3, 4)}, 5)


@pytest.fixture
def poses() -> Tensor:
    torch.manual_seed(1)
    return 0.5 * torch.randn(len(FRAMES), 5, 3)


def test_each_part_has_neighbours_of_its_own(poses: Tensor) -> None:
    memory = PartMemory.build(FRAMES, poses, PARTS)
    assert memory.joints == ((1,), (2,), (3, 4)), "the root counts nowhere"
    query = 0.5 * torch.randn(5, 3)
    rows, weights = memory.of_pose(None, query)
    assert rows.shape == weights.shape == (1, 3, 5)
    for k, joints in enumerate(memory.joints):
        apart = [[part_distance(a, b, joints) for b in poses] for a in poses]
        nearest = sorted(min(d for j, d in enumerate(r) if j != i) for i, r in enumerate(apart))
        width = nearest[len(nearest) // 2]
        assert math.isclose(float(memory.widths[k]), width, rel_tol=1e-3)
        distance = [part_distance(query, p, joints) for p in poses]
        order = sorted(range(len(FRAMES)), key=distance.__getitem__)[:5]
        raw = [math.exp(-(distance[i] ** 2) / (2 * width**2)) for i in order]
        assert rows[0, k].tolist() == order
        expected = torch.tensor([r / sum(raw) for r in raw])
        torch.testing.assert_close(weights[0, k], expected, atol=1e-3, rtol=1e-3)


def test_neighbours_of_a_training_frame_are_others(poses: Tensor) -> None:
    memory = PartMemory.build(FRAMES, poses, PARTS)
    out = torch.zeros(len(FRAMES), dtype=torch.bool)
    out[2] = True
    rows, weights = memory.training(out)
    own = torch.arange(len(FRAMES))[:, None]
    alone = ~out
    assert bool((rows[alone, :, 0] == own[alone]).all())
    assert bool((weights[alone, :, 0] == 1).all()) and not bool(weights[alone, :, 1:].any())
    assert not bool((rows[2] == 2).any())
    torch.testing.assert_close(weights.sum(-1), torch.ones(len(FRAMES), 3))
    # what a left-out frame gets is what its pose would get if the frame had never been there
    rest = [i for i in range(len(FRAMES)) if i != 2]
    without = PartMemory.build(tuple(FRAMES[i] for i in rest), poses[rest], PARTS)
    assert torch.tensor(rest)[without.of_pose(None, poses[2])[0]].tolist() == rows[2:3].tolist()
    rows, weights = memory.training()
    assert rows.shape == (len(FRAMES), 3, 1) and bool((weights == 1).all())


def test_equal_poses_few_poses_and_one() -> None:
    same = PartMemory.build((0, 1, 2), torch.zeros(3, 5, 3), PARTS)
    rows, weights = same.of_pose(None, torch.zeros(5, 3))
    assert rows[0, 0].tolist() == [0, 1, 2] and bool(same.widths.gt(0).all())
    torch.testing.assert_close(weights, torch.full((1, 3, 3), 1 / 3))
    far = same.of_pose(None, torch.ones(5, 3))[1]
    torch.testing.assert_close(far, torch.full((1, 3, 3), 1 / 3))
    assert same.near.shape == (3, 3, 2)
    one = PartMemory.build((4,), torch.zeros(1, 5, 3), PARTS)
    for given in (one.training(torch.tensor([True])), one.of_pose(None, torch.ones(5, 3))):
        assert given[0].tolist() == [[[0], [0], [0]]] and bool((given[1] == 1).all())


def test_a_part_of_the_root_alone_blends_evenly(poses: Tensor) -> None:
    memory = PartMemory.build(FRAMES, poses, PartMap.from_table({"a": (0,), "b": (1, 2, 3, 4)}, 5))
    weights = memory.of_pose(None, torch.ones(5, 3))[1]
    torch.testing.assert_close(weights[0, 0], torch.full((5,), 0.2))
