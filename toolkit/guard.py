"""Steps whose loss or gradient is not finite: named, counted, kept as a file, never applied."""

import contextlib
import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from monopart.fields.hash_grid import HashGrid

from .captures.patches import PixelBatch
from .model import Rendered

if TYPE_CHECKING:
    from .train import Trainer

HUGE = 1e15
"""A gradient whose norm is larger overflows the squares of the optimiser: as good as infinite."""
NAMED = 8  # names of tensors that a message lists


@dataclass(frozen=True)
class BadStep:
    """What was not finite in a step, and where.

    Attributes:
        step: number of the step, from 0.
        terms: terms of the loss that are not finite, or whose gradients are not.
        tensors: where it showed: tensors of the rendering whose values, and learned tensors whose
            gradients, are not finite.
        camera: name of the camera of the first sample to blame; None where none is.
        frame: its frame number.
        pixel: its pixel centre (x, y).
        repeated: whether the same batch gave it again.
        file: name of the file for ``monopart replay``; None where none was written.
    """

    step: int
    terms: tuple[str, ...]
    tensors: tuple[str, ...]
    camera: str | None = None
    frame: int | None = None
    pixel: tuple[float, float] | None = None
    repeated: bool = True
    file: str | None = None

    def text(self) -> str:
        """One sentence."""
        what = f"step {self.step}: not finite: {', '.join(self.terms) or 'the loss'}"
        if self.tensors:
            more = len(self.tensors) - NAMED
            names = ", ".join(self.tensors[:NAMED]) + (f" and {more} more" if more > 0 else "")
            what += f" (in {names})"
        if self.pixel is not None:
            x, y = self.pixel
            what += f", first at frame {self.frame}, camera {self.camera}, pixel ({x:g}, {y:g})"
        return what + ("" if self.repeated else "; the same batch was finite when repeated")

    def facts(self) -> dict:
        """As JSON."""
        return dataclasses.asdict(self)


def too_many(skipped: int, bad_steps: Sequence[dict], run: Path | None) -> str:
    """What the error says that ends a run.

    Args:
        skipped: steps that were left out.
        bad_steps: facts of the first of them.
        run: the run folder, where there is one.
    """
    first = BadStep(**bad_steps[0])
    look = "" if first.file is None else f"; repeat it by: monopart replay {run}/{first.file}"
    kept = "" if run is None else "; the weights from before are saved"
    return (
        f"training: {skipped} steps were left out, as many as train.max_skipped allows{kept}. "
        f"The first, {first.text()}. Lower train.lr_network and train.lr_table{look}"
    )


def gradients_are_finite(parameters: Iterable[Tensor]) -> bool:
    """Whether all gradients are finite and small enough to be squared; waits for the device once.

    Args:
        parameters: those without a gradient are passed over.

    >>> weight = torch.zeros(2, requires_grad=True)
    >>> weight.grad = torch.tensor([0.0, float("nan")])
    >>> gradients_are_finite([weight])
    False
    """
    found = [p.grad for p in parameters if p.grad is not None]
    if not found:
        return True
    return bool(torch.nn.utils.get_total_norm(found, math.inf) <= HUGE)  # NaN compares false


@contextlib.contextmanager
def unchanged(trainer: "Trainer") -> Iterator[None]:
    """Give the trainer its random state back, and the model what it remembers of a rendering.

    Args:
        trainer: used for a computation that must leave no trace.
    """
    model, state = trainer.avatar.model, trainer.generator.get_state()
    memory = [(b, b.clone()) for b in (model.occupancy.peak, model.occupancy.floor)]
    grids = [m for m in model.modules() if isinstance(m, HashGrid)]
    adding = [grid.accumulate for grid in grids]
    try:
        for grid in grids:
            grid.accumulate = False  # gradients go where they are asked for
        yield
    finally:
        trainer.generator.set_state(state)
        for buffer, old in memory:
            buffer.copy_(old)
        for grid, old in zip(grids, adding, strict=True):
            grid.accumulate = old


def diagnose(trainer: "Trainer", step: int, done: float, state: Tensor) -> BadStep:
    """Repeat a step on the same batch, term by term, and find what is not finite.

    Args:
        trainer: its random state and gradients are the same afterwards.
        step: number of the step.
        done: finished part of the run, 0 to 1.
        state: random state from before the step.
    """
    with unchanged(trainer):
        trainer.generator.set_state(state)
        drawn = trainer.draw(step, done)
        terms, out = trainer.losses_of(drawn, step, done)
    named = dict(trainer.avatar.model.named_parameters())
    bad = [n for n, t in terms.items() if not math.isfinite(float(t.detach()))]
    inner = dict(_inner(out))
    tensors = [n for n, (t, _) in inner.items() if not bool(t.isfinite().all())]
    rows = [r for n in tensors for r in _rows(*inner[n])]
    watched = [(tensor, rays) for tensor, rays in inner.values() if tensor.requires_grad]
    wanted = [tensor for tensor, _ in watched] + list(named.values())
    for name, term in terms.items():
        if not term.requires_grad:
            continue
        found = torch.autograd.grad(term, wanted, retain_graph=True, allow_unused=True)
        for grad, (_, rays) in zip(found, watched, strict=False):  # those of the weights follow
            if grad is not None and not _sound(grad):
                rows += _rows(grad, rays)
        at = [n for n, g in zip(named, found[len(watched) :], strict=True) if not _sound(g)]
        tensors += [f"gradient of {n}" for n in at if f"gradient of {n}" not in tensors]
        bad += [name] if at and name not in bad else []
    where = _where(trainer, drawn[0], rows)
    return BadStep(step, tuple(bad), tuple(tensors), *where, repeated=bool(bad or tensors))


def _sound(grad: Tensor | None) -> bool:
    return grad is None or not grad.numel() or bool(grad.abs().amax() <= HUGE)


def _inner(out: Rendered) -> Iterator[tuple[str, tuple[Tensor, Tensor]]]:
    """Tensors of a rendering that can go wrong, each with the ray of its rows."""
    shaded, ray = out.shaded, out.samples.ray
    of_pair = ray[shaded.pairs.sample]
    if shaded.residual is not None:
        yield "residual", (shaded.residual, of_pair)
    yield "canonical points", (shaded.canonical, of_pair)
    yield "density", (shaded.sigma, ray)
    yield "colour", (shaded.color, ray)
    rays = torch.arange(len(out.color), device=out.color.device)
    yield "rendered colour", (out.color, rays)
    yield "opacity", (out.opacity, rays)


def _rows(values: Tensor, rays: Tensor) -> list[int]:
    """Rays of the rows that are not finite, as far as one of them."""
    wrong = ~(values.detach().reshape(len(values), -1).abs() <= HUGE).all(-1)
    return rays[wrong][:1].tolist()


def _where(
    trainer: "Trainer", batch: PixelBatch, rows: list[int]
) -> tuple[str | None, int | None, tuple[float, float] | None]:
    """Camera, frame and pixel of the first of some rays."""
    if not rows:
        return None, None, None
    record = trainer.avatar.record
    camera, frame = record.split("train").pairs()[int(batch.image[rows[0]])]
    x, y = batch.pixels[rows[0]].tolist()
    return record.camera_names[camera], frame, (x, y)
