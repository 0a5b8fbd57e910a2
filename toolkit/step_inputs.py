"""What the networks are told of the training frames in one step: some left out, some noisy."""

import dataclasses

import torch
from torch import Tensor

from .avatar import Avatar
from .device import sent
from .model import FrameInput


def step_inputs(avatar: Avatar, generator: torch.Generator) -> FrameInput:
    """Times, codes, light and key poses of the training frames, drawn anew for each step.

    Args:
        avatar: the person; its configuration says what is left out how often.
        generator: source of the choices.
    """
    spec, jitter = avatar.config.appearance, avatar.config.deform.time_jitter
    frames = len(avatar.memory.frames)

    def drawn(share: float) -> Tensor | None:
        """A share of the training frames; None where it is zero."""
        if not share:
            return None
        return sent(torch.rand(frames, generator=generator) < share, avatar.device)

    left_out = None if avatar.memory.parts is None else drawn(spec.leave_out)
    inputs = avatar.training_input(left_out)
    unlit = drawn(spec.light_out) if spec.light else None
    if unlit is not None:
        inputs = dataclasses.replace(inputs, lit=(~unlit).float())
    if not jitter:
        return inputs
    noise = torch.randn(frames, generator=generator) * jitter / max(frames - 1, 1)
    return dataclasses.replace(inputs, time=inputs.time + sent(noise, inputs.time.device))
