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
from .skipping import EVERY, Skipping


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
            parts = PosedParts(body, posed, canonical, table, shell.radius, shell)
        return cls(posed, parts, frames)

    def local_rays(self, rays: Rays, body: Tensor | int) -> Rays:
        """World rays in the local frames of their bodies.

        Args:
            rays: [R] world rays.
            body: body of each ray, or one for all.
        """
        posed = self.posed
        rotation, shift = posed.rotation.detach()[body], posed.translation.detach()[body]
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


def shell_pixels(
    camera: Camera, scene: SceneBodies, body: int, skip: Skipping = EVERY
) -> tuple[Tensor, Rays, int]:
    """Pixels of a camera whose rays enter the shell of a body, and those rays in its local frame.

    All other pixels are background exactly.

    Args:
        camera: the camera.
        scene: posed bodies.
        body: which of them.
        skip: `box` off looks at every pixel of the image, `shell` off keeps rays that miss.

    Returns:
        Flat row-major pixel indices, their local rays, and the number of pixels looked at.
    """
    height, width = camera.size
    x0, y0, x1, y1 = _screen_box(camera, scene, body) if skip.box else (0, 0, width, height)
    device = scene.parts.device
    sides = torch.arange(y0, y1, device=device), torch.arange(x0, x1, device=device)
    ys, xs = torch.meshgrid(*sides, indexing="ij")
    pixels = torch.stack([xs, ys], -1).reshape(-1, 2).float() + 0.5
    rays = scene.local_rays(camera.rays(pixels), body)
    index, origins = (ys * width + xs).reshape(-1), rays.origins.expand_as(rays.directions)
    if not skip.shell:
        return index, Rays(origins, rays.directions), len(pixels)
    _, _, hit = scene.parts.shell.intervals(rays, body)
    return index[hit], Rays(origins[hit], rays.directions[hit]), len(pixels)


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
    left, top, right, bottom = torch.cat([low, high]).tolist()
    x0, y0 = max(left, 0), max(top, 0)
    return x0, y0, max(x0, min(right, width)), max(y0, min(bottom, height))
