"""Corrections of estimated body poses: one per training frame, learned with the avatar."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from monopart.geometry.body import BodyPose
from monopart.geometry.errors import InputError
from monopart.geometry.rotations import axis_angle_to_rotmat, rotmat_to_axis_angle

ANGLE, LENGTH = 0.03, 0.01
"""Errors of a good body tracker, radians and metres: the units of the regularisers."""


class PoseCorrections(torch.nn.Module):
    """Small rotations, shifts and a shape offset that are put on top of given poses.

    The root joint gets none: its rotation is that of Rh. A frame's rotation is composed as
    R(Δ) R(θ), in the axes of the parent joint, and in those of the world for Rh, about Th.

    >>> fix = PoseCorrections(2, 24)
    >>> fix.rotations.shape
    torch.Size([2, 25, 3])
    """

    def __init__(self, frames: int, joints: int, betas: int = 0) -> None:
        """Corrections of zero.

        Args:
            frames: number of frames.
            joints: joints of the body, the root included.
            betas: shape coefficients that are corrected, the same in all frames; 0 for none.
        """
        super().__init__()
        self.rotations = torch.nn.Parameter(torch.zeros(frames, joints + 1, 3))
        self.translations = torch.nn.Parameter(torch.zeros(frames, 3))
        self.betas = torch.nn.Parameter(torch.zeros(betas)) if betas else None
        free = torch.ones(joints + 1, 1)
        free[0] = 0.0
        self.register_buffer("free", free, persistent=False)

    free: Tensor

    def forward(self, poses: BodyPose, rows: Int[Tensor, "n"]) -> BodyPose:
        """Corrected poses.

        Args:
            poses: [N] given poses.
            rows: [N] the frame of each.

        Returns:
            [N] poses; differentiable in the corrections.

        Raises:
            InputError: the poses have another number of joints.
        """
        joints = self.rotations.shape[1] - 1
        if poses.pose.shape[-2] != joints:
            raise InputError(
                f"poses: expected {joints} joints (the corrections'), found "
                f"{poses.pose.shape[-2]}; correct the poses of the same body"
            )
        turn = axis_angle_to_rotmat(self.rotations.index_select(0, rows) * self.free)
        given = torch.cat([poses.pose, poses.rotation[:, None]], 1)
        both = rotmat_to_axis_angle(turn @ axis_angle_to_rotmat(given))
        shift = self.translations.index_select(0, rows)
        return BodyPose(
            both[:, :-1], self.shape(poses.betas), both[:, -1], poses.translation + shift
        )

    def shape(self, betas: Float[Tensor, "*b n"]) -> Float[Tensor, "*b m"]:
        """Corrected shape coefficients.

        Args:
            betas: given ones; those that are missing count as zero.

        Returns:
            At least as many; differentiable.
        """
        if self.betas is None:
            return betas
        missing = max(len(self.betas) - betas.shape[-1], 0)
        return torch.nn.functional.pad(betas, (0, missing)) + self.betas

    def _values(self) -> Tensor:
        """[F, D] all corrections in units of their expected errors."""
        angles = (self.rotations * self.free).flatten(1) / ANGLE
        return torch.cat([angles, self.translations / LENGTH], 1)

    def size(self) -> Float[Tensor, ""]:
        """Mean over frames of the summed squares of the corrections, in units of errors."""
        total = self._values().square().sum(1).mean()
        return total if self.betas is None else total + self.betas.square().sum()

    def roughness(self, frames: Sequence[int]) -> Float[Tensor, ""]:
        """Mean summed squared second difference in time, over frames with equal gaps.

        Args:
            frames: number of each frame, ascending.
        """
        values, number = self._values(), torch.tensor(frames, device=self.translations.device)
        gap = number.diff()
        even = torch.nonzero(gap[1:] == gap[:-1]).squeeze(-1)
        if not len(even):
            return values.sum() * 0.0
        second = values.diff(dim=0).diff(dim=0)
        return second.index_select(0, even).square().sum(1).mean()
