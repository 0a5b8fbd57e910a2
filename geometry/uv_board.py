"""Boards on which charts are laid as stamps of cells: where one fits is a correlation."""

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from jaxtyping import Bool, Float, Int

from .uv_coverage import coverage

_WORKERS = 2
_LONG = 1.5
"""Length of the longest chart in sides of the grid, at most: more cells would not help."""
_HIT = 2.5
"""What a cell that is taken costs a place; contact with all that is taken around is worth 1."""
_CONTACT, _AWAY = 0.3, 4.0
"""Worth of contact, and price of a way as long as the square, for charts that have a goal."""
_REACHES = (20, 60)
"""Cells around a goal that are looked at before the whole board is."""


@dataclass(frozen=True, eq=False)
class Stamp:
    """Cells that a turned chart covers with its margin, and those around them."""

    turn: Float[np.ndarray, "2 2"]
    """Rotation of the chart."""
    low: Float[np.ndarray, "2"]
    """What to take off the turned coordinates (in cells) to come to the cells of the mask."""
    mask: Bool[np.ndarray, "h w"]
    rim: Bool[np.ndarray, "h w"]

    @property
    def worth(self) -> Float[np.ndarray, "h w"]:
        """What each taken cell adds to a place: contact is good, a hit is worse than no contact."""
        return (self.rim / self.rim.sum() - _HIT * self.mask).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Recipe:
    """How charts are put down one after the other."""

    order: Int[np.ndarray, "C"]
    bias: float
    """How much a place near the lower left corner is worth against contact."""
    turns: Int[np.ndarray, "C"] | None = None
    """The one turn that each chart may have, or None for all."""
    goals: Float[np.ndarray, "C 2"] | None = None
    """Where the origin of each chart should lie, in the unit square."""

    def urgent(self, chart: int) -> "Recipe":
        """The same with a chart that did not fit put first."""
        return replace(self, order=np.concatenate([[chart], self.order[self.order != chart]]))


Places = list[tuple[int, int, int]]
"""Stamp, row and column of each chart."""


@dataclass(frozen=True, eq=False)
class Board:
    """All charts as stamps, and their spectra."""

    stamps: list[list[Stamp]]
    spectra: dict[tuple[int, int, int], np.ndarray]
    """Of the stamps of a chart, by its number and the size of the transform; filled on demand."""
    unit: float
    """Cells per unit of length."""
    canvas: int
    turns: int
    """Number of turns of a chart; a stamp's number is of those, or of every so many of them."""

    @classmethod
    def of(
        cls,
        faces: list[np.ndarray],
        sizes: Float[np.ndarray, "C"],
        grid: int,
        gap: float,
        count: int,
        turns: Int[np.ndarray, "C"] | None = None,
    ) -> "Board":
        """Stamps of charts.

        Args:
            faces: corners of the faces of each chart, (F, 3, 2).
            sizes: area of each chart.
            grid: cells along a square that the charts fill to seven tenths.
            gap: least distance of charts, cells.
            count: turns that a chart may have.
            turns: the one that each has, or None for all of them (a quarter for small charts).
        """
        # the charts cover seven tenths of the cells, or the longest spans them all and more
        longest = max(float(np.hypot(*np.ptp(own, axis=(0, 1)))) for own in faces)
        full = np.sqrt(0.7 / max(float(sizes.sum()), 1e-300))
        unit = grid * min(full, _LONG / max(longest, 1e-300))
        every = np.arange(count)
        small = every[:: max(1, count // 4)]
        few = sizes < 0.004 * sizes.sum()
        stamps = []
        for chart, own in enumerate(faces):
            some = (small if few[chart] else every) if turns is None else turns[chart : chart + 1]
            stamps.append(_stamps(own * unit, gap / 2, some, count))
        return cls(stamps, {}, unit, 0, count).with_canvas(int(1.25 * grid))

    @property
    def need(self) -> int:
        """Cells along the largest stamp."""
        return max(max(s.mask.shape) for own in self.stamps for s in own)

    def with_canvas(self, canvas: int) -> "Board":
        """The same on another canvas, which holds every stamp."""
        return replace(self, canvas=_round_up(max(canvas, self.need + 2)))

    def narrowed(self, width: int) -> "Board":
        """The same with room for a square of some cells: transforms cost what the canvas holds."""
        board = self.with_canvas(width)
        return board if board.canvas <= 0.93 * self.canvas else self

    def placed(self, recipe: Recipe, width: int) -> Places | int:
        """The places of the charts in a square of some cells; the first that does not fit if any.

        Args:
            recipe: their order, and where they want to go.
            width: cells along the square, no more than the canvas has.
        """
        taken = np.ones((self.canvas, self.canvas), np.float32)
        taken[1 : width - 1, 1 : width - 1] = 0
        places: Places = [(0, 0, 0)] * len(self.stamps)
        for chart in recipe.order.tolist():
            if recipe.goals is None:
                found = self._touching(taken, chart, width, recipe.bias)
            else:
                found = self._near(taken, chart, width, recipe.goals[chart])
            if found is None:
                return chart
            which, row, column = found
            mask = self.stamps[chart][which].mask
            taken[row : row + mask.shape[0], column : column + mask.shape[1]][mask] = 1
            places[chart] = found
        return places

    def _touching(
        self, taken: np.ndarray, chart: int, width: int, bias: float
    ) -> tuple[int, int, int] | None:
        """Stamp and place of the most contact, less what it is worth to lie near the corner."""
        from scipy import fft

        size = self.canvas
        product = np.asarray(fft.rfft2(taken)) * self._spectra(chart, size, size)
        values = np.asarray(fft.irfft2(product, (size, size), workers=_WORKERS))
        if bias:
            at = np.arange(size, dtype=np.float32)
            for number, stamp in enumerate(self.stamps[chart]):
                height, wide = stamp.mask.shape
                far = np.maximum((at + height)[:, None], at + wide)
                values[number] -= np.float32(bias / width) * far
        which, row, column = np.unravel_index(int(values.argmax()), values.shape)
        height, wide = self.stamps[chart][which].mask.shape
        # a place that is free is worth no less than nothing, less the bias for the farthest corner
        good = values[which, row, column] > -bias - 0.5
        inside = row + height <= width and column + wide <= width
        return (int(which), int(row), int(column)) if good and inside else None

    def _near(
        self, taken: np.ndarray, chart: int, width: int, goal: np.ndarray
    ) -> tuple[int, int, int] | None:
        """The place nearest to a goal, with some worth for contact; looked for around it first."""
        stamp = self.stamps[chart][0]
        room = np.array([width, width]) - stamp.mask.shape
        if (room < 0).any():
            return None
        middle = (goal * width + stamp.low)[::-1]
        for reach in (*_REACHES, width):
            first = np.clip(np.floor(middle).astype(int) - reach, 0, room)
            last = np.clip(np.ceil(middle).astype(int) + reach, 0, room)
            values = self._window(taken, chart, first, last)
            rows = np.arange(first[0], last[0] + 1)[:, None] - middle[0]
            away = np.hypot(rows, np.arange(first[1], last[1] + 1) - middle[1])
            worth = _CONTACT * values - (_AWAY / width) * away
            best = int(worth.argmax())
            row, column = divmod(best, worth.shape[1])
            # no place farther out is worth more
            if values[row, column] > -0.5 and (
                worth[row, column] >= _CONTACT - _AWAY * reach / width or reach == width
            ):
                return 0, int(first[0] + row), int(first[1] + column)
        return None

    def _window(
        self, taken: np.ndarray, chart: int, first: np.ndarray, last: np.ndarray
    ) -> np.ndarray:
        """Contact of the stamp of a chart at some places less what it hits there."""
        from scipy import fft

        shape = self.stamps[chart][0].mask.shape
        part = taken[first[0] : last[0] + shape[0], first[1] : last[1] + shape[1]]
        size = (_round_up(part.shape[0]), _round_up(part.shape[1]))
        product = np.asarray(fft.rfft2(part, size)) * self._spectra(chart, *size)[0]
        values = np.asarray(fft.irfft2(product, size))
        return values[: last[0] - first[0] + 1, : last[1] - first[1] + 1]

    def _spectra(self, chart: int, height: int, width: int) -> np.ndarray:
        from scipy.fft import rfft2

        key = (chart, height, width)
        if key not in self.spectra:
            own = self.stamps[chart]
            all_worth = np.zeros((len(own), height, width), np.float32)
            for worth, stamp in zip(all_worth, own, strict=True):
                worth[: stamp.mask.shape[0], : stamp.mask.shape[1]] = stamp.worth
            self.spectra[key] = np.conj(np.asarray(rfft2(all_worth, workers=_WORKERS)))
        return self.spectra[key]

    def origins(self, places: Places) -> Float[np.ndarray, "C 2"]:
        """Where the origin of each chart lies, in cells."""
        return np.array(
            [
                np.array([column, row]) - self.stamps[chart][which].low
                for chart, (which, row, column) in enumerate(places)
            ]
        )

    def turn_numbers(self, places: Places) -> Int[np.ndarray, "C"]:
        """Which of all turns each chart has."""
        return np.array(
            [
                which * (max(1, self.turns // 4) if len(own) < self.turns else 1)
                for own, (which, _, _) in zip(self.stamps, places, strict=True)
            ]
        )


def rotation(angle: float) -> Float[np.ndarray, "2 2"]:
    """Matrix of a turn.

    Args:
        angle: radians, counter-clockwise.

    Returns:
        The matrix, for columns.
    """
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def level_angle(points: Float[np.ndarray, "n 2"]) -> float:
    """Turn that gives points the smallest upright box, of 64 turns.

    Args:
        points: the points.

    Returns:
        The angle, radians.
    """
    angles = np.linspace(0, np.pi / 2, 64, endpoint=False)
    axes = np.stack([np.cos(angles), np.sin(angles)])
    along, across = points @ axes, points @ np.stack([-axes[1], axes[0]])
    box = np.ptp(along, axis=0) * np.ptp(across, axis=0)
    return -float(angles[int(box.argmin())])


def _stamps(corner: np.ndarray, gap: float, turns: np.ndarray, count: int) -> list[Stamp]:
    """A chart in some of so many turns; turn 0 has its long side level or upright.

    Quarter turns of the others, where the count allows it, cost no test of the cells.
    """
    base = level_angle(corner.reshape(-1, 2))
    own = count // 4 if count % 4 == 0 else count
    found: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    out = []
    for k in turns.tolist():
        if k % own not in found:
            found[k % own] = coverage(
                corner @ rotation(base + 2 * np.pi * (k % own) / count).T, gap
            )
        mask, low = found[k % own]
        for _ in range(k // own):
            mask, low = mask[::-1].T, np.array([-low[1] - len(mask), low[0]])
        mask = np.pad(mask, 1)
        near = mask.copy()
        near[1:] |= mask[:-1]
        near[:-1] |= mask[1:]
        near[:, 1:] |= mask[:, :-1]
        near[:, :-1] |= mask[:, 1:]
        out.append(Stamp(rotation(base + 2 * np.pi * k / count), low - 1, mask, near & ~mask))
    return out


def _round_up(number: int) -> int:
    from scipy.fft import next_fast_len

    return int(cast(Any, next_fast_len)(int(number), True))
