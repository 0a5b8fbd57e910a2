"""Tables of a grid: mean ± standard deviation over seeds, and differences paired over seeds."""

import statistics
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from .grid import FULL, Variant

AS_GIVEN = "as given"
"""Body poses of the evaluated frames as the capture states them."""
BETTER = {"psnr": 1, "ssim": 1, "lpips": -1, "mask_iou": 1, "depth_mm": -1, "depth_median_mm": -1}
"""Whether more (1) or less (-1) of a metric is better."""


@dataclass(frozen=True)
class Key:
    """What one figure is of.

    Attributes:
        capture: name of the capture.
        split: such as novel_view.
        poses: body poses of the evaluated frames: as given, or refit.
        protocol: such as strict.
        region: such as full.
        metric: such as psnr.
    """

    capture: str
    split: str
    poses: str
    protocol: str
    region: str
    metric: str


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation over seeds.

    Attributes:
        values: seed to value.
        mean: their mean.
        deviation: their standard deviation (n - 1); None for one seed.
    """

    values: Mapping[int, float]
    mean: float
    deviation: float | None

    @classmethod
    def of(cls, values: Mapping[int, float]) -> "Spread":
        """The spread of at least one value.

        >>> Spread.of({0: 1.0, 1: 3.0}).deviation
        1.4142135623730951
        """
        numbers = list(values.values())
        deviation = statistics.stdev(numbers) if len(numbers) > 1 else None
        return cls(dict(values), statistics.fmean(numbers), deviation)

    def minus(self, other: "Spread") -> "Spread | None":
        """Differences paired over the seeds that both have; None without such."""
        common = self.values.keys() & other.values.keys()
        if not common:
            return None
        return Spread.of({s: self.values[s] - other.values[s] for s in sorted(common)})


Table = dict[Key, dict[str, Spread]]
"""Key to name of a cell to its spread."""


def collected(summaries: Iterable[Mapping[str, Any]]) -> Table:
    """Every figure of every cell, over its seeds.

    Args:
        summaries: contents of summary.json.
    """
    values: dict[Key, dict[str, dict[int, float]]] = {}
    for summary in summaries:
        for path, value in _figures(summary["metrics"]):
            split, _, poses = path[0].partition("@")
            key = Key(summary["capture"], split, poses or AS_GIVEN, *path[1:])
            values.setdefault(key, {}).setdefault(summary["cell"], {})[summary["seed"]] = value
    return {
        key: {name: Spread.of(seeds) for name, seeds in cells.items()}
        for key, cells in values.items()
    }


def _figures(metrics: Mapping[str, Any]) -> Iterable[tuple[tuple[str, str, str, str], float]]:
    for split, protocols in metrics.items():
        for protocol, regions in protocols.items():
            for region, scores in regions.items():
                for metric, value in scores.items():
                    if value is not None:
                        yield (split, protocol, region, metric), float(value)


def verdict(metric: str, difference: Spread | None) -> str:
    """What a cell does to a metric, against the noise of the paired differences.

    Args:
        metric: name of the metric.
        difference: cell minus full, over seeds.

    Returns:
        "better", "worse", "within noise", or "one seed", where there is no noise to compare
        with, or "no pair", where no seed is common.

    >>> verdict("lpips", Spread.of({0: -0.010, 1: -0.012}))
    'better'
    """
    if difference is None:
        return "no pair"
    if difference.deviation is None:
        return "one seed"
    if abs(difference.mean) <= difference.deviation:
        return "within noise"
    return "better" if difference.mean * BETTER.get(metric, 1) > 0 else "worse"


def rows_of(
    table: Table, variants: Mapping[str, Variant], equal: Mapping[str, str]
) -> list[dict[str, Any]]:
    """One row per figure and cell, for the files.

    Args:
        table: from `collected`.
        variants: name to variant, in order.
        equal: variants that share the training of another one.
    """
    rows = []
    for key, cells in table.items():
        for name, variant in variants.items():
            spread = cells.get(equal.get(name, name))
            if spread is None:
                continue
            full = cells.get(FULL)
            difference = spread.minus(full) if full and name != FULL else None
            published = variant.published.get(key.split) if key.metric == "psnr" else None
            rows.append(
                vars(key)
                | {
                    "cell": name,
                    "seeds": len(spread.values),
                    "mean": spread.mean,
                    "deviation": spread.deviation,
                    "minus_full": difference.mean if difference else None,
                    "minus_full_deviation": difference.deviation if difference else None,
                    "effect": verdict(key.metric, difference) if name != FULL else None,
                    "source": f"measured, {key.capture}",
                    "published_psnr_zju_mocap_legacy": published,
                }
            )
    return rows
