"""What the networks of a sample see of its frame: pose feature and appearance (eqs. 5, 6).

Which pieces exist is decided by the configuration, and by it alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from monopart.fields.fusion import CodeFusion
from monopart.fields.pose_bank import PoseBank
from monopart.geometry.errors import InputError
from monopart.geometry.stages import stage

from .config import AppearanceConfig


@dataclass(frozen=True)
class FrameInput:
    """What the networks know about each body of a batch.

    Attributes:
        time: [B] normalised time in [0, 1].
        code: [B, C] appearance codes, or None.
        rows: [B, K, n] key poses of each body and part, or None where nothing asks for them.
        weights: [B, K, n] their weights, which sum to 1.
        lit: [B] 0 for a body whose colours see no light, else 1; None: all see it.
    """

    time: Tensor
    code: Tensor | None
    rows: Tensor | None = None
    weights: Tensor | None = None
    lit: Tensor | None = None

    def of(self, bodies: Tensor) -> "FrameInput":
        """What is known about some of the bodies.

        Args:
            bodies: [B'] rows.
        """
        code = None if self.code is None else self.code.index_select(0, bodies)
        others = (x if x is None else x[bodies] for x in (self.rows, self.weights, self.lit))
        return FrameInput(self.time[bodies], code, *others)


class Appearance(torch.nn.Module):
    """Features of samples that depend on the frame.

    With pose feature, codes and fusion: the fused feature F_k. Without one of these, what there is
    goes to the networks directly: the pose feature P_k, the code of the frame, both or nothing.
    """

    def __init__(self, config: AppearanceConfig, lo: Tensor, hi: Tensor, frames: int) -> None:
        """Make the pieces that a configuration asks for.

        Args:
            config: the configuration.
            lo: [K, 3] lower corners of the parts' canonical boxes, metres.
            hi: [K, 3] upper corners.
            frames: number of training frames: the key poses.
        """
        super().__init__()
        self.bank = self.fusion = None
        if config.pose_feature:
            self.bank = PoseBank(lo, hi, frames, config.knots, config.channels)
        if fuses(config) and self.bank is not None:
            self.fusion = CodeFusion(
                len(lo),
                self.bank.out_features,
                config.codes,
                config.code,
                outputs=config.fused,
            )

    def forward(
        self,
        frames: FrameInput,
        points: Tensor,
        part: Tensor,
        owner: Tensor,
        counts: Sequence[int],
    ) -> Tensor | None:
        """Features of canonical points sorted by part; None where the configuration has none.

        Args:
            frames: what is known about each body.
            points: [N, 3] canonical points, metres.
            part: [N] part of each.
            owner: [N] body of each.
            counts: points of each part.

        Raises:
            InputError: a pose feature is asked for and the frames have no key poses.
        """
        features = []
        if self.bank is not None:
            if frames.rows is None or frames.weights is None:
                raise InputError(
                    "frames: expected rows and weights of key poses for the pose feature, found "
                    "none; take them from Avatar.training_input or Avatar.frame_input"
                )
            with stage("pose feature"):
                pose = self.bank(points, part, owner, frames.rows, frames.weights)
            if self.fusion is not None:
                with stage("fusion"):
                    return self.fusion(pose, counts)
            features.append(pose)
        if frames.code is not None:
            # index_select: the gradient of [] adds up in an order that changes with two threads
            features.append(frames.code.index_select(0, owner))
        return torch.cat(features, -1) if len(features) > 1 else next(iter(features), None)


def fuses(config: AppearanceConfig) -> bool:
    """Whether pose features and codes go through the attention."""
    return config.fusion and config.pose_feature and config.code > 0


def feature_width(config: AppearanceConfig) -> int:
    """Length of the feature of a sample.

    >>> feature_width(AppearanceConfig()), feature_width(AppearanceConfig(pose_feature=True))
    (8, 16)
    >>> feature_width(AppearanceConfig(pose_feature=True, fusion=False))
    32
    """
    if fuses(config):
        return config.fused
    return config.code + (3 * config.channels if config.pose_feature else 0)
