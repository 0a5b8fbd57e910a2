"""What each kind of skipping saves: the same work with and without it, timed."""

import copy
import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch

from monopart.geometry.culling import ShellSamples
from monopart.geometry.posed_parts import PosedParts

from .avatar import Avatar, View
from .explain import plain_console
from .losses import round_trip_distance
from .model import AvatarModel, FrameInput, Rendered, Shaded
from .profiling import twin_of
from .render import render_view
from .skipping import EVERY, KINDS, PRUNE, Skipping
from .train import Trainer
from .unskipped import partly_skipping

ROUNDS = 2  # times that each is measured, in turn; the shorter time counts
STEPS = 3  # training steps of one measurement
OF_TRAINING = ("voxels", "parts", "colors", "cells")  # a training ray is near the person anyway
FORWARD = "forward"


@dataclass(frozen=True)
class Saving:
    """One kind of skipping, and what it is worth.

    Attributes:
        kind: a field of `Skipping`, "forward", or "all".
        what: what is left out.
        seconds: wall-clock seconds with it (and all others).
        seconds_without: without it.
        cpu: processor seconds with it.
        cpu_without: without it.
        change: largest difference of a colour, full scale 1, that it makes.
    """

    kind: str
    what: str
    seconds: float
    seconds_without: float
    cpu: float
    cpu_without: float
    change: float


@dataclass(frozen=True)
class _Run:
    """The work of a measurement: its colours, and how long it took."""

    color: torch.Tensor
    seconds: float
    cpu: float


Work = Callable[[], _Run]


def described(kind: str) -> str:
    """What a kind of skipping leaves out, in words.

    >>> described("voxels")
    'samples in voxels that no part reaches'
    """
    return _WORDS[kind]


def rendering_savings(avatar: Avatar, view: View) -> list[Saving]:
    """Render a view without each kind of skipping.

    `cells` is off in rendering, where it would not be exact: its row says what it would save.

    Args:
        avatar: the person.
        view: the picture.
    """
    scene = avatar.pose_scene(view.pose)

    def rendered(skip: Skipping = EVERY, prune: float = 0.0, who: Avatar = avatar) -> Work:
        def work() -> _Run:
            with _Clock() as clock:
                picture = render_view(who, view, prune=prune, skip=skip, scene=scene)
            return _Run(picture.color, clock.wall, clock.cpu)

        return work

    exact = [kind for kind in KINDS if kind != "cells"]
    works = {kind: rendered(EVERY.without([kind])) for kind in exact}
    if avatar.model.forward_residual is not None:
        works[FORWARD] = rendered(who=_with_forward(avatar))
    runs = _measured({"": rendered(), "cells": rendered(prune=PRUNE), **works})
    base, pruned = runs.pop(""), runs.pop("cells")
    return [*_rows(base, runs), _saving("cells", pruned, base)]


def training_savings(trainer: Trainer) -> list[Saving]:
    """Take a few steps without each kind of skipping, on copies: the trainer stays as it is.

    Args:
        trainer: where to start from; every measurement begins there, with the same batches.
    """

    def trained(skip: Skipping) -> Work:
        def work() -> _Run:
            twin = twin_of(trainer)
            twin.skip = skip
            parts = partly_skipping(twin.scene.parts, skip)
            twin.scene = dataclasses.replace(twin.scene, parts=parts)
            twin.generator.manual_seed(0)
            twin.avatar.model.train()
            with torch.no_grad():
                color = twin.losses(1, 0.0)[1].color
            with _Clock() as clock:
                for step in range(STEPS):
                    twin.step(2 * step + 1, 0.0)  # odd: no probe, no average, no patch
            return _Run(color, clock.wall / STEPS, clock.cpu / STEPS)

        return work

    kinds = [k for k in OF_TRAINING if k != "cells" or trainer.config.train.occupancy]
    works = {kind: trained(EVERY.without([kind])) for kind in kinds}
    with torch.random.fork_rng(devices=[]):
        runs = _measured({"": trained(EVERY), **works, "all": trained(EVERY.without(kinds))})
    return _rows(runs.pop(""), runs)


class _Clock:
    """Wall-clock and processor seconds of a block."""

    wall = cpu = 0.0

    def __enter__(self) -> "_Clock":
        self.wall, self.cpu = -time.perf_counter(), -time.process_time()
        return self

    def __exit__(self, *error: object) -> None:
        self.wall += time.perf_counter()
        self.cpu += time.process_time()


def _measured(works: dict[str, Work]) -> dict[str, _Run]:
    """Each work in turn, and again; the shorter times. The first, unmeasured run warms up."""
    next(iter(works.values()))()
    runs: dict[str, _Run] = {}
    for _ in range(ROUNDS):
        for kind, work in works.items():
            new, old = work(), runs.get(kind)
            if old is not None:
                new = _Run(old.color, min(old.seconds, new.seconds), min(old.cpu, new.cpu))
            runs[kind] = new
    return runs


def _rows(base: _Run, runs: dict[str, _Run]) -> list[Saving]:
    return [_saving(kind, base, run) for kind, run in runs.items()]


def _saving(kind: str, on: _Run, off: _Run) -> Saving:
    change = float((on.color - off.color).abs().max()) if on.color.numel() else 0.0
    times = on.seconds, off.seconds, on.cpu, off.cpu
    return Saving(kind, described(kind), *times, change)


class _ForwardToo(AvatarModel):
    """A model that also computes the round trip of every pair, which rendering has no use for."""

    bodies_at_rest: PosedParts

    def shade(
        self,
        bodies: PosedParts,
        frames: FrameInput,
        samples: ShellSamples,
        prune: float = 0.0,
        skip: Skipping = EVERY,
    ) -> Shaded:
        """As `AvatarModel.shade`, and the forward deformation of its pairs."""
        shaded = super().shade(bodies, frames, samples, prune, skip)
        nothing = torch.zeros(0)
        out = Rendered(torch.zeros(0, 3), nothing, nothing, {}, samples, shaded)
        rows = torch.arange(len(shaded.pairs.sample))
        round_trip_distance(self, bodies, self.bodies_at_rest, frames, out, rows)
        return shaded


def _with_forward(avatar: Avatar) -> Avatar:
    model = copy.copy(avatar.model)
    model.__class__ = _ForwardToo
    object.__setattr__(model, "bodies_at_rest", avatar.canonical_parts())
    return dataclasses.replace(avatar, model=model)


def print_savings(title: str, savings: Sequence[Saving]) -> None:
    """Print what each kind saves, on stderr.

    Args:
        title: heading of the table.
        savings: its rows.
    """
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    table.add_column("kind", no_wrap=True)
    table.add_column("left out")
    for name in ("with", "without", "saved", "saved CPU", "difference"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in savings:
        table.add_row(row.kind, row.what, *_cells(row))
    plain_console().print(table)


def _cells(row: Saving) -> Iterator[str]:
    wall, cpu = row.seconds_without - row.seconds, row.cpu_without - row.cpu
    for seconds in (row.seconds, row.seconds_without, wall, cpu):
        yield f"{seconds:.3f} s"
    yield f"{row.change:.1e}"


_WORDS = {
    "box": "rays outside the screen box of the shell",
    "shell": "rays of the box that miss the shell",
    "voxels": "samples in voxels that no part reaches",
    "parts": "searches of parts that do not reach the voxel",
    "light": "samples behind a front that leaves 5e-5 of the light",
    "colors": "colours of pairs that are not the densest",
    "cells": "cells learned to be empty or hidden (approximate)",
    FORWARD: "forward deformation, which only a loss uses",
    "all": "all of these",
}
