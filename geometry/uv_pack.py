"""Packing of charts into the unit square: turned, rasterised, put where they touch the most."""

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from jaxtyping import Float, Int

from .errors import InputError
from .uv_board import Board, Places, Recipe, level_angle, rotation

_COARSE, _FINE = ((64, 8), (96, 6)), 384
"""Cells of the coarse grids and orders tried on each; cells of the fine grid."""
_TURNS = 12
_GOOD = 0.7
"""Share of the square at which the second coarse grid is not tried."""
_FINALS = 2
"""Results of a coarse grid that are repeated on the fine one."""
_RETRIES, _FINE_RETRIES = 3, 8
"""How often a chart that did not fit is put first, on a coarse and on the fine grid."""
_HOPE = 1.02
"""Factor that this may add to the scale."""
_MANY = 150
"""Above so many charts their boxes go on shelves."""


@dataclass(frozen=True, eq=False)
class Packing:
    """Where each chart lies: uv = scale · (turn · local) + shift."""

    scale: float
    turn: Float[np.ndarray, "C 2 2"]
    shift: Float[np.ndarray, "C 2"]

    def place(
        self, uv: Float[np.ndarray, "W 2"], chart: Int[np.ndarray, "W"]
    ) -> Float[np.ndarray, "W 2"]:
        """Coordinates in the unit square of points of charts in their own planes."""
        turned = (self.turn[chart] * uv[:, None]).sum(-1)
        return self.scale * turned + self.shift[chart]


def packed(
    corner: Float[np.ndarray, "F 3 2"], chart: Int[np.ndarray, "F"], size: int, margin: float
) -> Packing:
    """Pack charts into the unit square at one common scale.

    Some orders are tried on a coarse grid; the best ones are repeated on a fine grid; all that on
    a second coarse grid where the first one leaves three tenths of the square. More than 150
    charts go on shelves, box by box: looser, but in a time that grows with their number alone.

    Args:
        corner: coordinates per face corner, each chart in a plane of its own.
        chart: of each face, all numbers from 0 in use.
        size: texels along a side of the square.
        margin: least distance between charts and to the border of the square, texels.

    Returns:
        The places; the same for the same input.
    """
    count = int(chart.max(initial=-1)) + 1
    side = corner[:, 1:] - corner[:, :1]
    area = np.abs(side[:, 0, 0] * side[:, 1, 1] - side[:, 0, 1] * side[:, 1, 0]) / 2
    sizes = np.bincount(chart, area, minlength=count)
    faces = [corner[rows] for rows in _rows_of(chart, count)]
    if count > _MANY:
        return _shelved(faces, margin / size)
    fine = int(np.clip(size // 2, 2 * _COARSE[0][0], _FINE))
    best = None
    for grid, trials in _COARSE:
        coarse = Board.of(faces, sizes, grid, margin * grid / size, _TURNS)
        for width, recipe in _searched(coarse, sizes, trials):
            board = Board.of(faces, sizes, fine, margin * fine / size, _TURNS, recipe.turns)
            hope = 0.0 if best is None else best.scale / _HOPE
            found = _tightest(board, recipe, int(width * fine / grid) + 2, hope)
            best = found if best is None or found.scale > best.scale else best
        if best is not None and best.scale**2 * sizes.sum() >= _GOOD:
            break
    return cast(Packing, best)


def _rows_of(chart: np.ndarray, count: int) -> list[np.ndarray]:
    order = np.argsort(chart, kind="stable")
    return np.split(order, np.searchsorted(chart[order], np.arange(1, count)))


def _shelved(faces: list[np.ndarray], gap: float) -> Packing:
    """Charts in their smallest boxes, the tallest first, in rows from the bottom."""
    turns, lows, boxes = [], [], []
    for corner in faces:
        angle = level_angle(corner.reshape(-1, 2))
        turned = corner.reshape(-1, 2) @ rotation(angle).T
        if np.ptp(turned[:, 1]) > np.ptp(turned[:, 0]):
            angle += np.pi / 2
            turned = corner.reshape(-1, 2) @ rotation(angle).T
        turns.append(rotation(angle))
        lows.append(turned.min(0))
        boxes.append(np.ptp(turned, axis=0))
    box = np.array(boxes)
    order = np.argsort(-box[:, 1], kind="stable")
    # so many boxes can have a margin each that nothing is left: then the margin gives way
    gap = min(max(gap, 1e-6), 0.25 / np.ceil(np.sqrt(len(faces))))
    low, high = 0.0, 1 / max(float(np.sqrt(box.prod(1).sum())), float(box.max()), 1e-300)
    places = None
    for _ in range(40):
        middle = (low + high) / 2
        trial = _on_shelves(box[order] * middle + gap)
        if trial is None:
            high = middle
        else:
            low, places = middle, trial
    if places is None:
        raise InputError("charts: expected charts that fit a square, found none that do")
    shift = np.zeros((len(faces), 2))
    shift[order] = places + gap / 2
    return Packing(low, np.stack(turns), shift - low * np.array(lows))


def _on_shelves(box: np.ndarray) -> np.ndarray | None:
    """Lower left corners of boxes of falling height in the unit square; None if they do not fit."""
    out, at, bottom, top = [], 0.0, 0.0, 0.0
    for wide, tall in box.tolist():
        if at + wide > 1:
            at, bottom = 0.0, top
        if at + wide > 1 or bottom + tall > 1:
            return None
        top = max(top, bottom + tall)
        out.append((at, bottom))
        at += wide
    return np.array(out)


def _searched(board: Board, sizes: np.ndarray, trials: int) -> list[tuple[int, Recipe]]:
    """The narrowest squares found with some orders, and how to fill them, the best one first."""
    random = np.random.default_rng(0)
    extent = np.array([max(own[0].mask.shape) for own in board.stamps], float)
    found: list[tuple[int, Recipe]] = []
    best = None
    for trial in range(trials):
        measure = sizes if trial % 2 else extent**2
        noise = np.exp((0.0 if trial < 6 else 0.35) * random.standard_normal(len(sizes)))
        order = np.argsort(-measure * noise, kind="stable")
        recipe = Recipe(order, (0.0, 0.3, 1.0)[trial // 2 % 3])
        if best is None:
            while isinstance(board.placed(recipe, board.canvas), int):
                board = board.with_canvas(int(1.3 * board.canvas))
        own = _narrowest(board, recipe, board.canvas if best is None else best)
        if own is not None:
            if not any(_same(own[1], other[1]) for other in found):
                found.append(own)
            best = own[0]
            board = board.narrowed(best)
    return sorted(found, key=lambda pair: pair[0])[:_FINALS]


def _same(one: Recipe, other: Recipe) -> bool:
    """Whether two recipes put every chart to the same place."""
    pairs = ((one.turns, other.turns), (one.goals, other.goals))
    return all(a is not None and b is not None and np.array_equal(a, b) for a, b in pairs)


def _narrowest(board: Board, recipe: Recipe, width: int) -> tuple[int, Recipe] | None:
    """A square no wider than given, and how to fill it; a chart that does not fit comes first."""
    best, left = None, _RETRIES
    while left >= 0:
        places = board.placed(recipe, width)
        if isinstance(places, int):
            recipe, left = recipe.urgent(places), left - 1
            continue
        goals = board.origins(places) / width
        best = (width, replace(recipe, turns=board.turn_numbers(places), goals=goals))
        width -= max(1, width // 100)
    return best


def _tightest(board: Board, recipe: Recipe, width: int, hope: float) -> Packing:
    """The narrowest square on a fine grid: charts move together from where they lie.

    Charts are put first only if the scale without that is the one hoped for.
    """
    places: Places | int = -1
    while isinstance(places, int):
        board = board.with_canvas(width)
        places = board.placed(recipe, width)
        if isinstance(places, int):
            width += max(1, width // 100)
    best, step = (width, places), max(1, width // 64)
    while step:
        # each step starts from the last good places, pulled together
        goals = board.origins(best[1]) / best[0]
        trial = replace(recipe, goals=goals)
        left = 0 if step > 1 or board.unit < hope * best[0] else _FINE_RETRIES
        places = board.placed(trial, best[0] - step)
        while isinstance(places, int) and left:
            trial, left = trial.urgent(places), left - 1
            places = board.placed(trial, best[0] - step)
        if isinstance(places, int):
            step //= 2
        else:
            best, recipe = (best[0] - step, places), trial
    width, found = best
    turn = np.stack([own[k].turn for own, (k, _, _) in zip(board.stamps, found, strict=True)])
    return Packing(board.unit / width, turn, board.origins(found) / width)
