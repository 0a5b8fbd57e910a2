"""The arguments of ``monopart ablate``."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from monopart.geometry.errors import InputError

from .grid import PAPER
from .presets import preset_names

ProtocolName = Literal["strict", "legacy", "boxed"]
_OWN = "(default: the preset's)"


@dataclass(frozen=True)
class Ablate:
    """Train a grid of configurations over seeds and captures, and write the table of differences.

    Each training is a run folder OUT/CAPTURE/CELL/seed-K; OUT/table.md, .json and .csv hold mean
    and standard deviation over seeds, and the difference to cell full, paired over seeds, beside
    the paper's own figures. The same command goes on where it was cut short. All cells are checked
    before the first one is trained.
    """

    captures: Annotated[Positional[tuple[Path, ...]], arg(metavar="CAPTURE ...")]
    """Folders of captures."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder of the trainings and tables."""
    only: Annotated[
        tuple[str, ...], arg(metavar="CELL ...", help_behavior_hint="(default: all)")
    ] = ()
    """Cells to train, beside full."""
    base: Annotated[
        str, arg(metavar="NAME", help="Preset of the cells: " + ", ".join(preset_names()) + ".")
    ] = "full"
    """Preset of the cells that name none."""
    grid: Annotated[
        Path | None, arg(metavar="FILE.json", help_behavior_hint="(default: the paper's)")
    ] = None
    """Another grid: {"CELL": {"label": "...", "set": ["loss.mse*=0.5"], "preset": "..."}}."""
    seeds: Annotated[int, arg(metavar="N")] = 3
    """Number of seeds, from 0."""
    seconds: Annotated[float | None, arg(metavar="S", help_behavior_hint=_OWN)] = None
    """Wall-clock seconds of each training; not together with --iterations."""
    iterations: Annotated[int | None, arg(metavar="N", help_behavior_hint=_OWN)] = None
    """Steps of each training; not together with --seconds."""
    images: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: all)")] = None
    """Held-out images to score per split, evenly spread; the table says so."""
    protocols: Annotated[tuple[ProtocolName, ...], arg(metavar="strict|legacy|boxed ...")] = (
        "strict",
    )
    """Protocols to score under; each costs another pass of LPIPS. strict is always one of them."""
    set: Annotated[
        tuple[tuple[str, ...], ...],
        UseAppendAction,
        arg(metavar="SECTION.ENTRY=VALUE ..."),
    ] = ()
    """Entries to replace in every cell; a cell's own come after them."""
    params: Annotated[
        str | None, arg(metavar="NAME", help_behavior_hint="(default: new_params, else params)")
    ] = None
    """Folder of body poses inside the captures."""
    jobs: Annotated[int, arg(metavar="N")] = 1
    """Trainings at a time; each gets its share of the cores."""
    publish: Annotated[
        Path | None, arg(metavar="PAGE.md", help_behavior_hint="(default: none)")
    ] = None
    """Page whose part between the marks "NAME: begin" and "NAME: end" (NAME: of --out) becomes the
    tables; files go into the folder beside it that is called as it is."""
    device: Annotated[str, arg(metavar="cpu|cuda|cuda:N|auto")] = "cpu"
    """Where to train; auto is a GPU where there is one."""

    def run(self) -> None:
        """Do it."""
        from .ablate import Plan, ablate
        from .arguments import check_count
        from .grid import chosen, read_grid

        for name in ("seeds", "images", "jobs"):
            check_count(f"--{name}", getattr(self, name))
        if not self.captures:
            raise InputError("CAPTURE: expected at least one folder, found none; name one")
        if self.publish is not None and not self.publish.is_file():
            raise InputError(
                f"--publish {self.publish}: expected a page, found none; write it first"
            )
        grid = PAPER if self.grid is None else read_grid(self.grid)
        settings = tuple(s for group in self.set for s in group)
        plan = Plan(
            self.captures,
            self.out,
            chosen(grid, self.only),
            self.seeds,
            self.base,
            settings,
            self.seconds,
            self.iterations,
            self.images,
            self.params,
            self.device,
            self.jobs,
            self.protocols,
        )
        print(ablate(plan, self.command(), self.publish))

    def command(self) -> str:
        """The command line that asks for this, with folders by their names alone."""
        words = ["monopart", "ablate", *(f"CAPTURES/{c.resolve().name}" for c in self.captures)]
        words += ["--out", f"runs/{self.out.name}"]
        words += ["--grid", self.grid.name] if self.grid else []
        for name in ("base", "seeds", "seconds", "iterations", "images", "params", "jobs"):
            value = getattr(self, name)
            words += [] if value is None else [f"--{name}", str(value)]
        words += ["--protocols", *self.protocols]
        words += ["--only", *self.only] if self.only else []
        settings = [s for group in self.set for s in group]
        words += ["--set", *settings] if settings else []
        return shlex.join(words)
