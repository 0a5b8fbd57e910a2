"""What an unseen pose borrows from the training frames: their times and appearance codes."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from monopart.geometry.rotations import axis_angle_to_rotmat, rotation_angle


@dataclass(frozen=True)
class PoseMemory:
    """Poses of the training frames, and only of those.

    Attributes:
        frames: frame numbers, in training order.
        rotmats: [F, J, 3, 3] joint rotations.
        width: median distance of a frame to its nearest other frame, radians.
    """

    frames: tuple[int, ...]
    rotmats: Float[Tensor, "f j 3 3"]
    width: float

    @classmethod
    def build(cls, frames: tuple[int, ...], poses: Float[Tensor, "f j 3"]) -> "PoseMemory":
        """Remember axis-angle poses."""
        rotmats = axis_angle_to_rotmat(poses)
        memory = cls(frames, rotmats, 1.0)
        if len(frames) < 2:
            return memory
        apart = torch.stack([memory.distances(p) for p in poses])
        apart.fill_diagonal_(torch.inf)
        return cls(frames, rotmats, max(float(apart.amin(1).median()), 1e-3))

    def distances(self, pose: Float[Tensor, "j 3"]) -> Float[Tensor, "f"]:
        """Root of the summed squared joint angles to each training pose, without the root joint."""
        query = axis_angle_to_rotmat(pose)[None].expand_as(self.rotmats)
        return rotation_angle(query[:, 1:], self.rotmats[:, 1:]).square().sum(-1).sqrt()

    def weights(
        self, frame: int | None, pose: Float[Tensor, "j 3"], count: int = 5
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
        distance = self.distances(pose)
        near, rows = distance.topk(min(count, len(distance)), largest=False)
        return rows, torch.softmax(-(near**2) / (2 * self.width**2), 0)

    def time(self, row: int | Tensor) -> Tensor:
        """Normalised time of training rows: 0 for the first, 1 for the last."""
        return torch.as_tensor(row, dtype=torch.float32) / max(len(self.frames) - 1, 1)
