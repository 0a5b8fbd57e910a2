"""Posed bodies whose shell leaves out less than it could: what a kind of skipping saves, measured.

The hot path knows nothing of this: the bodies that it is given answer differently.
"""

import copy
import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor

from monopart.geometry.cameras import Rays
from monopart.geometry.culling import BodyShell, ShellSamples
from monopart.geometry.posed_parts import PosedParts

from .skipping import Skipping


class PartialShell(BodyShell):
    """A shell with samples outside its voxels, or with every part a candidate everywhere."""

    def __init__(self, shell: BodyShell, skip: Skipping) -> None:
        """Take over a shell.

        Args:
            shell: the shell that leaves out all that it can.
            skip: `voxels` and `parts` say what is still left out.
        """
        # Not BodyShell.__init__: the voxels are marked already.
        self.__dict__.update(vars(shell if skip.voxels else shell.filled()))
        self._whole, self._by_part = shell, skip.parts

    def sample(
        self,
        rays: Rays,
        step: float,
        body: Int[Tensor, "n"] | int = 0,
        jitter: Float[Tensor, "n"] | None = None,
    ) -> ShellSamples:
        """As `BodyShell.sample`, with the candidates that are asked for."""
        samples = super().sample(rays, step, body, jitter)
        if self._by_part:
            candidates = self._whole.bits(samples.points, samples.body)
        else:
            candidates = torch.full_like(samples.candidates, (1 << self.num_parts) - 1)
        return dataclasses.replace(samples, candidates=candidates)


def partly_skipping(bodies: PosedParts, skip: Skipping) -> PosedParts:
    """The bodies with `voxels` and `parts` as a choice of skipping says.

    Args:
        bodies: posed bodies.
        skip: the choice.

    Returns:
        The same object where nothing changes.
    """
    if skip.voxels and skip.parts:
        return bodies
    other = copy.copy(bodies)
    other.shell = PartialShell(bodies.shell, skip)
    return other
