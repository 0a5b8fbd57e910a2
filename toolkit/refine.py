"""Bodies whose poses are learned: of the frames of a step only, rebuilt from corrected poses."""

import dataclasses
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from monopart.geometry.body import BodyPose
from monopart.geometry.culling import BodyShell
from monopart.geometry.moving_parts import MovingParts
from monopart.geometry.posed_parts import PosedParts

from .avatar import Avatar
from .config import RefineConfig
from .corrections import PoseCorrections
from .memory import PoseMemory
from .model import FrameInput
from .scene import SceneBodies, stack_poses
from .sizes import part_radii


@dataclass(frozen=True)
class Posing:
    """The bodies that the rays of a step look at.

    Attributes:
        scene: the bodies.
        inputs: what the networks know about each.
        place: [F] which of the bodies belongs to each frame; 0 for one without a ray.
    """

    scene: SceneBodies
    inputs: FrameInput
    place: Int[Tensor, "f"]

    @classmethod
    def of_all(cls, scene: SceneBodies, inputs: FrameInput) -> "Posing":
        """Every frame's body in its place."""
        return cls(scene, inputs, torch.arange(len(scene.frames), device=scene.parts.device))


class RefinedPoses:
    """The frames of a capture with corrected poses.

    A frame's shell reaches `refine.margin` farther than the parts do and is built anew when a
    vertex has moved by more, so that it always holds every sample that belongs to a part.
    """

    def __init__(
        self, avatar: Avatar, frames: tuple[int, ...], corrections: PoseCorrections
    ) -> None:
        """Remember the given poses.

        Args:
            avatar: the person; its capture holds the given poses.
            frames: frames of the capture, ascending.
            corrections: one for each of the frames.
        """
        self.avatar, self.frames, self.corrections = avatar, frames, corrections
        self.given = stack_poses([avatar.record.poses[f] for f in frames])
        self.table = avatar.model.parts
        self.face_part = self.table.face_parts(avatar.record.body.weights, avatar.record.body.faces)
        self._shells: dict[int, tuple[Tensor, BodyShell]] = {}
        self._parts: dict[int, PosedParts] = {}

    def poses(self, rows: Int[Tensor, "n"]) -> BodyPose:
        """Corrected poses of some frames, with gradients.

        Args:
            rows: which of the frames.
        """
        given = self.given
        chosen = (given.pose, given.betas, given.rotation, given.translation)
        return self.corrections(BodyPose(*(value[rows] for value in chosen)), rows)

    def posing(self, rows: Int[Tensor, "n"], inputs: FrameInput) -> Posing:
        """The bodies of some frames.

        Args:
            rows: which of the frames, ascending.
            inputs: what the networks know about all frames.
        """
        body = self.avatar.record.body
        posed = body(self.poses(rows))
        numbers, verts = rows.tolist(), posed.verts.detach()
        shells = [self._shell(row, v) for row, v in zip(numbers, verts, strict=True)]
        shell = BodyShell.joined(shells)
        if len(rows) not in self._parts:
            made = PosedParts(
                body, posed, self.avatar.canonical, self.table, self._radii(verts), shell
            )
            self._parts[len(rows)] = made
        parts = MovingParts.like(self._parts[len(rows)], body, posed, shell)
        frames = tuple(self.frames[row] for row in numbers)
        place = torch.zeros(len(self.frames), dtype=torch.int64, device=rows.device)
        place[rows] = torch.arange(len(rows), device=rows.device)
        chosen = inputs.of(rows)
        return Posing(SceneBodies(posed, parts, frames), chosen, place)

    def _radii(self, like: Tensor) -> Tensor:
        radii = part_radii(self.avatar.config.geometry, self.table.num_parts)
        return torch.tensor(radii, device=like.device)

    def _shell(self, row: int, verts: Tensor) -> BodyShell:
        spec, margin = self.avatar.config.geometry, self.avatar.config.refine.margin
        kept = self._shells.get(row)
        if kept is not None and bool((verts - kept[0]).square().sum(-1).amax() <= margin**2):
            return kept[1]
        radius = self._radii(verts) + margin
        faces = self.avatar.record.body.faces.to(verts.device)
        owner = self.face_part.to(verts.device)
        shell = BodyShell(verts, faces, radius, owner, spec.voxel)
        self._shells[row] = verts, shell
        return shell

    def terms(
        self, opacity: Float[Tensor, "n"], mask: Bool[Tensor, "n"], spec: RefineConfig
    ) -> dict[str, Tensor]:
        """The weighted terms of the objective that refinement adds.

        Args:
            opacity: opacity of rays.
            mask: whether the person covers their pixels.
            spec: the weights; a term of weight 0 is not computed.
        """
        terms = {}
        if spec.prior:
            terms["pose_size"] = spec.prior * self.corrections.size()
        if spec.smooth:
            terms["pose_roughness"] = spec.smooth * self.corrections.roughness(self.frames)
        if spec.opacity:
            terms["opacity"] = spec.opacity * (opacity - mask.to(opacity)).square().mean()
        return terms

    @torch.no_grad()
    def corrected(self) -> dict[int, BodyPose]:
        """The corrected pose of each frame, without gradients."""
        poses = self.poses(torch.arange(len(self.frames), device=self.given.pose.device))
        names = [f.name for f in dataclasses.fields(BodyPose)]
        return {
            frame: BodyPose(*(getattr(poses, name)[row] for name in names))
            for row, frame in enumerate(self.frames)
        }


def with_poses(avatar: Avatar, poses: dict[int, BodyPose]) -> Avatar:
    """An avatar whose capture holds other poses in some frames; the given ones are kept in it.

    Args:
        avatar: the person.
        poses: poses by frame.

    Returns:
        An avatar with the same model; the poses that it remembers are the new ones.
    """
    given = avatar.given or avatar.record.poses
    record = replace(avatar.record, poses={**avatar.record.poses, **poses})
    frames = avatar.memory.frames
    table = avatar.model.parts if avatar.config.appearance.pose_feature else None
    stacked = torch.stack([record.poses[f].pose for f in frames])
    memory = PoseMemory.build(frames, stacked, table)
    return replace(avatar, record=record, memory=memory, given=given)


def with_corrections(avatar: Avatar) -> Avatar:
    """A trained avatar with the learned poses of its training frames; itself where none is.

    A learned shape is that of every frame.

    Args:
        avatar: the trained person, with the poses as given.
    """
    fix = avatar.model.corrections
    if fix is None or avatar.given is not None:
        return avatar
    poses = avatar.record.poses
    if fix.betas is not None:
        with torch.no_grad():
            poses = {f: replace(p, betas=fix.shape(p.betas)) for f, p in poses.items()}
    refined = RefinedPoses(avatar, avatar.memory.frames, fix).corrected()
    return with_poses(avatar, {**poses, **refined})


def as_given(avatar: Avatar) -> Avatar:
    """The same avatar at the poses of the capture as they were read."""
    if avatar.given is None:
        return avatar
    return with_poses(avatar, avatar.given)
