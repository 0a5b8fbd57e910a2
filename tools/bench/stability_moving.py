"""Stress of parts whose poses are learned, of looking up one part, and of going back."""

import dataclasses
import functools
from typing import Any

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.body import BodyModel, BodyPose, PosedBody
from monopart.geometry.culling import ShellSamples
from monopart.geometry.moving_parts import MovingParts
from monopart.geometry.parts import PartMap
from monopart.geometry.posed_parts import PartHit, PartPairs, PosedParts
from monopart.geometry.rotations import axis_angle_to_rotmat

from .stability_cases import SINGLE, Family, Inputs, Stress, Way
from .stability_meshes import exact_distance
from .stability_rotations import Make, axes, exact_rotmat

_RADIUS = 0.05

# --- following parts as poses move -------------------------------------------------------------


@functools.cache
def _scene() -> tuple[BodyModel, PosedBody, PartMap]:
    body = BodyModel.default()
    return body, body.canonical(torch.zeros(body.num_betas)), PartMap.default()


def pose_of(angle: float, fold: float) -> BodyPose:
    """Axis-angle vectors of one angle about random axes; elbows and a knee folded."""
    body, generator = _scene()[0], torch.Generator().manual_seed(11)
    pose = angle * axes(generator, body.num_joints + 3)[3:]
    pose[18:20, 1] += fold
    pose[4, 0] += fold
    turn, shift = torch.tensor([0.2, 1.0, -0.4]), torch.tensor([0.5, -0.25, 2.0])
    return dataclasses.replace(
        BodyPose.zeros(body), pose=pose.float(), rotation=turn, translation=shift
    )


@dataclasses.dataclass(frozen=True)
class _Held:
    """Samples next to a posed body, with the faces that are closest to them."""

    pose: BodyPose
    parts: PosedParts
    samples: ShellSamples
    pairs: PartPairs

    @classmethod
    def of(cls, pose: BodyPose, gap: float, count: int = 48) -> "_Held":
        body, canonical, table = _scene()
        posed = body(pose)
        parts = PosedParts(body, posed, canonical, table, _RADIUS)
        generator = torch.Generator().manual_seed(5)
        rows = torch.randint(0, body.num_verts, (count,), generator=generator)
        points = posed.verts[rows] + gap * axes(generator, count).float()
        still = torch.zeros(count, dtype=torch.int32)
        starts = torch.arange(count + 1)
        every = torch.full_like(still, (1 << parts.num_parts) - 1)
        depth = torch.zeros(count)
        ray = starts[:-1].int()
        samples = ShellSamples(points, depth, ray, still, every, starts, count)
        return cls(pose, parts, samples, parts.pairs(samples))

    @functools.cached_property
    def start(self) -> tuple[Tensor, Tensor]:
        """Rotation and translation at which the samples were taken, float64."""
        return axis_angle_to_rotmat(self.pose.rotation.double()), self.pose.translation.double()

    def moved(self, pose: Tensor, turn: Tensor, shift: Tensor) -> MovingParts:
        """The parts in other poses; samples stand still in the world."""
        body = _scene()[0].to(pose)
        given = BodyPose(pose, pose.new_zeros(1, body.num_betas)[0], turn, shift)
        posed = body(given, "torch")
        posed = dataclasses.replace(
            posed,
            verts=posed.verts[None],
            joints=posed.joints[None],
            transforms=posed.transforms[None],
            rotation=posed.rotation[None],
            translation=posed.translation[None],
        )
        parts = MovingParts.like(self.parts, body, posed, self.parts.shell)
        # what `like` sets has no value to take differences of: identity and 0, with gradients
        R, t = (x.to(pose) for x in self.start)
        parts.turn = posed.rotation.mT @ R
        parts.shift = (posed.rotation.mT @ (t - posed.translation)[..., None]).squeeze(-1)
        return parts


def _closest(p: np.ndarray, corners: np.ndarray, bary: np.ndarray) -> np.ndarray:
    """Barycentrics of the closest point on a face, or on the edge or corner that holds it."""
    free = np.flatnonzero(bary > 1e-6)
    base, out = corners[free[0]], np.zeros(3)
    sides = (corners[free[1:]] - base).T
    share = np.linalg.lstsq(sides, p - base, rcond=None)[0] if len(free) > 1 else np.zeros(0)
    out[free[1:]] = share
    out[free[0]] = 1 - share.sum()
    return out


def exact_follow(held: _Held, pose: np.ndarray, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Rest points and UVs pair by pair, in float64."""
    body, (verts, maps) = _scene()[0], _exact_maps(pose)
    R, t = (x.numpy() for x in held.start)
    now = exact_rotmat(None, turn[None])[0]
    parts, pairs, out = held.parts, held.pairs, []
    there, uv = (x.double().numpy() for x in (parts.canonical_maps, parts.corner_uv))
    samples = held.samples.points.double().numpy()
    for row, face, two in zip(
        pairs.sample.tolist(), pairs.face.tolist(), pairs.bary.double().numpy(), strict=True
    ):
        point = now.T @ (R @ samples[row] + t - shift)
        corners = body.faces[face].numpy()
        bary = _closest(point, verts[corners], np.append(two, 1 - two.sum()))
        away, back = (np.einsum("c,cij->ij", bary, m[corners]) for m in (maps, there))
        local = np.linalg.solve(away[:, :3], point - away[:, 3])
        out.append(np.append(back[:, :3] @ local + back[:, 3], bary @ uv[face]))
    return np.stack(out)


def _exact_maps(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of the mean shape and the maps that bring them there, as SMPL's equations say."""
    from .stability_skinning import exact_chain

    body = _scene()[0]
    verts = body.v_template.double().numpy()
    joints = body.joint_regressor.double().numpy() @ verts
    rotmats = exact_rotmat(None, pose)
    bent = verts + body.posedirs.double().numpy() @ (rotmats[1:] - np.eye(3)).reshape(-1)
    rows = exact_chain(body.tree, rotmats[None], joints[None])
    rows[..., 3] -= np.einsum("jab,jb->ja", rows[..., :3], joints)
    maps = np.einsum("vj,jab->vab", body.weights.double().numpy(), rows)
    return np.einsum("vab,vb->va", maps[..., :3], bent) + maps[..., 3], maps


def _follow() -> Stress:
    def run(held: _Held, pose: Tensor, turn: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
        parts = held.moved(pose, turn, shift)
        found = parts.follow(held.samples, held.pairs)
        return torch.cat((found.points, found.uv), 1), found.valid

    shapes = (
        *(("rest, 3 cm", 0.0, 0.0, 0.03), ("0.3 rad, 3 cm", 0.3, 0.0, 0.03)),
        *(("0.3 rad, on vertices", 0.3, 0.0, 0.0), ("folds of 150°", 0.0, 2.6, 0.02)),
        ("1e-8 rad", 1e-8, 0.0, 0.03),
    )
    families = []
    for name, angle, fold, gap in shapes:
        held = _Held.of(pose_of(angle, fold), gap)
        families.append(Family(name, _pose_inputs(held), extra=held, step=1e-7))
    return Stress(
        name="follow",
        title="canonical points as functions of the pose",
        domain="pairs whose blend has |det| > 1e-2; others are masked; the face, and the edge or "
        "corner, on which a closest point lies is held, and on needles the place on it too",
        error="1 m over the square of the smallest singular value of the blend",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=exact_follow,
        scale=_follow_scale,
        wrt=(0, 1, 2),
        rows_apart=False,
        cases=48,
        limit=2e-6,
    )


def _pose_inputs(held: _Held) -> Make:
    pose = held.pose
    return lambda g, n: (pose.pose.double(), pose.rotation.double(), pose.translation.double())


def _follow_scale(held: _Held, exact: np.ndarray, pose: np.ndarray, *rest: Any) -> np.ndarray:
    maps = _exact_maps(pose)[1]
    pairs = held.pairs
    corners = _scene()[0].faces[pairs.face].numpy()
    two = pairs.bary.double().numpy()
    bary = np.concatenate((two, 1 - two.sum(1, keepdims=True)), 1)
    blends = np.einsum("mc,mcij->mij", bary, maps[corners][..., :3])
    # the place on the face moves as far as the point does, and the maps with it
    return 4 / np.maximum(np.linalg.svd(blends, compute_uv=False)[:, -1] ** 2, 1e-2)


# --- the surface of one part, and back to the pose ---------------------------------------------


@functools.cache
def _canonical_parts() -> PosedParts:
    body, canonical, table = _scene()
    return PosedParts(body, canonical, canonical, table, _RADIUS)


def _near_canonical(gap: float, special: float | None = None) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        verts = _canonical_parts().verts[0].double()
        rows = torch.randint(0, len(verts), (count,), generator=generator)
        points = verts[rows] + gap * axes(generator, count)
        return (points if special is None else torch.full_like(points, special),)

    return make


def _part_of(points: np.ndarray | Tensor) -> Tensor:
    return torch.arange(len(points)) % _canonical_parts().num_parts


def _on_part() -> Stress:
    """Distance to the surface of one part, each in turn; UVs of what is not found are finite."""

    def run(extra: None, points: Tensor) -> tuple[Tensor, Tensor]:
        parts = _canonical_parts()
        hit = parts.on_part(points, _part_of(points))
        foot = (parts.verts[0][parts.faces[hit.face]] * hit.bary[..., None]).sum(1)
        bad = (~hit.uv.isfinite().all(1)).to(points)  # of those not found too
        gap = (points - foot).norm(dim=1) + torch.where(bad > 0, torch.nan, 0.0)
        return gap, hit.found | (bad > 0)

    def exact(extra: None, points: np.ndarray) -> np.ndarray:
        parts, part = _canonical_parts(), _part_of(points).numpy()
        out, verts = np.zeros(len(points)), parts.verts[0].double().numpy()
        for k in range(parts.num_parts):
            faces, own = parts.faces[parts.face_part == k], part == k
            out[own] = exact_distance(faces, np.nan_to_num(points[own]), verts)
        return out

    shapes = (
        *(("3 cm", 0.03, None), ("on vertices", 0.0, None), ("at the reach", 0.2, None)),
        *(("10 m off", 10.0, None), ("1e30 m off", 1e30, None)),
        *(("infinite", 0.0, torch.inf), ("NaN", 0.0, torch.nan)),
    )
    return Stress(
        name="on_part",
        title="closest surface of one part (distance)",
        domain="any point; beyond the reach, and where it is not finite, nothing is found (masked)",
        error="1 m, the size of a body",
        families=tuple(Family(n, _near_canonical(g, s)) for n, g, s in shapes),
        ways=(Way("monopart", run, True, (SINGLE,), differentiable=False),),
        exact=exact,
        wrt=(),
        cases=96,
    )


def _reskin() -> Stress:
    """Canonical points in the pose, against a solve in float64 with the same maps."""

    def run(held: _Held, points: Tensor) -> Tensor:
        canonical = _canonical_parts()
        hit = _held_hit(points)
        body = torch.zeros(len(points), dtype=torch.long)
        return held.parts.reskin(points, body, hit, canonical)

    def exact(held: _Held, points: np.ndarray) -> np.ndarray:
        hit = _held_hit(torch.from_numpy(points).float())
        corners, bary = held.parts.faces[hit.face].numpy(), hit.bary.double().numpy()
        maps = (_canonical_parts().canonical_maps, held.parts.posed_maps)
        away, there = (np.einsum("mc,mcij->mij", bary, m.double().numpy()[corners]) for m in maps)
        local = np.linalg.solve(away[..., :3], (points - away[..., 3])[..., None])
        return (there[..., :3] @ local)[..., 0] + there[..., 3]

    families = []
    for name, angle, fold, gap in (
        *(("rest, 3 cm", 0.0, 0.0, 0.03), ("0.3 rad, 3 cm", 0.3, 0.0, 0.03)),
        *(("on vertices", 0.3, 0.0, 0.0), ("folds of 150°", 0.0, 2.6, 0.03)),
        *(("π in every joint", np.pi, 0.0, 0.03), ("10 m off", 0.3, 0.0, 10.0)),
    ):
        held = _Held.of(pose_of(angle, fold), 0.0, 8)
        families.append(Family(name, _near_canonical(gap), extra=held))
    return Stress(
        name="reskin",
        title="canonical points in the pose",
        domain="any pose; the canonical pose has no singular blends; a point without a hit takes "
        "the map of face 0: ask `found`",
        error="largest coordinate, at least 1 m",
        families=tuple(families),
        ways=(Way("monopart", run, True, (SINGLE,)),),
        exact=exact,
        scale=lambda held, exact, p: np.maximum(np.abs(p).max(1), 1.0) * 2,
        cases=64,
    )


def _held_hit(points: Tensor) -> PartHit:
    return _canonical_parts().on_part(points.detach(), _part_of(points))


def _some_faces(held: _Held, count: int) -> Tensor:
    return torch.arange(count) * 97 % len(held.parts.faces)


def _world_normals() -> Stress:
    """Normals of vertices on surface points, against sums over faces in float64."""

    def run(held: _Held, bary: Tensor) -> Tensor:
        parts, face = held.parts, _some_faces(held, len(bary))
        normals = torch.nn.functional.pad(parts.world_normals(), (0, 1))
        return parts.interpolate(normals, torch.zeros_like(face), face, bary)[:, :3]

    def exact(held: _Held, bary: np.ndarray) -> np.ndarray:
        verts, faces = held.parts.verts[0].double().numpy(), held.parts.faces.numpy()
        a, b, c = (verts[faces[:, i]] for i in range(3))
        total = np.zeros_like(verts)
        for corner in range(3):
            np.add.at(total, faces[:, corner], np.cross(b - a, c - a))
        total /= np.linalg.norm(total, axis=1, keepdims=True)
        three = np.concatenate((bary, 1 - bary.sum(1, keepdims=True)), 1)
        normal = np.einsum("mc,mci->mi", three, total[faces[_some_faces(held, len(bary)).numpy()]])
        return normal @ exact_rotmat(None, held.pose.rotation.double().numpy()[None])[0].T

    def places(generator: torch.Generator, count: int) -> Inputs:
        share = torch.rand(count, 3, generator=generator, dtype=torch.float64) + 1e-3
        return ((share / share.sum(1, keepdim=True))[:, :2],)

    poses = {"rest": (0.0, 0.0), "0.3 rad": (0.3, 0.0), "π in every joint": (np.pi, 0.0)}
    return Stress(
        name="world_normals",
        title="normals on posed surfaces",
        domain="any pose and place on a face",
        error="1, the length of a normal",
        families=tuple(
            Family(name, places, extra=_Held.of(pose_of(*pose), 0.0, 8))
            for name, pose in poses.items()
        ),
        ways=(Way("monopart", run, True, (SINGLE,), differentiable=False),),
        exact=exact,
        wrt=(),
        cases=96,
    )


def stresses() -> list[Stress]:
    """Operations on moving parts."""
    return [_follow(), _on_part(), _reskin(), _world_normals()]
