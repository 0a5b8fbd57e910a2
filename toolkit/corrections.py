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
RATE = 25.0
"""Frames per second of a capture that has no rate."""


def frame_times(frames: Sequence[int], fps: float | None) -> Float[Tensor, "f"]:
    """When frames were taken, seconds.

    Args:
        frames: numbers of the frames.
        fps: frames per second; None where the capture has no rate: `RATE`.

    >>> frame_times((0, 6), 12.0).tolist()
    [0.0, 0.5]
    """
    return torch.tensor(frames, dtype=torch.float64) / (fps or RATE)


def error_covariance(
    times: Float[Tensor, "f"], drift: float, jitter: float
) -> Float[Tensor, "f f"]:
    """Covariance in time of a tracker's errors of variance 1: a slow drift and independent noise.

    The drift is white noise smoothed by a Gaussian, so k(t, t') = (1 - jitter) exp(-(t - t')² /
    (4 drift²)) + jitter [t = t'].

    Args:
        times: of the frames, seconds, each another.
        drift: standard deviation of the Gaussian, seconds; 0: all errors are independent.
        jitter: share of the independent noise in the variance, in [0, 1].

    Returns:
        The covariance, float64.

    Raises:
        InputError: a negative drift, or a share that is not in [0, 1].

    >>> error_covariance(torch.tensor([0.0, 1.0]), 0.5, 0.25).diagonal().tolist()
    [1.0, 1.0]
    """
    if not drift >= 0.0 or not 0.0 <= jitter <= 1.0:
        raise InputError(
            f"refine.drift, refine.jitter: expected seconds >= 0 and a share in [0, 1], found "
            f"{drift} and {jitter}; 0.5 and 0.25 are usual"
        )
    alone = torch.eye(len(times), dtype=torch.float64, device=times.device)
    if not drift:
        return alone
    gap = times.double()[:, None] - times.double()
    return (1.0 - jitter) * torch.exp(-gap.square() / (4.0 * drift**2)) + jitter * alone


class PoseCorrections(torch.nn.Module):
    """Small rotations, shifts and a shape offset that are put on top of given poses.

    The root joint gets none: its rotation is that of Rh. A frame's rotation is composed as
    R(Δ) R(θ), in the axes of the parent joint, and in those of the world for Rh, about Th.

    What is learned are independent values, and the corrections are mixtures of them in time:
    Δ = S z with S² the covariance of the tracker's errors. So the size of z is how unlikely the
    corrections are, and a step that sees some frames moves their neighbours too.

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
        self.register_buffer("mix", None, persistent=False)

    free: Tensor
    mix: Tensor | None

    def couple(self, times: Float[Tensor, "f"], drift: float, jitter: float) -> "PoseCorrections":
        """Let the corrections of neighbouring frames move together.

        Args:
            times: of the frames, seconds.
            drift: see :func:`error_covariance`; 0 leaves every frame to itself.
            jitter: likewise.

        Returns:
            These corrections.
        """
        covariance = error_covariance(times.cpu(), drift, jitter)
        self.mix = None
        if drift:
            power, axes = torch.linalg.eigh(covariance)
            root = (axes * power.clamp(min=0.0).sqrt()) @ axes.mT
            self.mix = root.to(self.translations)
        return self

    def _mixed(self, values: Tensor, rows: Tensor | None = None) -> Tensor:
        """[N, ...] the corrections of some or all frames."""
        if self.mix is None:
            return values if rows is None else values.index_select(0, rows)
        mix = self.mix if rows is None else self.mix.index_select(0, rows)
        return (mix @ values.flatten(1)).unflatten(1, values.shape[1:])

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
        turn = axis_angle_to_rotmat(self._mixed(self.rotations, rows) * self.free)
        given = torch.cat([poses.pose, poses.rotation[:, None]], 1)
        both = rotmat_to_axis_angle(turn @ axis_angle_to_rotmat(given))
        shift = self._mixed(self.translations, rows)
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
        """[F, D] what is learned, in units of expected errors."""
        angles = (self.rotations * self.free).flatten(1) / ANGLE
        return torch.cat([angles, self.translations / LENGTH], 1)

    def size(self) -> Float[Tensor, ""]:
        """Mean over frames of the summed squares of what is learned, in units of errors."""
        total = self._values().square().sum(1).mean()
        return total if self.betas is None else total + self.betas.square().sum()

    def roughness(self, frames: Sequence[int]) -> Float[Tensor, ""]:
        """Mean summed squared second difference in time, over frames with equal gaps.

        Args:
            frames: number of each frame, ascending.
        """
        values, number = (
            self._mixed(self._values()),
            torch.tensor(frames, device=self.translations.device),
        )
        gap = number.diff()
        even = torch.nonzero(gap[1:] == gap[:-1]).squeeze(-1)
        if not len(even):
            return values.sum() * 0.0
        second = values.diff(dim=0).diff(dim=0)
        return second.index_select(0, even).square().sum(1).mean()
