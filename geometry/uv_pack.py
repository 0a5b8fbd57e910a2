"""Packing of charts into the unit square: turned, rasterised, put where they touch the most."""

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from jaxtyping import Bool, Float, Int

from .errors import InputError
from .uv_coverage import coverage

_COARSE, _FINE = ((96, 12), (64, 24)), 384
"""Cells of the coarse grids and turns that a chart may have on each; cells of the fine grid."""
_GOOD = 0.65
"""Share of the square at which the second coarse grid is not tried."""
_LONG = 1.5
"""Length of the longest chart in sides of the grid, at most: more cells would not help."""
_TRIALS = 18
_WORKERS = 2
_FREE, _MANY = 60, 150
"""Up to the first number of charts all orders are tried; above the second boxes go on shelves."""


@dataclass(frozen=True, eq=False)
class Stamp:
    """Cells that a turned chart covers with its margin, and those around them."""

    turn: Float[np.ndarray, "2 2"]
    """Rotation of the chart."""
    low: Float[np.ndarray, "2"]
    """What to take off the turned coordinates (in cells) to come to the cells of the mask."""
    mask: Bool[np.ndarray, "h w"]
    rim: Bool[np.ndarray, "h w"]


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

    Many orders are tried on a coarse grid; the best one is repeated on a fine grid; all that on a
    second coarse grid where the first one leaves more than a third of the square. More than 150
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
    best = None
    for grid, turns in _COARSE:
        coarse = _Board.of(faces, sizes, grid, margin * grid / size, turns)
        width, recipe = _searched(coarse, sizes)
        fine = int(np.clip(size // 2, 2 * _COARSE[0][0], _FINE))
        board = _Board.of(faces, sizes, fine, margin * fine / size, turns, recipe.turns)
        found = _tightest(board, recipe, int(width * fine / grid) + 2)
        best = found if best is None or found.scale > best.scale else best
        if best.scale**2 * sizes.sum() >= _GOOD:
            break
    return cast(Packing, best)


def _rows_of(chart: np.ndarray, count: int) -> list[np.ndarray]:
    order = np.argsort(chart, kind="stable")
    return np.split(order, np.searchsorted(chart[order], np.arange(1, count)))


def _shelved(faces: list[np.ndarray], gap: float) -> Packing:
    """Charts in their smallest boxes, the tallest first, in rows from the bottom."""
    turns, lows, boxes = [], [], []
    for corner in faces:
        angle = _level_angle(corner.reshape(-1, 2))
        turned = corner.reshape(-1, 2) @ _rotation(angle).T
        if np.ptp(turned[:, 1]) > np.ptp(turned[:, 0]):
            angle += np.pi / 2
            turned = corner.reshape(-1, 2) @ _rotation(angle).T
        turns.append(_rotation(angle))
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


def _rotation(angle: float) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def _stamps(corner: np.ndarray, gap: float, turns: np.ndarray, count: int) -> list[Stamp]:
    """A chart in some of so many turns; turn 0 has its long side level or upright."""
    base = _level_angle(corner.reshape(-1, 2))
    out = []
    for k in turns:
        turn = _rotation(base + 2 * np.pi * k / count)
        mask, low = coverage(corner @ turn.T, gap)
        mask = np.pad(mask, 1)
        near = mask.copy()
        near[1:] |= mask[:-1]
        near[:-1] |= mask[1:]
        near[:, 1:] |= mask[:, :-1]
        near[:, :-1] |= mask[:, 1:]
        out.append(Stamp(turn, low - 1, mask, near & ~mask))
    return out


def _level_angle(points: np.ndarray) -> float:
    """Turn that gives the points the smallest upright box, of 64 turns."""
    angles = np.linspace(0, np.pi / 2, 64, endpoint=False)
    axes = np.stack([np.cos(angles), np.sin(angles)])
    along, across = points @ axes, points @ np.stack([-axes[1], axes[0]])
    box = np.ptp(along, axis=0) * np.ptp(across, axis=0)
    return -float(angles[int(box.argmin())])


@dataclass(frozen=True, eq=False)
class _Recipe:
    """How charts are put down one after the other."""

    order: np.ndarray
    bias: float
    """How much a place near the lower left corner is worth against contact."""
    turns: np.ndarray | None = None
    """The one turn that each chart may have, or None for all."""
    goals: np.ndarray | None = None
    """Where the origin of each chart should lie, in the unit square; contact counts if None."""


@dataclass(frozen=True, eq=False)
class _Board:
    """All charts as stamps, and their spectra: where a stamp fits is a correlation."""

    stamps: list[list[Stamp]]
    spectra: list[np.ndarray]
    unit: float
    """Cells per unit of length."""
    canvas: int
    turns: int
    """Number of turns of a chart; a stamp's number is of those, or of every so many of them."""

    @classmethod
    def of(
        cls,
        faces: list[np.ndarray],
        sizes: np.ndarray,
        grid: int,
        gap: float,
        count: int,
        turns: np.ndarray | None = None,
    ) -> "_Board":
        # the charts cover about seven tenths of the cells, or the longest spans them all and more
        longest = max(float(np.hypot(*np.ptp(own, axis=(0, 1)))) for own in faces)
        unit = grid * min(
            np.sqrt(0.7 / max(float(sizes.sum()), 1e-300)), _LONG / max(longest, 1e-300)
        )
        every = np.arange(count)
        small = every[:: max(1, count // 4)]
        few = sizes < 0.004 * sizes.sum()
        stamps = []
        for chart, own in enumerate(faces):
            some = (small if few[chart] else every) if turns is None else turns[chart : chart + 1]
            stamps.append(_stamps(own * unit, gap / 2, some, count))
        need = max(max(s.mask.shape) for own in stamps for s in own)
        canvas = _round_up(max(int(1.25 * grid), need + 2))
        return cls(stamps, [_spectra(own, canvas) for own in stamps], unit, canvas, count)

    def widened(self) -> "_Board":
        """The same with more room."""
        return self.with_canvas(_round_up(int(1.3 * self.canvas)))

    def narrowed(self, width: int) -> "_Board":
        """The same with room for a square of some cells: transforms cost what the canvas holds."""
        canvas = _round_up(width)
        return self if canvas > 0.93 * self.canvas else self.with_canvas(canvas)

    def with_canvas(self, canvas: int) -> "_Board":
        """The same on another canvas, which holds every stamp."""
        need = max(max(s.mask.shape) for own in self.stamps for s in own)
        canvas = max(canvas, _round_up(need))
        return _Board(
            self.stamps,
            [_spectra(own, canvas) for own in self.stamps],
            self.unit,
            canvas,
            self.turns,
        )

    def placed(self, recipe: _Recipe, width: int) -> list[tuple[int, int, int]] | None:
        """Turn, row and column of each chart in a square of some cells; None if they do not fit."""
        from scipy import fft

        taken = np.ones((self.canvas, self.canvas), bool)
        taken[1 : width - 1, 1 : width - 1] = False
        places: list[tuple[int, int, int]] = [(0, 0, 0)] * len(self.stamps)
        for chart in recipe.order:
            stamps = self.stamps[chart]
            spectrum = np.asarray(fft.fft2(taken.astype(np.complex64)))
            hits = np.asarray(fft.ifft2(spectrum * self.spectra[chart], workers=_WORKERS))
            best, found = -8.0, None
            for which, stamp in enumerate(stamps):
                if recipe.goals is None:
                    value = _worth(hits[which], stamp, width, recipe.bias)
                else:
                    value = _nearness(hits[which], stamp, width, recipe.goals[chart])
                at = int(value.argmax()) if value.size else -1
                if at >= 0 and value.flat[at] > best + 1e-4:
                    best, found = float(value.flat[at]), (which, *divmod(at, value.shape[1]))
            if found is None:
                return None
            which, row, column = found
            mask = stamps[which].mask
            taken[row : row + mask.shape[0], column : column + mask.shape[1]] |= mask
            places[chart] = (int(which), int(row), int(column))
        return places

    def origins(self, places: list[tuple[int, int, int]]) -> np.ndarray:
        """Where the origin of each chart lies, in cells."""
        return np.array(
            [
                np.array([column, row]) - self.stamps[chart][which].low
                for chart, (which, row, column) in enumerate(places)
            ]
        )


def _spectra(stamps: list[Stamp], canvas: int) -> np.ndarray:
    from scipy.fft import fft2

    both = np.zeros((len(stamps), canvas, canvas), np.complex64)
    for own, stamp in zip(both, stamps, strict=True):
        height, width = stamp.mask.shape
        own[:height, :width] = stamp.mask + 1j * stamp.rim
    return np.conj(np.asarray(fft2(both, workers=_WORKERS)))


def _worth(hits: np.ndarray, stamp: Stamp, width: int, bias: float) -> np.ndarray:
    """Value of each place of a stamp: −9 where it does not fit."""
    height, wide = stamp.mask.shape
    if max(height, wide) > width:
        return np.zeros((0, 0))
    hits = hits[: width - height + 1, : width - wide + 1]
    # conj(F(mask + i rim)) · F(taken) gives hits − i contacts
    contact = -np.imag(hits) / stamp.rim.sum()
    if bias:
        row, column = np.arange(hits.shape[0])[:, None], np.arange(hits.shape[1])[None]
        far = np.maximum(row + height, column + wide) / width
        contact = contact - np.float32(bias) * far.astype(np.float32)
    return np.where(np.real(hits) < 0.5, contact, np.float32(-9.0))


def _nearness(hits: np.ndarray, stamp: Stamp, width: int, goal: np.ndarray) -> np.ndarray:
    """Value of each place of a stamp: the nearer to a goal the better, −9 where it does not fit."""
    height, wide = stamp.mask.shape
    if max(height, wide) > width:
        return np.zeros((0, 0))
    hits = hits[: width - height + 1, : width - wide + 1]
    column, row = goal * width + stamp.low
    away = np.hypot(np.arange(len(hits))[:, None] - row, np.arange(hits.shape[1])[None] - column)
    contact = -np.imag(hits) / stamp.rim.sum()
    return np.where(np.real(hits) < 0.5, 0.3 * contact - 4 * away / width, -9.0)


def _round_up(number: int) -> int:
    from scipy.fft import next_fast_len

    return int(cast(Any, next_fast_len)(number))


def _searched(board: _Board, sizes: np.ndarray) -> tuple[int, _Recipe]:
    """The narrowest square found with many orders, and how to fill it."""
    random = np.random.default_rng(0)
    extent = np.array([max(own[0].mask.shape) for own in board.stamps], float)
    best: tuple[int, _Recipe] | None = None
    for trial in range(max(6, min(_TRIALS, _TRIALS * _FREE // len(sizes)))):
        measure = sizes if trial % 2 else extent**2
        noise = np.exp((0.0 if trial < 6 else 0.35) * random.standard_normal(len(sizes)))
        order = np.argsort(-measure * noise, kind="stable")
        recipe = _Recipe(order, (0.0, 0.3, 1.0)[trial // 2 % 3])
        width = board.canvas if best is None else best[0] - 1
        places = board.placed(recipe, width)
        if places is None and best is None:
            board = board.widened()
            continue
        while places is not None:
            turns = np.array([_turn_number(board, c, p[0]) for c, p in enumerate(places)])
            goals = board.origins(places) / width
            best = (width, _Recipe(order, recipe.bias, turns, goals))
            width -= max(1, width // 100)
            places = board.placed(recipe, width)
        if best is not None:  # always, here
            board = board.narrowed(best[0])
    if best is None:
        raise InputError("charts: expected charts that fit a square, found none that do")
    return best


def _turn_number(board: _Board, chart: int, which: int) -> int:
    count = len(board.stamps[chart])
    return which * max(1, board.turns // 4) if count < board.turns else which


def _tightest(board: _Board, recipe: _Recipe, width: int) -> Packing:
    """The narrowest square on a fine grid: charts move together from where they lie."""
    places = None
    while places is None:
        while width > board.canvas:
            board = board.widened()
        places = board.placed(recipe, width)
        if places is None:
            width += max(1, width // 100)
    board = board.narrowed(width)
    best, step = (width, places), max(1, width // 64)
    while step:
        # each step starts from the last good places, pulled together
        goals = board.origins(best[1]) / best[0]
        places = board.placed(replace(recipe, goals=goals), best[0] - step)
        if places is None:
            step //= 2
        else:
            best = (best[0] - step, places)
    width, places = best
    turn = np.stack([board.stamps[chart][which].turn for chart, (which, _, _) in enumerate(places)])
    return Packing(board.unit / width, turn, board.origins(places) / width)
