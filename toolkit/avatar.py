"""A trained person: model, capture and pose memory; what rendering and evaluation need."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from monopart.geometry.body import BodyPose, PosedBody
from monopart.geometry.cameras import Camera
from monopart.geometry.posed_parts import PosedParts

from .appearance import FrameInput
from .cache import NO_CACHE, Cache
from .capacity import allocated
from .captures.records import CaptureRecord
from .config import Config
from .corrections import frame_times
from .light import Light
from .memory import PoseMemory
from .model import AvatarModel
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
        given: the poses of the capture as they were read, where `record` holds refined ones.
    """

    record: CaptureRecord
    config: Config
    canonical: PosedBody
    memory: PoseMemory
    model: AvatarModel
    cache: Cache = NO_CACHE
    given: dict[int, BodyPose] | None = None

    @classmethod
    def create(cls, record: CaptureRecord, config: Config, cache: Cache = NO_CACHE) -> "Avatar":
        """An untrained avatar on the device of a capture, from the global random state."""
        config, _ = allocated(config, record, cache=cache)
        frames = record.split("train").frames
        canonical = canonical_body(record)
        poses = torch.stack([record.poses[f].pose for f in frames])
        prior = None
        if config.field.prior_slope:
            prior = distance_prior(canonical.verts, record.body.faces, cache)
        light = Light.of(record) if config.appearance.light else None
        model = AvatarModel(config, record.body, canonical, len(frames), prior, light)
        model.to(canonical.verts.device)  # initial values are drawn on the CPU: the same anywhere
        if model.corrections is not None:
            times, spec = frame_times(frames, record.fps), config.refine
            model.corrections.couple(times, spec.drift, spec.jitter)
        table = model.parts if config.appearance.pose_feature else None
        memory = PoseMemory.build(frames, poses, table)
        return cls(record, config, canonical, memory, model, cache)

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

    def training_input(self, left_out: Tensor | None = None) -> FrameInput:
        """Times, codes and key poses of the training frames, in order; codes carry gradients.

        Args:
            left_out: [F] frames whose key poses are those of an unseen pose: the nearest others.
        """
        time = self.memory.time(torch.arange(len(self.memory.frames), device=self.device))
        if self.memory.parts is None:
            return FrameInput(time, self.model.codes)
        return FrameInput(time, self.model.codes, *self.memory.parts.training(left_out))

    def frame_input(self, frame: int | None, pose: BodyPose) -> FrameInput:
        """What is known of one pose: its own for a training frame, else blended from the nearest.

        Times and codes of frames are weighted by the whole pose, key poses by that of each part.

        Args:
            frame: frame number, or None for a pose that no frame has.
            pose: the pose, unbatched.
        """
        rows, weights = self.memory.weights(frame, pose.pose)
        code = None
        if self.model.codes is not None:
            code = (weights[:, None] * self.model.codes[rows]).sum(0, keepdim=True)
        time = self.memory.time(rows[:1])
        if self.config.appearance.blend_time:
            time = (weights * self.memory.time(rows)).sum(0, keepdim=True)
        if self.memory.parts is None:
            return FrameInput(time, code)
        return FrameInput(time, code, *self.memory.parts.of_pose(frame, pose.pose))

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
