"""Pictures of an avatar, in chunks of rays; what a picture does not need is skipped."""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from monopart.fields.mlp import PartMLP
from monopart.geometry.cameras import Rays
from monopart.geometry.errors import InputError

from .avatar import Avatar, View
from .march import march
from .scene import SceneBodies, shell_pixels
from .skipping import EVERY, NONE, Skipping
from .unskipped import partly_skipping

CHUNK = 16384  # rays at a time: bounds the memory
STATS = (
    "rays_box",
    "rays",
    "samples_dense",
    "samples_shell",
    "samples_evaluated",
    "samples_reached",
    "pairs_found",
    "pairs_evaluated",
    "colors_evaluated",
)


@dataclass(frozen=True)
class Picture:
    """A rendered image.

    Attributes:
        color: [H, W, 3] sRGB in [0, 1] over the background.
        opacity: [H, W].
        depth: [H, W] expected distance along the ray, metres; 0 where nothing is.
        stats: counts: "pixels" of the image and those named in `STATS`.
    """

    color: Float[Tensor, "h w 3"]
    opacity: Float[Tensor, "h w"]
    depth: Float[Tensor, "h w"]
    stats: dict[str, int] = field(default_factory=dict)


@torch.no_grad()
def render_view(
    avatar: Avatar,
    view: View,
    background: float = 0.0,
    prune: float = 0.0,
    skip: Skipping | bool = True,
    scene: SceneBodies | None = None,
    coarse: int = 1,
    half: bool = False,
) -> Picture:
    """Render one view.

    Args:
        avatar: the person.
        view: camera and pose.
        background: grey level behind the person, in [0, 1].
        prune: skip learned empty cells that absorb less than this per sample (approximate); 0 is
            exact.
        skip: what to leave out; True is all of it (`cells` only where `prune` asks for it), False
            nothing: the dense renderer, which searches every part at every sample in the box of
            the body, for comparison.
        scene: the posed body if it exists already.
        coarse: see :func:`march` (approximate); 1 is exact.
        half: run the networks in float16 (approximate).

    Raises:
        InputError: coarse below 1, or above it together with ``skip=False``.
    """
    if coarse < 1 or (coarse > 1 and not skip):
        raise InputError(f"coarse: expected 1, or more together with skip, found {coarse}")
    with half_networks(avatar.model, half):
        return _render_view(avatar, view, background, prune, skip, scene, coarse)


@contextmanager
def half_networks(model: torch.nn.Module, on: bool = True) -> Iterator[None]:
    """Networks that compute in float16 inside the block; parameters stay as they are.

    Args:
        model: a module with :class:`PartMLP` inside.
        on: off changes nothing.
    """
    networks = [m for m in model.modules() if isinstance(m, PartMLP)] if on else []
    before = [network.compute for network in networks]
    for network in networks:
        network.compute = torch.float16
    try:
        yield
    finally:
        for network, kind in zip(networks, before, strict=True):
            network.compute = kind


def _render_view(
    avatar: Avatar,
    view: View,
    background: float,
    prune: float,
    skip: Skipping | bool,
    scene: SceneBodies | None,
    coarse: int,
) -> Picture:
    model = avatar.model.eval()
    scene = scene or avatar.pose_scene(view.pose)
    inputs = avatar.frame_input(view.frame, view.pose)
    height, width = view.camera.size
    if isinstance(skip, bool):
        skip = EVERY if skip else NONE
    prune = prune if skip.cells else 0.0
    index, rays, looked_at = shell_pixels(view.camera, scene, 0, skip)
    bodies = partly_skipping(scene.parts, skip)
    color = rays.directions.new_zeros(height * width, 3)
    opacity, depth = rays.directions.new_zeros(2, height * width).unbind(0)
    # Every count is there, also where no ray hits the shell.
    stats: Counter[str] = Counter({"pixels": height * width, **dict.fromkeys(STATS, 0)})
    stats["rays_box"] = looked_at
    for start in range(0, len(index), CHUNK):
        part = slice(start, start + CHUNK)
        chunk = Rays(rays.origins[part], rays.directions[part])
        if skip.light:
            out = march(model, bodies, inputs, chunk, prune, skip, coarse)
        else:
            out = model.render_rays(bodies, inputs, chunk, 0, None, prune, skip)
        color[index[part]] = out.color
        opacity[index[part]] = out.opacity
        depth[index[part]] = out.depth
        stats.update(out.stats)
    color = color + background * (1.0 - opacity)[:, None]
    image = color.clamp(0.0, 1.0).reshape(height, width, 3)
    shape = (height, width)
    return Picture(image, opacity.reshape(shape), depth.reshape(shape), dict(stats))


def render_views(
    avatar: Avatar,
    views: list[View],
    progress: Callable[[int, int], None] | None = None,
    prune: float = 0.0,
) -> list[Picture]:
    """Render several views in order.

    Args:
        avatar: the person.
        views: what to render.
        progress: called with (done, total).
        prune: see :func:`render_view`.
    """
    pictures: list[Picture] = []
    scene, pose = None, None
    for done, view in enumerate(views, start=1):
        if scene is None or view.pose is not pose:  # a turntable keeps one pose
            scene, pose = avatar.pose_scene(view.pose), view.pose
        pictures.append(render_view(avatar, view, prune=prune, scene=scene))
        if progress is not None:
            progress(done, len(views))
    return pictures
