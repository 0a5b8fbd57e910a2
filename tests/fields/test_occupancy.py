"""Learned occupancy against plain loops."""

import pytest
import torch

from monopart.fields.occupancy import PartOccupancy, visible_samples


def grid(parts: int = 2, cells: int = 4) -> PartOccupancy:
    lo = torch.tensor([[0.0, 0.0, 0.0], [-1.0, -1.0, -1.0]])[:parts]
    return PartOccupancy(lo, torch.tensor([1.0, 2.0])[:parts], cells, decay=0.5)


def test_cells_follow_the_box_of_the_part() -> None:
    occupancy = grid()
    points = torch.tensor([[0.1, 0.3, 0.9], [0.1, 0.3, 0.9], [-0.9, 0.0, 0.9], [5.0, -5.0, 0.5]])
    part = torch.tensor([0, 1, 1, 0])
    expected = []
    for point, k in zip(points.tolist(), part.tolist(), strict=True):
        lo, edge = occupancy.lo[k].tolist(), float(occupancy.edge[k])
        x, y, z = (
            min(max(int((p - low) / edge * 4), 0), 3) for p, low in zip(point, lo, strict=True)
        )
        expected.append(((k * 4 + z) * 4 + y) * 4 + x)
    assert occupancy.cells_of(points, part).tolist() == expected


def test_unseen_cells_are_neither_empty_nor_opaque() -> None:
    occupancy = grid()
    cell = torch.arange(len(occupancy.peak))
    assert bool(occupancy.keep(cell, 1e9).all())
    assert float(occupancy.floor.max()) == 0.0


def test_peak_falls_slowly_and_floor_rises_slowly() -> None:
    occupancy = grid()
    cell = torch.tensor([3, 3, 7])
    occupancy.see(cell, torch.tensor([2.0, 8.0, 0.0]))
    assert occupancy.peak[3] == 8.0
    assert occupancy.floor[3] == 2.0
    assert not bool(occupancy.keep(torch.tensor([7]), 0.1))
    occupancy.see(torch.tensor([3]), torch.tensor([1.0]))
    assert occupancy.peak[3] == 4.0  # half of 8, above the 1 just seen
    assert occupancy.floor[3] == 1.0
    occupancy.see(torch.tensor([3]), torch.tensor([50.0]))
    assert occupancy.peak[3] == 50.0
    assert torch.isclose(occupancy.floor[3], torch.tensor(1.05))


def test_visible_samples_against_a_loop() -> None:
    torch.manual_seed(1)
    counts = [0, 5, 1, 0, 9, 3]
    ray_start = torch.tensor([0, *torch.tensor(counts).cumsum(0).tolist()])
    ray = torch.repeat_interleave(torch.arange(6), torch.tensor(counts)).int()
    wall = 6.0 * torch.rand(int(ray_start[-1]))
    expected = []
    for r, count in enumerate(counts):
        depth = 0.0
        for i in range(count):
            expected.append(depth < 10.0)
            depth += float(wall[int(ray_start[r]) + i])
    assert visible_samples(wall, ray_start, ray, 10.0).tolist() == expected
    assert not all(expected), "the case must hide something"
    empty = torch.zeros(0)
    assert visible_samples(empty, torch.zeros(4, dtype=torch.long), empty.int(), 1.0).tolist() == []


@pytest.mark.parametrize("far", [10.0, 1e10, 1e20, torch.inf])
def test_points_however_far_belong_to_the_nearest_cell(far: float) -> None:
    occupancy = PartOccupancy(torch.zeros(1, 3), torch.ones(1), cells=4)
    points = torch.tensor([[far, 0.5, -far], [-far, -far, -far], [far, far, far]])
    cell = occupancy.cells_of(points, torch.zeros(3, dtype=torch.long))
    assert cell.tolist() == [3 + 4 * (2 + 4 * 0), 0, 63]
    nan = occupancy.cells_of(torch.full((1, 3), torch.nan), torch.zeros(1, dtype=torch.long))
    assert 0 <= int(nan) < 64
