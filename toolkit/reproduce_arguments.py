"""The arguments of ``monopart reproduce``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from .presets import preset_names

_OWN = "(default: the preset's)"
PRESET = "paper" if "paper" in preset_names() else preset_names()[0]
"""Preset of the paper's table."""


@dataclass(frozen=True)
class Reproduce:
    """Train and score the subjects of ZJU-MoCap and MonoCap; write the paper's table beside ours.

    A subject is found by the name of its folder (my_377, lan_images620_1300, ...) or its
    capture.json, in DATA or up to two folders below. Each training is a run folder OUT/SUBJECT;
    OUT/table.md and table.json hold the means of each data set. The same command goes on where it
    died. All subjects are checked before the first one is trained.
    """

    data: Annotated[Positional[tuple[Path, ...]], arg(metavar="DATA ...")]
    """Folders that hold subjects."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder of the trainings and the table."""
    body: Annotated[
        Path | None, arg(metavar="FILE", help_behavior_hint="(default: each capture's body.npz)")
    ] = None
    """Body file of the data sets: SMPL, neutral (.npz or .pkl), under its own licence."""
    only: Annotated[
        tuple[str, ...], arg(metavar="SUBJECT ...", help_behavior_hint="(default: all found)")
    ] = ()
    """Subjects to train."""
    preset: Annotated[
        str, arg(metavar="NAME", help="Configuration to start from: " + ", ".join(preset_names()))
    ] = PRESET
    """Configuration to start from."""
    seconds: Annotated[float | None, arg(metavar="S", help_behavior_hint=_OWN)] = None
    """Wall-clock seconds of each training; not together with --iterations."""
    iterations: Annotated[int | None, arg(metavar="N", help_behavior_hint=_OWN)] = None
    """Steps of each training; not together with --seconds."""
    seed: Annotated[int | None, arg(metavar="K", help_behavior_hint=_OWN)] = None
    """Seed of every training."""
    set: Annotated[
        tuple[tuple[str, ...], ...], UseAppendAction, arg(metavar="SECTION.ENTRY=VALUE ...")
    ] = ()
    """Entries of the configuration to replace."""
    images: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: all)")] = None
    """Held-out images to score per split, evenly spread; the table says so."""
    exact_pixels: bool = False
    """Scale images exactly, in place of the authors' way that the published figures were made
    with."""
    device: Annotated[str, arg(metavar="cpu|cuda|cuda:N|auto")] = "cpu"
    """Where to train; auto is a GPU where there is one."""

    def run(self) -> None:
        """Do it."""
        from .arguments import check_count, resolve

        check_count("--images", self.images)
        config = resolve(self.preset, self.set, self.seconds, self.iterations, self.seed)
        from .captures import Reading
        from .reproduce import reproduce

        body = None if self.body is None else str(self.body)
        reading = Reading(body=body, legacy_pixels=not self.exact_pixels)
        print(reproduce(self.data, self.out, config, reading, self.only, self.images, self.device))
