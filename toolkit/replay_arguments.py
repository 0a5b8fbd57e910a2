"""The command line of ``monopart replay``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Replay:
    """Repeat a training step that was not finite, from the file that the training wrote."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """File in a run's folder culprits."""
    body: Annotated[
        Path | None, arg(metavar="FILE", help_behavior_hint="(default: the free body)")
    ] = None
    """Body file of the capture."""

    def run(self) -> None:
        """Do it."""
        from .replay import replay

        replay(self.file, self.body)
