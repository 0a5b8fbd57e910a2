"""What the networks are told of the training frames in one step: some left out, some noisy."""

import dataclasses

import torch
from torch import Tensor

from .avatar import Avatar
from .device import sent
from .model import FrameInput


class StepInputs:
    """Times, codes, light and key poses of the training frames, drawn anew for each step."""

    def __init__(self, avatar: Avatar) -> None:
        """Remember what is asked for.

        Args:
            avatar: the person; its configuration says what is left out how often.
        """
        self.avatar, self.frames = avatar, len(avatar.memory.frames)

    def __call__(self, generator: torch.Generator) -> FrameInput:
        """The inputs of one step.

        Args:
            generator: source of the choices.
        """
        spec, jitter = self.avatar.config.appearance, self.avatar.config.deform.time_jitter
        keyed = self.avatar.memory.parts is not None
        left_out = self._drawn(spec.leave_out, generator) if keyed else None
        inputs = self.avatar.training_input(left_out)
        unlit = self._drawn(spec.light_out, generator) if spec.light else None
        if unlit is not None:
            inputs = dataclasses.replace(inputs, lit=(~unlit).float())
        if not jitter:
            return inputs
        noise = torch.randn(self.frames, generator=generator)
        noise = sent(noise * jitter / max(self.frames - 1, 1), inputs.time.device)
        return dataclasses.replace(inputs, time=inputs.time + noise)

    def _drawn(self, share: float, generator: torch.Generator) -> Tensor | None:
        """A share of the training frames, drawn for one step; None where it is zero."""
        if not share:
            return None
        drawn = torch.rand(self.frames, generator=generator)
        return sent(drawn < share, self.avatar.device)
