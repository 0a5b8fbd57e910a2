"""Stress of kinematics, skinning, bodies and their inverse; the oracles are float64 loops."""

import dataclasses

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.kinematics import KinematicTree, forward_kinematics
from monopart.geometry.pose_motion import joint_motion
from monopart.geometry.rotations import axis_angle_to_rotmat
from monopart.geometry.skinning import SkinWeights, blend_skin, blend_transforms, skin, unskin

from .registry import load
from .stability_cases import DOUBLE, SINGLE, Backend, Family, Inputs, Stress, Way, kinds_of
from .stability_rotations import Make, axes

FAR = 1e5
"""Metres from the origin of the families that are far away."""


# --- forward kinematics ------------------------------------------------------------------------


def _skeleton(
    parents: tuple[int, ...], bone: float, angle: float, away: float = 0.0, bodies: int = 4
) -> Make:
    """Random rotations up to an angle, bones of a length, at a distance from the origin."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        joints = torch.zeros(bodies, len(parents), 3, dtype=DOUBLE)
        for j, parent in enumerate(parents[1:], start=1):
            joints[:, j] = joints[:, parent] + bone * axes(generator, bodies + 3)[3:]
        joints = joints + away
        turn = axes(generator, bodies * len(parents) + 3)[3:] * angle
        share = torch.rand(len(turn), 1, generator=generator, dtype=DOUBLE)
        rotmats = axis_angle_to_rotmat(turn * share).reshape(bodies, len(parents), 3, 3)
        return rotmats, joints

    return make


def _chain(count: int) -> tuple[int, ...]:
    return tuple(range(-1, count - 1))


def _bush(count: int) -> tuple[int, ...]:
    return (-1, *((j - 1) // 3 for j in range(1, count)))


def exact_chain(tree: KinematicTree, rotmats: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Bodies times joints rows: rotation and where the joint itself goes, by a loop over joints."""
    out = np.zeros((*joints.shape[:2], 3, 4))
    for j, parent in enumerate(tree.parents):
        out[:, j, :, :3] = rotmats[:, j] if parent < 0 else out[:, parent, :, :3] @ rotmats[:, j]
        if parent < 0:
            out[:, j, :, 3] = joints[:, j]
        else:
            bone = (joints[:, j] - joints[:, parent])[..., None]
            out[:, j, :, 3] = out[:, parent, :, 3] + (out[:, parent, :, :3] @ bone)[..., 0]
    return out.reshape(-1, 3, 4)


def _joint_rows(transforms: Tensor, joints: Tensor) -> Tensor:
    """Rotation and posed joint of rest-to-posed transforms: what users see of them."""
    linear = transforms[..., :3, :3]
    posed = (linear * joints[..., None, :]).sum(-1) + transforms[..., :3, 3]
    return torch.cat((linear, posed[..., None]), -1).reshape(-1, 3, 4)


def _kinematics_way(backend: Backend) -> Way:
    def run(tree: KinematicTree, rotmats: Tensor, joints: Tensor) -> Tensor:
        return _joint_rows(forward_kinematics(tree, rotmats, joints, backend), joints)

    kinds = kinds_of(backend)
    return Way(f"monopart {backend}", run, True, kinds)


def _smplx_chain(tree: KinematicTree, rotmats: Tensor, joints: Tensor) -> Tensor:
    parents = torch.tensor(tree.parents)
    transform = load("smplx.lbs").batch_rigid_transform
    posed, relative = transform(rotmats, joints, parents, rotmats.dtype)
    return torch.cat((relative[..., :3, :3], posed[..., None]), -1).reshape(-1, 3, 4)


def _chain_scale(
    tree: KinematicTree, exact: np.ndarray, rotmats: np.ndarray, joints: np.ndarray
) -> np.ndarray:
    """Per row the largest coordinate of the skeleton, at least 1: rotations are off by numbers."""
    return np.full(len(exact), max(1.0, np.abs(joints).max(), np.abs(exact[..., 3]).max()))


def _kinematics() -> Stress:
    shapes = (
        ("one joint", (-1,), 0.2, np.pi, 0.0),
        ("24 joints", _bush(24), 0.2, np.pi, 0.0),
        ("200 joints", _bush(200), 0.2, np.pi, 0.0),
        ("chain of 50", _chain(50), 0.1, np.pi, 0.0),
        ("chain of 200", _chain(200), 0.1, np.pi, 0.0),
        ("at rest", _bush(24), 0.2, 0.0, 0.0),
        ("bones 1e-3 m", _bush(24), 1e-3, np.pi, 0.0),
        ("bones 1e3 m", _bush(24), 1e3, np.pi, 0.0),
        ("100 km away", _bush(24), 0.2, np.pi, FAR),
    )
    families = tuple(
        Family(
            name,
            _skeleton(parents, bone, angle, away),
            extra=KinematicTree(parents),
            step=1e-7,
        )
        for name, parents, bone, angle, away in shapes
    )
    return Stress(
        name="forward_kinematics",
        title="forward kinematics",
        domain="rotation matrices up to rounding, 200 joints in a row, any metres; gradients in "
        "the rotations lose digits as (distance from the origin) / (length of the bones)",
        error="largest coordinate of the skeleton, at least 1 (entries of rotations)",
        families=families,
        ways=(
            _kinematics_way("torch"),
            _kinematics_way("warp"),
            Way("smplx", _smplx_chain, modules=("smplx",)),
        ),
        exact=exact_chain,
        scale=_chain_scale,
        wrt=(0, 1),
    )


# --- linear blend skinning ---------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Weighted:
    """Weights as the float32 and the float64 of the same numbers."""

    single: SkinWeights
    double: SkinWeights

    @classmethod
    def of(cls, dense: Tensor) -> "_Weighted":
        rounded = dense.float()
        return cls(SkinWeights(rounded), SkinWeights(rounded.double()))

    def like(self, ref: Tensor) -> SkinWeights:
        return self.single if ref.dtype == SINGLE else self.double


def _weights(count: int, joints: int, kind: str = "four") -> _Weighted:
    generator = torch.Generator().manual_seed(5)
    dense = torch.rand(count, joints, generator=generator, dtype=DOUBLE)
    if kind == "four":  # the four largest, as bodies have
        dense = dense * (dense >= dense.topk(min(4, joints)).values[:, -1:])
    dense = dense / dense.sum(1, keepdim=True)
    if kind == "zero":
        dense = dense * 0
    if kind == "half":
        dense = dense * 0.5
    return _Weighted.of(dense)


def _skin_inputs(size: float, away: float, joints: int, angle: float = np.pi) -> Make:
    """Points and transforms that turn them about joints next to them."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        points = size * torch.randn(count, 3, generator=generator, dtype=DOUBLE) + away
        centre = size * torch.randn(joints, 3, generator=generator, dtype=DOUBLE) + away
        turn = axes(generator, joints + 3)[3:] * angle
        linear = axis_angle_to_rotmat(turn)
        shift = centre - (linear @ centre[..., None])[..., 0]
        return points, _affine(linear, shift)

    return make


def _affine(linear: Tensor, shift: Tensor) -> Tensor:
    maps = torch.eye(4, dtype=linear.dtype).repeat(len(linear), 1, 1)
    maps[:, :3, :3], maps[:, :3, 3] = linear, shift
    return maps


def _two_bones(degrees: float, fold: bool) -> Make:
    """A limb along y: its lower half turns about y (twist) or about x (fold)."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        points = torch.rand(count, 3, generator=generator, dtype=DOUBLE) - 0.5
        axis = torch.eye(3, dtype=DOUBLE)[[0 if fold else 1]]
        turn = torch.cat((torch.zeros(1, 3, dtype=DOUBLE), axis * np.deg2rad(degrees)))
        return points, _affine(axis_angle_to_rotmat(turn), torch.zeros(2, 3, dtype=DOUBLE))

    return make


def exact_skin(extra: _Weighted, points: np.ndarray, transforms: np.ndarray) -> np.ndarray:
    """The weighted sum of the images under each joint; a loop over joints."""
    weights, out = extra.double.dense.numpy(), np.zeros_like(points)
    for j, transform in enumerate(transforms):
        out += weights[: len(points), j, None] * (points @ transform[:3, :3].T)
    # the last row of a blended map is set, so that translations are blended by the same weights
    return out + weights[: len(points)] @ transforms[:, :3, 3]


def _skin_scale(
    extra: _Weighted, exact: np.ndarray, points: np.ndarray, transforms: np.ndarray
) -> np.ndarray:
    largest = np.abs(points).max(initial=0) + np.abs(transforms[:, :3, 3]).max(initial=0)
    return np.full(len(exact), max(largest, 1e-30))


def _skin_way(backend: Backend) -> Way:
    def run(extra: _Weighted, points: Tensor, transforms: Tensor) -> Tensor:
        weights = extra.like(points)
        return blend_skin(points, transforms, weights, backend)

    kinds = kinds_of(backend)
    return Way(f"monopart {backend}", run, True, kinds)


def _skin_in_two(extra: _Weighted, points: Tensor, transforms: Tensor) -> Tensor:
    return skin(points, blend_transforms(transforms, extra.like(points).dense))


def _fixed(make: Make, count: int) -> Make:
    """The weights have a fixed number of rows, and so must the points."""
    return lambda generator, cases: make(generator, count)


def _skinning_families(count: int) -> tuple[Family, ...]:
    pair = _Weighted.of(torch.full((count, 2), 0.5, dtype=DOUBLE))
    out = []
    for fold in (False, True):
        for degrees in (0.0, 90.0, 170.0, 179.9, 180.0):
            name = f"{'fold' if fold else 'twist'} {degrees:g}°"
            out.append(Family(name, _fixed(_two_bones(degrees, fold), count), extra=pair))
    for name, size, away in (
        *(("24 joints", 1.0, 0.0), ("1e-3 m", 1e-3, 0.0), ("1e3 m", 1e3, 0.0)),
        ("100 km away", 1.0, FAR),
    ):
        make = _fixed(_skin_inputs(size, away, 24), count)
        out.append(Family(name, make, extra=_weights(count, 24), step=1e-5 * size))
    for name, joints, kind in (
        *(("one joint", 1, "all"), ("200 joints", 200, "all"), ("zero weights", 24, "zero")),
        ("weights sum to ½", 24, "half"),
    ):
        make = _fixed(_skin_inputs(1.0, 0.0, joints), count)
        family = Family(name, make, extra=_weights(count, joints, kind))
        out.append(dataclasses.replace(family, inside="sum" not in name and "zero" not in name))
    return tuple(out)


def _skinning() -> Stress:
    count = 512
    return Stress(
        name="blend_skin",
        title="linear blend skinning",
        domain="weights that sum to 1, any pose: a blend may be singular; other sums scale the "
        "result, finite",
        error="largest coordinate of points and translations",
        families=_skinning_families(count),
        ways=(
            *(_skin_way("torch"), _skin_way("warp")),
            Way("monopart, blends first", _skin_in_two, True),
        ),
        exact=exact_skin,
        scale=_skin_scale,
        wrt=(0, 1),
        cases=count,
    )


def _exact_motion(extra: _Weighted, rest: np.ndarray, transforms: np.ndarray) -> np.ndarray:
    """Turns of the joints of a chain, one joint, axis and carried joint after the other."""
    weights, count = extra.double.dense.numpy()[: len(rest)], len(transforms)
    out = np.zeros((len(rest), count, 3, 3))
    images = [rest @ t[:3, :3].T + t[:3, 3] for t in transforms]
    for j in range(count):
        turned = transforms[j - 1, :3, :3] if j else np.eye(3)
        lever = sum(
            weights[:, k, None] * (images[k] - transforms[j, :3, 3]) for k in range(j, count)
        )
        for axis in range(3):
            out[:, j, axis] = np.cross(turned[:, axis], lever)
    return out


def _motion() -> Stress:
    count = 128

    def run(extra: _Weighted, rest: Tensor, transforms: Tensor) -> Tensor:
        chain = KinematicTree(tuple(range(-1, len(transforms) - 1)))
        joints = transforms[:, :3, 3]
        return joint_motion(rest, extra.like(rest).dense, transforms, joints, chain)

    return Stress(
        name="joint_motion",
        title="motion of skinned points by turns of joints",
        domain="weights that sum to 1, any pose; other sums scale the result, finite",
        error="largest coordinate of points and translations",
        families=_skinning_families(count),
        ways=(Way("monopart", run, True),),
        exact=_exact_motion,
        scale=_skin_scale,
        wrt=(0, 1),
        cases=count,
    )


def _unskin() -> Stress:
    count = 512

    def run(extra: _Weighted, points: Tensor, transforms: Tensor) -> tuple[Tensor, Tensor]:
        return unskin(points, blend_transforms(transforms, extra.like(points).dense))

    def exact(extra: _Weighted, points: np.ndarray, transforms: np.ndarray) -> np.ndarray:
        maps = np.einsum("nj,jab->nab", extra.double.dense.numpy(), transforms)
        out = np.zeros_like(points)
        for i, (point, blend) in enumerate(zip(points, maps, strict=True)):
            if abs(np.linalg.det(blend[:3, :3])) > 1e-6:
                out[i] = np.linalg.solve(blend[:3, :3], point - blend[:3, 3])
        return out

    def scale(
        extra: _Weighted, found: np.ndarray, points: np.ndarray, transforms: np.ndarray
    ) -> np.ndarray:
        maps = np.einsum("nj,jab->nab", extra.double.dense.numpy(), transforms)
        smallest = np.linalg.svd(maps[:, :3, :3], compute_uv=False)[:, -1]
        return _skin_scale(extra, found, points, transforms) / np.maximum(smallest, 1e-3) ** 2

    families = tuple(dataclasses.replace(f, step=1e-7) for f in _skinning_families(count))
    return Stress(
        name="unskin",
        title="inverse of a blend",
        domain="|det| > 1e-2: a twist below 169°; others are masked, with zero gradient",
        error="largest coordinate over the square of the smallest singular value",
        families=families,
        ways=(Way("monopart", run, True),),
        exact=exact,
        scale=scale,
        wrt=(0, 1),
        cases=count,
    )


def stresses() -> list[Stress]:
    """Operations on skeletons and bodies."""
    from . import stability_bodies

    return [_kinematics(), _skinning(), _motion(), _unskin(), *stability_bodies.stresses()]
