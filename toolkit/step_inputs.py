"""What the networks are told of the training frames in one step: some left out, some noisy."""

import dataclasses

import torch
from torch import Tensor

from .avatar import Avatar
from .device import sent
from .model import FrameInput


class StepInputs:
    """Times, codes, light and key poses of the training frames, drawn anew for each step."""

    def __init__(self, avatar: Avatar, generator: torch.Generator) -> None:
        """Remember what is asked for.

        Args:
            avatar: the person; its configuration says what is left out how often.
            generator: source of the choices.
        """
        self.avatar, self.generator = avatar, generator
        self.frames = len(avatar.memory.frames)

    def __call__(self) -> FrameInput:
        """The inputs of one step."""
        spec, jitter = self.avatar.config.appearance, self.avatar.config.deform.time_jitter
        left_out = None if self.avatar.memory.parts is None else self._drawn(spec.leave_out)
        inputs = self.avatar.training_input(left_out)
        unlit = self._drawn(spec.light_out) if spec.light else None
        if unlit is not None:
            inputs = dataclasses.replace(inputs, lit=(~unlit).float())
        if not jitter:
            return inputs
        noise = torch.randn(self.frames, generator=self.generator)
        noise = sent(noise * jitter / max(self.frames - 1, 1), inputs.time.device)
        return dataclasses.replace(inputs, time=inputs.time + noise)

    def _drawn(self, share: float) -> Tensor | None:
        """A share of the training frames, drawn for one step; None where it is zero."""
        if not share:
            return None
        drawn = torch.rand(self.frames, generator=self.generator)
        return sent(drawn < share, self.avatar.device)
