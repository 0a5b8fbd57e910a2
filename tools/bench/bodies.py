"""Bodies, poses and points on which geometry is measured: the same on every machine."""

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from monopart.geometry.body import BodyModel, BodyPose, PosedBody

POSES = 20
REACH = 0.03
"""Points lie this far from the surface at most, metres."""
DEFAULT_LIMIT = 0.4
_LIMITS = {
    "hip": (1.6, 0.7, 0.7),
    "knee": (2.2, 0.1, 0.1),
    "ankle": (0.7, 0.3, 0.3),
    "spine": (0.5, 0.4, 0.3),
    "neck": (0.6, 0.8, 0.4),
    "head": (0.4, 0.5, 0.3),
    "collar": (0.2, 0.3, 0.3),
    "shoulder": (0.8, 1.2, 1.4),
    "elbow": (0.3, 2.2, 0.3),
    "wrist": (0.5, 0.4, 0.9),
}
"""Largest rotation about x, y and z of joints by a part of their name, radians; a guess."""


def joint_limits(body: BodyModel) -> Float[Tensor, "J 3"]:
    """Largest rotation of every joint about each axis, radians; the root does not turn."""
    limits = torch.full((body.num_joints, 3), DEFAULT_LIMIT)
    for joint, name in enumerate(body.joint_names):
        for part, values in _LIMITS.items():
            if part in name:
                limits[joint] = torch.tensor(values)
    limits[0] = 0.0
    return limits


def pose_list(
    body: BodyModel, count: int = POSES, capture: Path | None = None
) -> list[tuple[str, BodyPose]]:
    """Poses from the T-pose to contorted ones, the same every time, and some of a capture.

    Args:
        body: the body.
        count: number of poses; the last one uses the full range of every joint.
        capture: folder of a capture of which five poses are added, as far as its body has as many
            joints.

    Returns:
        Names and poses; the bodies stay at the local origin.
    """
    limits, still = joint_limits(body), torch.zeros(3)
    poses = []
    for number in range(count):
        generator = torch.Generator().manual_seed(1000 + number)
        scale = number / max(count - 1, 1)
        pose = scale * limits * (2 * torch.rand(limits.shape, generator=generator) - 1)
        betas = torch.zeros(body.num_betas)
        poses.append((f"pose {number:02d}", BodyPose(pose, betas, still, still)))
    if capture is not None:
        poses += _capture_poses(body, capture)
    return poses


def _capture_poses(body: BodyModel, capture: Path) -> list[tuple[str, BodyPose]]:
    from monopart.toolkit.captures import read_capture

    record = read_capture(capture)
    frames = sorted(record.poses)
    wanted = frames[:: max(1, len(frames) // 5)][:5]
    still = torch.zeros(3)
    return [
        (f"{record.name} {f}", BodyPose(record.poses[f].pose, record.poses[f].betas, still, still))
        for f in wanted
        if record.poses[f].pose.shape[0] == body.num_joints
    ]


def near_points(
    verts: Float[Tensor, "v 3"], faces: Tensor, count: int, seed: int, reach: float = REACH
) -> Float[Tensor, "n 3"]:
    """Points within a distance of a surface, uniform over its area and the distance.

    Args:
        verts: vertices, metres.
        faces: vertex indices [F, 3].
        count: number of points.
        seed: of the random numbers.
        reach: largest distance along the normal, metres.
    """
    generator = torch.Generator().manual_seed(seed)
    tris = verts[faces]
    normal = torch.linalg.cross(tris[:, 1] - tris[:, 0], tris[:, 2] - tris[:, 0])
    area = normal.norm(dim=-1)
    face = torch.multinomial(area, count, replacement=True, generator=generator)
    u, v = torch.rand(2, count, generator=generator).unbind(0)
    root = u.sqrt()
    bary = torch.stack([1 - root, root * (1 - v), root * v], -1)
    on = (bary[..., None] * tris[face]).sum(1)
    offset = (2 * torch.rand(count, 1, generator=generator) - 1) * reach
    return on + offset * normal[face] / area[face, None].clamp(min=1e-12)


@dataclass(eq=False)
class SurfaceData:
    """A posed body and points near it."""

    body: BodyModel
    posed: PosedBody
    points: Tensor
    other: Tensor
    """Vertices of another pose, for structures that are refit."""
    rest: Tensor
    """Vertices of the shaped rest pose, metres."""

    @property
    def verts(self) -> Tensor:
        """Posed vertices, local, metres."""
        return self.posed.verts

    @property
    def faces(self) -> Tensor:
        """Vertex indices."""
        return self.body.faces

    @cached_property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points, vertices and faces in double precision."""
        return (
            self.points.double().numpy(),
            self.verts.double().numpy(),
            self.faces.numpy(),
        )

    @cached_property
    def distance(self) -> np.ndarray:
        """Exact distances: libigl's tree in double precision."""
        return closest_exact(*self.arrays)[0]

    @cached_property
    def nearest_weights(self) -> np.ndarray:
        """Skinning weights of the exact closest surface points [N, J]."""
        points, verts, faces = self.arrays
        _, face, on = closest_exact(points, verts, faces)
        bary = barycentrics(on, verts[faces[face]])
        weights = self.body.weights.double().numpy()
        return (bary[..., None] * weights[faces[face]]).sum(1)


def closest_exact(
    points: np.ndarray, verts: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance, face and closest point in double precision, by libigl, the oracle."""
    import igl

    square, face, on = igl.point_mesh_squared_distance(points, verts, faces)
    return np.sqrt(square), np.asarray(face), np.asarray(on)


def barycentrics(points: np.ndarray, tris: np.ndarray) -> np.ndarray:
    """Barycentrics [N, 3] of points on triangles [N, 3, 3], double precision."""
    import igl

    corners = [np.ascontiguousarray(tris[:, i]) for i in range(3)]
    return np.asarray(igl.barycentric_coordinates(points, *corners))


def surface_data(
    body: BodyModel, pose: BodyPose, count: int, seed: int = 0, shift: float = 0.05
) -> SurfaceData:
    """A posed body with points near its surface, and another pose near by."""
    moved = BodyPose(pose.pose + shift * math.pi / 10, pose.betas, pose.rotation, pose.translation)
    with torch.no_grad():
        posed, other = body(pose), body(moved).verts
        rest = body.shaped(pose.betas)[0]
    points = near_points(posed.verts, body.faces, count, seed)
    return SurfaceData(body, posed, points, other, rest)
