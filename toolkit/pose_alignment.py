"""Body poses aligned with pictures: Gauss-Newton steps for all frames and joints at once.

The picture that the avatar gives at the present poses is compared with the one that was taken.
Its slope times the motion of the surface says how it changes with each joint (Lucas and Kanade,
1981), so one picture of a frame weighs all its parameters against each other: those that it shows
well move, and those that it hardly shows, such as depth, stay with the prior of the tracker's
errors. A step of Adam moves both alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from kornia.filters import gaussian_blur2d, spatial_gradient
from torch import Tensor

from monopart.geometry.body import BodyModel, BodyPose, PosedBody
from monopart.geometry.cameras import Camera
from monopart.geometry.pose_motion import joint_motion
from monopart.geometry.skinning import blend_transforms, unskin
from monopart.geometry.surface import SurfaceIndex

from .avatar import View
from .corrections import ANGLE, LENGTH
from .refine import RefinedPoses
from .render import render_view
from .skipping import PRUNE

BLUR = 0.8  # standard deviation of the blur of both pictures, pixels of the aligned size
EDGE = 2  # pixels around the person in either picture that take part
SEEN = 0.05  # opacity from which on a pixel is of the person
SOLID = 0.6  # opacity from which on the depth of a pixel is taken
HUBER = 0.15  # difference of colours from which on a pixel counts less
FINE = 1e-6  # relative residual at which the linear system counts as solved


@dataclass(frozen=True)
class Shots:
    """Pictures that poses are aligned with.

    Attributes:
        images: [N, H, W, 3] sRGB, 0..255; what the mask leaves out is not looked at.
        masks: [N, H, W] True on the person.
        cameras: of each picture.
        rows: which of the refined frames each picture shows.
    """

    images: UInt8[Tensor, "n h w 3"]
    masks: Bool[Tensor, "n h w"]
    cameras: Sequence[Camera]
    rows: Sequence[int]


@dataclass(frozen=True)
class Slope:
    """One picture, linear in the corrections of its frame.

    Attributes:
        square: [D, D] sum over pixels of the products of the derivatives.
        pull: [D] sum of derivatives times differences.
        error: sum of the squared differences.
        values: number of pixels, times channels.
    """

    square: Float[Tensor, "d d"]
    pull: Float[Tensor, "d"]
    error: float
    values: int


@torch.no_grad()
def align_poses(refined: RefinedPoses, shots: Shots) -> dict[str, float]:
    """One step for the corrections of all frames; the avatar is held.

    Minimises, with pictures linear in the corrections, Σ_f e ‖r_f‖² / (n_f s²) + ‖z‖²: r are the
    differences of the n pixels and channels of a picture, s their root mean square over all, e how
    many independent ones a picture counts as (`refine.evidence`), z the corrections with their
    drift undone, in units.

    Args:
        refined: frames and their corrections, which are changed.
        shots: the pictures.

    Returns:
        "rms": root mean square of the differences of colour and opacity before the step;
        "radians": mean size of the turns that it added.
    """
    fix, spec = refined.corrections, refined.avatar.config.refine
    units = _units(fix.rotations)
    frames, size = len(refined.frames), units.numel()
    square = units.new_zeros(frames, size, size, dtype=torch.float64)
    pull = square.new_zeros(frames, size)
    error, count = 0.0, 0
    for index, row in enumerate(shots.rows):
        found = _slope(refined, shots, index)
        square[row] += found.square / max(found.values, 1)
        pull[row] += found.pull / max(found.values, 1)
        error, count = error + found.error, count + found.values
    mean = max(error / max(count, 1), 1e-12)
    free = units * _free(fix.free)
    square *= spec.evidence / mean * free[:, None] * free
    pull *= spec.evidence / mean * free
    now = torch.cat([fix.rotations.flatten(1), fix.translations], 1).double() / units
    mix = torch.eye(frames).to(square) if fix.mix is None else fix.mix.double()
    step = _solve(square, mix, mix @ pull - now) * free
    turned, shifted = step.split([size - 3, 3], 1)
    fix.rotations.add_(turned.view_as(fix.rotations).to(fix.rotations))
    fix.translations.add_(shifted.to(fix.translations))
    added = (mix @ turned).unflatten(1, (-1, 3)).norm(dim=-1).mean()
    return {"rms": mean**0.5, "radians": float(added)}


def _units(rotations: Tensor) -> Tensor:
    """[D] units of the turns and shifts of a frame."""
    turns = rotations.new_full((rotations[0].numel(),), ANGLE)
    return torch.cat([turns, rotations.new_full((3,), LENGTH)]).double()


def _free(joints: Float[Tensor, "j 1"]) -> Tensor:
    """[D] 1 for what may be corrected."""
    return torch.cat([joints.expand(-1, 3).flatten(), joints.new_ones(3)]).double()


def _solve(square: Tensor, mix: Tensor, right: Tensor) -> Tensor:
    """Conjugate gradients on (1 + S Q S) z = right, Q block diagonal by frames."""

    def product(z: Tensor) -> Tensor:
        return z + mix @ (square @ (mix @ z)[..., None])[..., 0]

    z, rest = torch.zeros_like(right), right.clone()
    way, power = rest.clone(), rest.square().sum()
    goal = FINE**2 * power
    for _ in range(4 * right.numel()):  # rounding: more than in exact arithmetic
        if power <= goal:
            break
        image = product(way)
        length = power / (way * image).sum()
        z, rest = z + length * way, rest - length * image
        power, before = rest.square().sum(), power
        way = rest + (power / before) * way
    return z


def _slope(refined: RefinedPoses, shots: Shots, index: int) -> Slope:
    """The picture of one shot and its derivatives at the present pose of its frame."""
    row, body = shots.rows[index], refined.avatar.record.body
    largest = refined.avatar.config.refine.align_size
    camera = _shrunk(shots.cameras[index].to(refined.given.pose), largest)
    batch = refined.poses(torch.tensor([row], device=refined.given.pose.device))
    pose = BodyPose(batch.pose[0], batch.betas[0], batch.rotation[0], batch.translation[0])
    view = View(camera=camera, pose=pose, frame=refined.frames[row])
    scene = refined.avatar.pose_scene(pose)
    picture = render_view(refined.avatar, view, prune=PRUNE, scene=scene)
    made = torch.cat([picture.color, picture.opacity[..., None]], -1).permute(2, 0, 1)
    both = torch.stack([made, _taken(shots, index, camera.size).to(made)])
    near = F.max_pool2d(both[:, 3].amax(0)[None], 2 * EDGE + 1, 1, EDGE)[0] > SEEN
    depth = _filled(picture.depth / picture.opacity.clamp(min=SEEN), picture.opacity > SOLID)
    place = (near & (depth > 0.0)).nonzero()
    ys, xs = place.unbind(1)
    window = 2 * round(3 * BLUR) + 1
    both = gaussian_blur2d(both, (window, window), (BLUR, BLUR))
    slope = spatial_gradient(both.mean(0, keepdim=True), "sobel")[0, :, :, ys, xs]  # C 2 P
    moved = _pixel_motion(body, scene.posed, camera, place, depth[ys, xs])
    change = -torch.einsum("cdp,pdk->pck", slope, moved)
    off = (both[1] - both[0])[:, ys, xs].T
    trust = (HUBER / off.norm(dim=1).clamp(min=HUBER)).sqrt()
    rows = (change * trust[:, None, None]).flatten(0, 1)
    weighed = (off * trust[:, None]).flatten()
    error = float(weighed.square().sum())
    return Slope((rows.T @ rows).double(), (rows.T @ weighed).double(), error, len(weighed))


def _shrunk(camera: Camera, largest: int) -> Camera:
    """The camera of a picture that is no larger than a side."""
    return camera.resized(min(1.0, largest / max(camera.size)))


def _taken(shots: Shots, index: int, size: tuple[int, int]) -> Float[Tensor, "4 h w"]:
    """Colours over black and mask of a picture that was taken, in another size."""
    mask = shots.masks[index, ..., None].float()
    taken = torch.cat([shots.images[index] / 255.0 * mask, mask], -1)
    return F.interpolate(taken.permute(2, 0, 1)[None], size, mode="area")[0]


def _filled(depth: Tensor, known: Tensor) -> Tensor:
    """Depths carried on into the pixels around those that are known; 0 farther away."""
    weight = known.to(depth)[None, None]
    value = depth[None, None] * weight
    for _ in range(2 * EDGE):
        near, count = (F.avg_pool2d(x, 3, 1, 1) for x in (value, weight))
        empty = (weight == 0) & (count > 0)
        value = torch.where(empty, near / count.clamp(min=1e-6), value)
        weight = torch.where(empty, 1.0, weight)
    return value[0, 0]


def _pixel_motion(
    body: BodyModel, posed: PosedBody, camera: Camera, place: Tensor, depth: Tensor
) -> Float[Tensor, "p 2 d"]:
    """Motion of the pixels of surface points by the corrections of one frame.

    Args:
        body: the body model.
        posed: [1] the body of that frame.
        camera: the camera.
        place: [P, 2] row and column of pixels.
        depth: [P] distance of the surface along their rays, metres.
    """
    rays = camera.rays(place.flip(1).to(depth) + 0.5)
    world = rays.origins + depth[:, None] * rays.directions
    turn, shift = posed.rotation[0], posed.translation[0]
    local = (world - shift) @ turn
    hits = SurfaceIndex(posed.verts[0], body.faces).query(local)
    weights = torch.einsum("pc,pcj->pj", hits.bary, body.weights[body.faces[hits.face]])
    maps = posed.transforms[0]
    rest, sure = unskin(local, blend_transforms(maps, weights))
    joint = joint_motion(rest, weights, maps, posed.joints[0], body.tree)
    joint = joint * sure[:, None, None, None]  # a folded joint says nothing
    eye = torch.eye(3).to(world).expand(len(world), 3, 3)
    root = torch.linalg.cross(eye, (world - shift)[:, None].expand(-1, 3, 3))
    steps = torch.cat([(joint @ turn.mT).flatten(1, 2), root, eye], 1)  # P D 3
    return camera.pixel_slopes(world) @ steps.mT
