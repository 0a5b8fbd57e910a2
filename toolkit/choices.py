"""What a command line asks of training and rendering, beside the configuration."""

from dataclasses import dataclass

from .metrics import Protocol
from .skipping import EVERY, Skipping


@dataclass(frozen=True)
class Extras:
    """What a training does beside training, and where.

    Attributes:
        images: held-out images to evaluate per split; None for all.
        explain: print the table of what was skipped, and the time that each kind saves.
        profile: measure the stages of a step first; writes profile.json and profile.html.
        device: see :func:`pick_device`.
        protocols: names of protocols to score under; ``strict`` is always one.
    """

    images: int | None = None
    explain: bool = False
    profile: bool = False
    device: str = "cpu"
    protocols: tuple[Protocol, ...] = ("strict",)


@dataclass(frozen=True)
class Choices:
    """How a picture is made.

    Attributes:
        explain: print the table of what was skipped, and the time that each kind saves.
        coarse: samples of a ray per coarse one; 1 is exact.
        half: run the networks in float16.
        skip: what to leave out.
        device: see :func:`pick_device`.
    """

    explain: bool = False
    coarse: int = 1
    half: bool = False
    skip: Skipping = EVERY
    device: str = "cpu"
