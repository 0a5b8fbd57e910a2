"""A trained person: model, capture and pose memory; what rendering and evaluation need."""

from dataclasses import dataclass, replace

import torch

from monopart.geometry.body import BodyPose, PosedBody
from monopart.geometry.cameras import Camera
from monopart.geometry.posed_parts import PosedParts

from .cache import NO_CACHE, Cache
from .captures.records import CaptureRecord
from .config import Config
from .memory import PoseMemory
from .model import AvatarModel, FrameInput
from .prepared import distance_prior
from .scene import SceneBodies, canonical_body, stack_poses


@dataclass(frozen=True)
class Avatar:
    """Everything about one person.

    Attributes:
        record: the capture, for cameras, poses and images.
        config: the configuration.
        canonical: the body in the canonical pose.
        memory: poses of the training frames.
        model: the learned part.
        cache: where geometry and images that take long to prepare are kept.
    """

    record: CaptureRecord
    config: Config
    canonical: PosedBody
    memory: PoseMemory
    model: AvatarModel
    cache: Cache = NO_CACHE

    @classmethod
    def create(cls, record: CaptureRecord, config: Config, cache: Cache = NO_CACHE) -> "Avatar":
        """An untrained avatar on the device of a capture, from the global random state."""
        frames = record.split("train").frames
        canonical = canonical_body(record)
        poses = torch.stack([record.poses[f].pose for f in frames])
        prior = None
        if config.field.prior_slope:
            prior = distance_prior(canonical.verts, record.body.faces, cache)
        model = AvatarModel(config, record.body, canonical, len(frames), prior)
        model.to(canonical.verts.device)  # initial values are drawn on the CPU: the same anywhere
        return cls(record, config, canonical, PoseMemory.build(frames, poses), model, cache)

    @property
    def device(self) -> torch.device:
        """Where bodies and model are."""
        return self.canonical.verts.device

    def for_test(self) -> "Avatar":
        """The same person with the cameras and images at the size at which they are compared."""
        record = self.record.for_test()
        return self if record is self.record else replace(self, record=record)

    def scene(self, frames: tuple[int, ...]) -> SceneBodies:
        """Posed bodies of frames of the capture."""
        return SceneBodies.build(self.record, frames, self.config, self.canonical, self.cache)

    def canonical_parts(self) -> PosedParts:
        """Search structures of the canonical body."""
        body = self.record.body
        return PosedParts(body, self.canonical, self.canonical, self.model.parts)

    def training_input(self) -> FrameInput:
        """Times and codes of the training frames, in order; codes carry gradients."""
        rows = torch.arange(len(self.memory.frames), device=self.device)
        return FrameInput(self.memory.time(rows), self.model.codes)

    def frame_input(self, frame: int | None, pose: BodyPose) -> FrameInput:
        """Time and code of one pose: its own for a training frame, else blended from the nearest.

        Args:
            frame: frame number, or None for a pose that no frame has.
            pose: the pose, unbatched.
        """
        rows, weights = self.memory.weights(frame, pose.pose)
        code = None
        if self.model.codes is not None:
            code = (weights[:, None] * self.model.codes[rows]).sum(0, keepdim=True)
        return FrameInput(self.memory.time(rows[:1]), code)

    def pose_scene(self, pose: BodyPose) -> SceneBodies:
        """One freely posed body."""
        poses = stack_poses([pose])
        return SceneBodies.of_poses(self.record, poses, (-1,), self.config, self.canonical)


@dataclass(frozen=True)
class View:
    """One picture to render.

    Attributes:
        camera: the camera.
        pose: the body pose.
        frame: number of the frame the pose belongs to, or None.
    """

    camera: Camera
    pose: BodyPose
    frame: int | None = None


def view_of(record: CaptureRecord, camera: int, frame: int) -> View:
    """The view of a camera at a frame of the capture."""
    return View(record.cameras[camera], record.poses[frame], frame)
