"""What an unseen pose borrows from the training frames: their times and appearance codes."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from monopart.geometry.norms import safe_norm
from monopart.geometry.parts import PartMap
from monopart.geometry.rotations import axis_angle_to_rotmat, rotation_angle

NEIGHBOURS = 5  # training poses that an unseen one is blended from


@dataclass(frozen=True)
class PartMemory:
    """Poses of the training frames seen by one part at a time: the key poses of its embedding.

    Attributes:
        frames: frame numbers, in training order.
        rotmats: [F, J, 3, 3] joint rotations.
        joints: joints of each part, without the root.
        widths: [K] median distance of a frame to its nearest other frame, radians.
        near: [F, K, n] nearest other frames of each frame, and of one alone itself.
        shares: [F, K, n] their weights.
    """

    frames: tuple[int, ...]
    rotmats: Float[Tensor, "f j 3 3"]
    joints: tuple[tuple[int, ...], ...]
    widths: Float[Tensor, "k"]
    near: Int[Tensor, "f k n"]
    shares: Float[Tensor, "f k n"]

    @classmethod
    def build(
        cls, frames: tuple[int, ...], poses: Float[Tensor, "f j 3"], parts: PartMap
    ) -> "PartMemory":
        """Remember axis-angle poses, and the neighbours of each.

        Args:
            frames: frame numbers of the training frames.
            poses: their poses.
            parts: joints of the parts.

        >>> memory = PartMemory.build((3, 7), torch.rand(2, 24, 3), PartMap.default())
        >>> memory.near[0].flatten().tolist()  # of the other frame, for each part
        [1, 1, 1, 1, 1]
        """
        rotmats = axis_angle_to_rotmat(poses)
        joints = tuple(
            tuple(j for j in parts.joints_of(k) if j > 0) for k in range(parts.num_parts)
        )
        apart = torch.stack([_part_distances(r, rotmats, joints) for r in rotmats])
        if len(frames) > 1:
            itself = torch.eye(len(frames), dtype=torch.bool, device=poses.device)
            apart = apart.masked_fill(itself[:, None], torch.inf)
            widths = apart.amin(2).median(0).values.clamp_min(_NARROWEST)
        else:
            widths = poses.new_ones(len(joints))
        count = min(NEIGHBOURS, max(len(frames) - 1, 1))
        near, shares = _nearest(apart, widths[:, None], count)
        return cls(frames, rotmats, joints, widths, near, shares)

    def distances(self, pose: Float[Tensor, "j 3"]) -> Float[Tensor, "k f"]:
        """Root of the summed squared angles of a part's joints to each training pose, radians."""
        return _part_distances(axis_angle_to_rotmat(pose), self.rotmats, self.joints)

    def of_pose(
        self, frame: int | None, pose: Float[Tensor, "j 3"]
    ) -> tuple[Int[Tensor, "1 k n"], Float[Tensor, "1 k n"]]:
        """Key poses of one body and their weights; a training frame is itself.

        Args:
            frame: frame number if the pose is a frame of the capture, else None.
            pose: axis-angle joints.
        """
        if frame in self.frames:
            rows = self.near.new_full((1, len(self.joints), 1), self.frames.index(frame))
            return rows, self.shares.new_ones(rows.shape)
        count = min(NEIGHBOURS, len(self.frames))
        rows, weights = _nearest(self.distances(pose), self.widths[:, None], count)
        return rows[None], weights[None]

    def training(
        self, left_out: Bool[Tensor, "f"] | None = None
    ) -> tuple[Int[Tensor, "f k n"], Float[Tensor, "f k n"]]:
        """Key poses of all training frames and their weights.

        Args:
            left_out: frames that are treated as an unseen pose: blended from the nearest others.
        """
        own = torch.arange(len(self.frames), device=self.near.device)[:, None, None]
        if left_out is None:
            rows = own.expand(-1, len(self.joints), 1)
            return rows, self.shares.new_ones(rows.shape)
        alone = torch.zeros_like(self.shares)
        alone[..., 0] = 1.0
        out = left_out[:, None, None]
        return torch.where(out, self.near, own), torch.where(out, self.shares, alone)


_NARROWEST = 1e-3  # radians: the width where training poses are equal


def _part_distances(rotmats: Tensor, others: Tensor, joints: tuple[tuple[int, ...], ...]) -> Tensor:
    """Distance of a pose [J, 3, 3] to others [F, J, 3, 3] by part, [K, F] radians."""
    angles = rotation_angle(rotmats.expand_as(others), others)
    return torch.stack([safe_norm(angles[:, list(part)]) for part in joints])


def _nearest(distance: Tensor, width: Tensor | float, count: int) -> tuple[Tensor, Tensor]:
    """Rows of the nearest of the last axis, the first of equals first, and their weights."""
    near, rows = distance.sort(stable=True, dim=-1)
    near, rows = near[..., :count], rows[..., :count]
    # relative to the nearest: the same weights, and none is lost to rounding far from all poses
    first = near[..., :1]
    return rows, torch.softmax((first - near) * (first + near) / (2 * width**2), -1)


@dataclass(frozen=True)
class PoseMemory:
    """Poses of the training frames, and only of those.

    Attributes:
        frames: frame numbers, in training order.
        rotmats: [F, J, 3, 3] joint rotations.
        width: median distance of a frame to its nearest other frame, radians.
        parts: the same poses by part, where something asks for that.
    """

    frames: tuple[int, ...]
    rotmats: Float[Tensor, "f j 3 3"]
    width: float
    parts: PartMemory | None = None

    @classmethod
    def build(
        cls, frames: tuple[int, ...], poses: Float[Tensor, "f j 3"], parts: PartMap | None = None
    ) -> "PoseMemory":
        """Remember axis-angle poses, with parts also by part."""
        rotmats = axis_angle_to_rotmat(poses)
        by_part = None if parts is None else PartMemory.build(frames, poses, parts)
        memory = cls(frames, rotmats, 1.0, by_part)
        if len(frames) < 2:
            return memory
        apart = torch.stack([memory.distances(p) for p in poses])
        apart.fill_diagonal_(torch.inf)
        return cls(frames, rotmats, max(float(apart.amin(1).median()), _NARROWEST), by_part)

    def distances(self, pose: Float[Tensor, "j 3"]) -> Float[Tensor, "f"]:
        """Root of the summed squared joint angles to each training pose, without the root joint."""
        query = axis_angle_to_rotmat(pose)[None].expand_as(self.rotmats)
        return safe_norm(rotation_angle(query[:, 1:], self.rotmats[:, 1:]))

    def weights(
        self, frame: int | None, pose: Float[Tensor, "j 3"], count: int = NEIGHBOURS
    ) -> tuple[Int[Tensor, "k"], Float[Tensor, "k"]]:
        """Training frames to blend for a pose, and their weights; a training frame is itself.

        Args:
            frame: frame number if the pose is a frame of the capture, else None.
            pose: axis-angle joints.
            count: frames to blend.

        Returns:
            Rows of the memory, nearest first, and weights that sum to 1.
        """
        if frame in self.frames:
            row = torch.tensor([self.frames.index(frame)], device=pose.device)
            return row, torch.ones(1, device=pose.device)
        return _nearest(self.distances(pose), self.width, count)

    def time(self, row: int | Tensor) -> Tensor:
        """Normalised time of training rows: 0 for the first, 1 for the last."""
        return torch.as_tensor(row, dtype=torch.float32) / max(len(self.frames) - 1, 1)
