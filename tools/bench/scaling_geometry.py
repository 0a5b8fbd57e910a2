"""How the cost of geometry grows: with points, faces, joints, bodies and threads."""

import dataclasses
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch

from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.kinematics import KinematicTree
from monopart.geometry.surface import SurfaceIndex
from monopart.geometry.unskin import inverse_skin

from .bodies import SurfaceData, joint_limits, pose_list, surface_data
from .meshes import subdivided
from .registry import Method, Operation, Problem, Settings
from .timing import with_threads

POINTS = 32_768
BODIES = 8


@dataclass(eq=False)
class Scaled:
    """A posed body with points near it, and how many threads work."""

    surface: SurfaceData
    threads: int = 0
    bodies: int = BODIES


def with_joints(body: BodyModel, count: int) -> BodyModel:
    """The body with another number of joints.

    Further joints share, in turn, the weights of an old one as its children; of fewer, the last
    ones give their weights to their parents.

    Args:
        body: the body.
        count: number of joints, at least 1.
    """
    parents, weights = list(body.tree.parents), [body.weights[:, j] for j in range(body.num_joints)]
    regressor = list(body.joint_regressor)
    for joint in range(count - body.num_joints):
        weights[joint] = weights[joint] / 2
        weights.append(weights[joint])
        parents.append(joint)
        regressor.append(regressor[joint])
    while len(parents) > count:  # parents come before their children: the last joint is a leaf
        parent, last = parents.pop(), weights.pop()
        weights[parent] = weights[parent] + last
    return dataclasses.replace(
        body,
        weights=torch.stack(weights, 1).contiguous(),
        tree=KinematicTree(tuple(parents)),
        joint_regressor=torch.stack(regressor[:count]),
        posedirs=body.posedirs.new_zeros(body.num_verts, 3, 9 * (count - 1)),
        joint_names=(),
    )


def _posed(body: BodyModel, points: int = POINTS, threads: int = 0) -> Scaled:
    limits = joint_limits(BodyModel.default())
    _, pose = pose_list(BodyModel.default(), 3)[1]
    turned = torch.zeros(body.num_joints, 3)
    shared = min(len(limits), body.num_joints)
    turned[:shared] = pose.pose[:shared]
    full = BodyPose(turned, pose.betas, pose.rotation, pose.translation)
    return Scaled(surface_data(body, full, points, shift=0.0), threads)


def _closest(data: Scaled) -> Callable[[], Any]:
    own = data.surface
    index = SurfaceIndex(own.verts, own.faces)
    return with_threads(data.threads, lambda: index.query(own.points))


def _unskin(data: Scaled) -> Callable[[], Any]:
    own = data.surface

    def call() -> Any:
        return inverse_skin(own.points, own.posed, own.body, rest_verts=own.rest)

    return with_threads(data.threads, call)


def _skin(data: Scaled) -> Callable[[], Any]:
    body = data.surface.body
    generator = torch.Generator().manual_seed(4)
    pose = 0.3 * torch.randn(data.bodies, body.num_joints, 3, generator=generator)
    betas, still = torch.zeros(data.bodies, body.num_betas), torch.zeros(data.bodies, 3)

    def call() -> Any:
        turned = pose.clone().requires_grad_()
        verts = body(BodyPose(turned, betas, still, still)).verts
        return torch.autograd.grad(verts.square().mean(), turned)

    return with_threads(data.threads, call)


def _refined(levels: int) -> BodyModel:
    body = BodyModel.default()
    for _ in range(levels):
        body = subdivided(body)
    return body


def _points(settings: Settings) -> Iterator[Problem]:
    for count in (32, 64) if settings.quick else (2_048, 8_192, 32_768, 131_072, 524_288):
        yield Problem(count, "points", _posed(BodyModel.default(), count))


def _faces(settings: Settings) -> Iterator[Problem]:
    for levels in (0,) if settings.quick else (0, 1, 2, 3):
        body = _refined(levels)
        points = 32 if settings.quick else POINTS
        yield Problem(len(body.faces), "faces", _posed(body, points))


def _joints(settings: Settings) -> Iterator[Problem]:
    for count in (12, 26) if settings.quick else (12, 24, 50, 100, 200):
        points = 32 if settings.quick else POINTS
        yield Problem(count, "joints", _posed(with_joints(BodyModel.default(), count), points))


def _bodies(settings: Settings) -> Iterator[Problem]:
    for count in (1, 2) if settings.quick else (1, 4, 16, 64, 256):
        data = dataclasses.replace(_posed(BodyModel.default(), 16), bodies=count)
        yield Problem(count, "bodies", data)


def _threads(settings: Settings) -> Iterator[Problem]:
    cores = os.cpu_count() or 1
    for count in (1,) if settings.quick else [n for n in (1, 2, 4, 8, 16) if n <= cores]:
        points = 32 if settings.quick else POINTS
        yield Problem(count, "threads", _posed(BodyModel.default(), points, count))


def geometry_axes() -> tuple[Operation, ...]:
    """One operation per axis."""
    closest = Method("closest surface", _closest, ours=True)
    unskin = Method("inverse skinning (newton)", _unskin, ours=True)
    skin = Method(f"skinning of {BODIES} bodies, forward and backward", _skin, ours=True)
    batch = Method("skinning, forward and backward", _skin, ours=True)
    axes = (
        ("points", _points, (closest, unskin)),
        ("faces", _faces, (closest, unskin, skin)),
        ("joints", _joints, (closest, unskin, skin)),
        ("bodies", _bodies, (batch,)),
        ("cores", _threads, (closest, unskin, skin)),
    )
    return tuple(
        Operation(f"scaling_{name}", f"Geometry: time against {name}", "none", methods, make, _none)
        for name, make, methods in axes
    )


def _none(data: Scaled, result: Any) -> dict[str, float]:
    return {}
