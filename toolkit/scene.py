"""Per-frame geometry of a capture: bodies posed once, rays brought into their local frames."""

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from monopart.geometry.body import BodyPose, PosedBody
from monopart.geometry.cameras import Camera, Rays
from monopart.geometry.parts import PartMap
from monopart.geometry.posed_parts import PosedParts

from .cache import NO_CACHE, Cache
from .captures.records import CaptureRecord
from .config import Config
from .prepared import body_shell


def stack_poses(poses: list[BodyPose]) -> BodyPose:
    """One batched pose from several."""
    return BodyPose(
        *(torch.stack([getattr(p, f.name) for p in poses]) for f in dataclasses.fields(BodyPose))
    )


@dataclass(frozen=True)
class SceneBodies:
    """Posed bodies of some frames with their search structures.

    Attributes:
        posed: the bodies, batched.
        parts: search structures, in the same order.
        frames: frame numbers, in the same order.
    """

    posed: PosedBody
    parts: PosedParts
    frames: tuple[int, ...]

    @classmethod
    def build(
        cls,
        record: CaptureRecord,
        frames: tuple[int, ...],
        config: Config,
        canonical: PosedBody,
        cache: Cache = NO_CACHE,
    ) -> "SceneBodies":
        """Pose the bodies of frames of a capture; their shells come from the cache or go there."""
        poses = stack_poses([record.poses[f] for f in frames])
        return cls.of_poses(record, poses, frames, config, canonical, cache)

    @classmethod
    def of_poses(
        cls,
        record: CaptureRecord,
        poses: BodyPose,
        frames: tuple[int, ...],
        config: Config,
        canonical: PosedBody,
        cache: Cache = NO_CACHE,
    ) -> "SceneBodies":
        """Pose the body of a capture with given poses, batched."""
        body, spec = record.body, config.geometry
        with torch.no_grad():
            posed = body(poses)
            table = PartMap.preset(spec.parts, body.num_joints)
            shell = body_shell(body, posed, table, spec, cache)
            parts = PosedParts(body, posed, canonical, table, spec.radius, shell)
        return cls(posed, parts, frames)

    def local_rays(self, rays: Rays, body: Tensor | int) -> Rays:
        """World rays in the local frames of their bodies.

        Args:
            rays: [R] world rays.
            body: body of each ray, or one for all.
        """
        rotation, shift = self.posed.rotation[body], self.posed.translation[body]
        origins = rays.origins.expand_as(rays.directions)
        if isinstance(body, int):
            return Rays((origins - shift) @ rotation, rays.directions @ rotation)
        return Rays(
            torch.einsum("ni,nij->nj", origins - shift, rotation),
            torch.einsum("ni,nij->nj", rays.directions, rotation),
        )


def canonical_body(record: CaptureRecord) -> PosedBody:
    """The person of a capture in the canonical pose, with the shape of the first training frame."""
    first = record.split("train").frames[0]
    with torch.no_grad():
        return record.body.canonical(record.poses[first].betas)


def shell_pixels(camera: Camera, scene: SceneBodies, body: int) -> tuple[Tensor, Rays]:
    """Pixels of a camera whose rays enter the shell of a body, and those rays in its local frame.

    All other pixels are background exactly.

    Returns:
        Flat row-major pixel indices and their local rays.
    """
    width = camera.size[1]
    x0, y0, x1, y1 = _screen_box(camera, scene, body)
    ys, xs = torch.meshgrid(torch.arange(y0, y1), torch.arange(x0, x1), indexing="ij")
    pixels = torch.stack([xs, ys], -1).reshape(-1, 2).float() + 0.5
    rays = scene.local_rays(camera.rays(pixels), body)
    _, _, hit = scene.parts.shell.intervals(rays, body)
    index = (ys * width + xs).reshape(-1)[hit]
    return index, Rays(rays.origins.expand_as(rays.directions)[hit], rays.directions[hit])


def _screen_box(camera: Camera, scene: SceneBodies, body: int) -> tuple[int, int, int, int]:
    """Pixel box that holds every ray through the body's shell; the whole image when in doubt."""
    height, width = camera.size
    shell = scene.parts.shell
    lo = shell.lo[body]
    hi = lo + shell.dims[body] * shell.voxel
    corners = torch.stack(torch.meshgrid(*torch.stack([lo, hi], -1), indexing="ij"), -1)
    world = corners.reshape(-1, 3) @ scene.posed.rotation[body].T + scene.posed.translation[body]
    pixels, depth = camera.project(world)
    if bool((depth < 0.1).any()) or len(camera.distortion):
        return 0, 0, width, height
    low, high = pixels.amin(0).floor().long() - 1, pixels.amax(0).ceil().long() + 1
    x0, y0 = (int(v) for v in low.clamp(min=0))
    return x0, y0, max(x0, min(int(high[0]), width)), max(y0, min(int(high[1]), height))
