"""Round trip and consistency loss against plain Python."""

import math

import pytest
import torch

from monopart.geometry.consistency import consistency_loss, round_trip
from monopart.geometry.errors import InputError


def plain_loss(distances: list[float], threshold: float) -> float:
    over = [d for d in distances if d > threshold]
    return sum(over) / max(1, len(over))


@pytest.mark.parametrize("threshold", [0.0, 0.01, 0.05, 0.2])
def test_the_loss_is_the_mean_over_the_threshold(threshold: float) -> None:
    distance = 0.1 * torch.rand(7, 30, dtype=torch.float64)
    found = consistency_loss(distance, threshold)
    assert found.item() == pytest.approx(plain_loss(distance.flatten().tolist(), threshold))


def test_only_distances_over_the_threshold_are_pulled() -> None:
    distance = torch.tensor([0.01, 0.05, 0.06, 0.2], requires_grad=True)  # 0.05 is not over 0.05
    loss = consistency_loss(distance, 0.05)
    assert loss.item() == pytest.approx(0.13)
    loss.backward()
    assert distance.grad is not None
    assert distance.grad.tolist() == [0.0, 0.0, 0.5, 0.5]


@pytest.mark.parametrize("values", [[], [0.0], [0.04, 0.05]])
def test_an_empty_set_costs_exactly_nothing(values: list[float]) -> None:
    distance = torch.tensor(values, requires_grad=True)
    loss = consistency_loss(distance, 0.05)
    assert loss.item() == 0.0 and loss.shape == ()
    loss.backward()
    assert distance.grad is not None
    assert distance.grad.tolist() == [0.0] * len(values)


def test_nan_is_not_hidden() -> None:
    assert math.isnan(consistency_loss(torch.tensor([0.0, math.nan])).item())
    lost = round_trip(torch.full((1, 3), math.nan), lambda p: p, lambda c: c)
    assert math.isnan(lost.item())


@pytest.mark.parametrize("threshold", [-0.01, math.nan])
def test_bad_thresholds(threshold: float) -> None:
    with pytest.raises(InputError, match="threshold"):
        consistency_loss(torch.zeros(1), threshold)


def test_round_trip_is_the_distance_of_the_image() -> None:
    points = torch.randn(20, 3, dtype=torch.float64)
    found = round_trip(points, lambda p: 2 * p + 1, lambda c: c / 4)
    for p, distance in zip(points.tolist(), found.tolist(), strict=True):
        image = [(2 * x + 1) / 4 for x in p]
        assert distance == pytest.approx(math.dist(p, image))


def test_backward_comes_first() -> None:
    points = torch.ones(1, 3)
    assert round_trip(points, lambda p: p + 1, lambda c: c * 2).item() == pytest.approx(27**0.5)


def test_round_trip_at_zero_has_gradient_zero() -> None:
    points = torch.randn(5, 3, requires_grad=True)
    scale = torch.ones((), requires_grad=True)
    loss = round_trip(points, lambda p: p * scale, lambda c: c / 1).sum()
    assert loss.item() == 0.0
    for gradient in torch.autograd.grad(loss, (points, scale)):
        assert not bool(gradient.any())


def test_round_trip_gradient_by_differences() -> None:
    points = torch.randn(4, 3, dtype=torch.float64, requires_grad=True)
    shift = torch.randn(3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda p, s: round_trip(p, lambda x: x * x + s, torch.sin), (points, shift)
    )


def test_no_points() -> None:
    assert round_trip(torch.zeros(0, 3), lambda p: p, lambda c: c).shape == (0,)
