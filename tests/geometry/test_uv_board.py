"""Boards: where a stamp fits and how much it touches, against loops over its cells."""

import numpy as np
import pytest

from monopart.geometry.uv_board import Board, Recipe, level_angle, rotation
from monopart.geometry.uv_coverage import coverage
from monopart.geometry.uv_pack import packed


def _charts(count: int, seed: int = 0) -> list[np.ndarray]:
    """Fans of triangles around points, of many shapes and sizes."""
    random = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        angle = np.sort(random.uniform(0, 2 * np.pi, 7))
        ring = np.stack([2 * np.cos(angle), np.sin(angle)], 1) * random.uniform(0.4, 1.5, (7, 1))
        after = np.roll(ring, -1, 0)
        corner = np.stack([np.zeros_like(ring), ring, after], 1) + random.normal(size=2)
        side = corner[:, 1:] - corner[:, :1]
        area = side[:, 0, 0] * side[:, 1, 1] - side[:, 0, 1] * side[:, 1, 0]
        out.append(corner[area > 1e-3])
    return out


def _sizes(faces: list[np.ndarray]) -> np.ndarray:
    side = [c[:, 1:] - c[:, :1] for c in faces]
    return np.array([float(np.linalg.det(s).sum()) / 2 for s in side])


def _cells(mask: np.ndarray, low: np.ndarray) -> set[tuple[int, int]]:
    return {(int(x + low[0]), int(y + low[1])) for y, x in np.argwhere(mask)}


@pytest.mark.parametrize("count", [12, 5])
def test_stamps_cover_their_charts_in_every_turn(count: int) -> None:
    faces = _charts(1)
    board = Board.of(faces, _sizes(faces), 40, 0.8, count)
    base = level_angle(faces[0].reshape(-1, 2) * board.unit)
    for k, stamp in enumerate(board.stamps[0]):
        np.testing.assert_allclose(stamp.turn, rotation(base + 2 * np.pi * k / count))
        mask, low = coverage(faces[0] * board.unit @ stamp.turn.T, 0.4)
        assert _cells(stamp.mask, stamp.low) == _cells(mask, low)


def _value(taken: np.ndarray, stamp_worth: np.ndarray, row: int, column: int) -> float:
    height, wide = stamp_worth.shape
    return float((taken[row : row + height, column : column + wide] * stamp_worth).sum())


def test_a_window_holds_what_every_place_is_worth() -> None:
    faces = _charts(1)
    board = Board.of(faces, _sizes(faces), 30, 0.5, 4)
    worth = board.stamps[0][0].worth
    taken = (np.random.default_rng(1).random((board.canvas, board.canvas)) < 0.1).astype(np.float32)
    first, last = np.array([1, 0]), board.canvas - np.array(worth.shape)
    found = board._window(taken, 0, first, last)
    assert found.shape == tuple(last - first + 1)
    for row, column in ((0, 0), (1, 1), (found.shape[0] - 1, found.shape[1] - 1)):
        expected = _value(taken, worth, first[0] + row, first[1] + column)
        assert abs(found[row, column] - expected) < 1e-3


@pytest.mark.parametrize("goals", [False, True])
def test_placed_charts_share_no_cell_and_stay_inside(goals: bool) -> None:
    faces = _charts(8)
    sizes = _sizes(faces)
    turns = np.zeros(8, int) if goals else None
    board = Board.of(faces, sizes, 48, 0.5, 4, turns).with_canvas(90)
    where = np.random.default_rng(2).random((8, 2)) if goals else None
    recipe = Recipe(np.argsort(-sizes), 0.3, turns, where)
    width = board.canvas
    places = board.placed(recipe, width)
    assert not isinstance(places, int)
    taken = np.zeros((width, width), int)
    for own, (which, row, column) in zip(board.stamps, places, strict=True):
        mask = own[which].mask
        taken[row : row + mask.shape[0], column : column + mask.shape[1]] += mask
    assert taken.max() == 1
    assert taken[0].sum() == taken[-1].sum() == taken[:, 0].sum() == taken[:, -1].sum() == 0


def test_a_chart_that_does_not_fit_is_named_and_put_first() -> None:
    faces = _charts(6)
    board = Board.of(faces, _sizes(faces), 40, 0.5, 4)
    recipe = Recipe(np.arange(6), 0.0)
    failed = board.placed(recipe, 20)
    assert isinstance(failed, int)
    order = recipe.urgent(failed).order
    assert order[0] == failed and sorted(order) == list(range(6))


def test_the_place_nearest_to_a_goal_is_found_far_away_too() -> None:
    faces = _charts(1)
    board = Board.of(faces, _sizes(faces), 100, 0.0, 4, np.zeros(1, int)).with_canvas(300)
    taken = np.ones((board.canvas, board.canvas), np.float32)
    height, wide = board.stamps[0][0].mask.shape
    # room at the far end alone
    taken[-height - 2 : -1, -wide - 2 : -1] = 0
    found = board._near(taken, 0, board.canvas, np.zeros(2))
    assert found is not None
    _, row, column = found
    mask = board.stamps[0][0].mask
    assert not (taken[row : row + height, column : column + wide].astype(bool) & mask).any()


@pytest.mark.parametrize("count", [1, 2, 9])
def test_packing_leaves_the_margin_and_fills_the_square(count: int) -> None:
    faces = _charts(count, seed=3)
    corner = np.concatenate(faces)
    chart = np.repeat(np.arange(count), [len(f) for f in faces])
    packing = packed(corner, chart, 512, 4.0)
    uv = packing.place(corner.reshape(-1, 2), np.repeat(chart, 3))
    assert uv.min() >= 2 / 512 and uv.max() <= 1 - 2 / 512
    assert packing.scale**2 * _sizes(faces).sum() > 0.25
    again = packed(corner, chart, 512, 4.0)
    assert np.array_equal(again.shift, packing.shift) and again.scale == packing.scale
