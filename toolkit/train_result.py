"""What a training did, as training.json keeps it."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any


@dataclass
class TrainResult:
    """What a training run did.

    Attributes:
        iterations: steps taken.
        seconds: wall-clock seconds of the loop.
        cpu_seconds: processor seconds of the loop, all threads.
        stats: sums of the counts of rays, samples and pairs over all steps.
        warnings: what a reader of the report must know.
        round_trips: histograms of the round-trip distances at some moments.
        capacity: size of each part's field.
        alignments: what the steps did that aligned the poses, see `align_poses`,
            and the finished part of the run before each.
        skipped: steps that were left out because a loss or a gradient was not finite.
        bad_steps: facts of the first of them.
    """

    iterations: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    stats: Counter = field(default_factory=Counter)
    warnings: list[str] = field(default_factory=list)
    round_trips: list[dict[str, Any]] = field(default_factory=list)
    capacity: list[dict[str, Any]] = field(default_factory=list)
    alignments: list[dict[str, float]] = field(default_factory=list)
    skipped: int = 0
    bad_steps: list[dict[str, Any]] = field(default_factory=list)
