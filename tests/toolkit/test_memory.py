"""What unseen poses borrow from the training frames, and from nowhere else."""

import math

import pytest
import torch

from monopart.toolkit.memory import PoseMemory


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
