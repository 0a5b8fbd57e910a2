"""Stress of posed bodies and of inverse skinning."""

import dataclasses
from typing import Any

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.skinning import blend_transforms
from monopart.geometry.surface import closest_point
from monopart.geometry.unskin import inverse_skin

from .registry import load
from .stability_cases import DOUBLE, Backend, Family, Inputs, Stress, Way, kinds_of
from .stability_rotations import Make, axes, exact_rotmat
from .stability_skinning import exact_chain

# --- the whole body ----------------------------------------------------------------------------


def _poses(angle: float, betas: float) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        body = BodyModel.default()
        turn = axes(generator, body.num_joints + 3)[3:]
        shape = betas * torch.randn(body.num_betas, generator=generator, dtype=DOUBLE)
        return angle * turn, shape

    return make


def exact_body(extra: None, pose: np.ndarray, betas: np.ndarray) -> np.ndarray:
    """SMPL's equations in float64 with the matrix of every vertex; every 16th vertex."""
    body = BodyModel.default()
    verts = body.v_template.double().numpy() + body.shapedirs.double().numpy() @ betas
    joints = body.joint_regressor.double().numpy() @ verts
    rotmats = exact_rotmat(None, pose)
    feature = (rotmats[1:] - np.eye(3)).reshape(-1)
    bent = verts + body.posedirs.double().numpy() @ feature
    rows = exact_chain(body.tree, rotmats[None], joints[None])
    shift = rows[..., 3] - np.einsum("jab,jb->ja", rows[..., :3], joints)
    weights = body.weights.double().numpy()
    linear = np.einsum("vj,jab->vab", weights, rows[..., :3])
    return (np.einsum("vab,vb->va", linear, bent) + weights @ shift)[::16]


def _body_way(backend: Backend) -> Way:
    def run(extra: None, pose: Tensor, betas: Tensor) -> Tensor:
        still = pose.new_zeros(3)
        return BodyModel.default()(BodyPose(pose, betas, still, still), backend).verts[::16]

    kinds = kinds_of(backend)
    return Way(f"monopart {backend}", run, True, kinds)


def _smplx_body(extra: None, pose: Tensor, betas: Tensor) -> Tensor:
    body = BodyModel.default().to(pose)
    verts, _ = load("smplx.lbs").lbs(
        betas[None],
        pose.reshape(1, -1),
        body.v_template[None],
        body.shapedirs,
        body.posedirs.flatten(0, 1).mT,
        body.joint_regressor,
        torch.tensor(body.tree.parents),
        body.weights,
    )
    return verts[0, ::16]


def _body() -> Stress:
    shapes = (("rest", 0.0, 0.0), ("1e-8 rad", 1e-8, 0.0), ("1 rad", 1.0, 1.0))
    shapes = (*shapes, ("π in every joint", np.pi, 1.0), ("betas of 10", 1.0, 10.0))
    families = tuple(Family(name, _poses(*rest), step=1e-6) for name, *rest in shapes)
    return Stress(
        name="body",
        title="posed body (vertices)",
        domain="any pose; the body at its own origin, placed in the world afterwards",
        error="1 m, the size of a body",
        families=families,
        ways=(
            _body_way("torch"),
            _body_way("warp"),
            Way("smplx", _smplx_body, modules=("smplx",)),
        ),
        exact=exact_body,
        wrt=(0, 1),
        cases=1,
    )


# --- inverse skinning --------------------------------------------------------------------------


def _around(angle: float, gap: float) -> tuple[Make, Any]:
    """Points at a distance from the vertices of a pose."""
    body = BodyModel.default()
    pose = BodyPose.zeros(body)
    pose.pose[16:20, 2] = angle
    pose.pose[4, 0] = angle
    posed = body(pose)

    def make(generator: torch.Generator, count: int) -> Inputs:
        rows = torch.randint(0, body.num_verts, (count,), generator=generator)
        return (posed.verts.double()[rows] + gap * axes(generator, count),)

    return make, pose


def _cycle(pose: BodyPose, points: np.ndarray) -> np.ndarray:
    return points


def _unskin_way(method: str) -> Way:
    def run(pose: BodyPose, points: Tensor) -> tuple[Tensor, Tensor]:
        body = BodyModel.default().to(points)
        posed = body(pose.to(points))
        found = inverse_skin(points, posed, body, method)
        # back again in float64, with the weights of the rest point: the target where it is a root
        rest, verts = found.points.double(), body.v_template.double()
        hit = closest_point(torch.where(rest.isfinite(), rest, 0.0), verts, body.faces)
        weights = (hit.bary[..., None] * body.weights.double()[body.faces[hit.face]]).sum(1)
        maps = blend_transforms(posed.transforms.double(), weights)
        return (maps[:, :3, :3] * rest[:, None]).sum(-1) + maps[:, :3, 3], found.valid

    return Way(f"monopart {method}", run, True)


def _inverse() -> Stress:
    families = []
    for name, angle, gap in (
        *(("on the surface", 0.5, 0.0), ("3 cm", 0.5, 0.03), ("fold 150°", 2.6, 0.03)),
        *(("fold 180°", np.pi, 0.03), ("10 m off", 0.5, 10.0), ("1e6 m off", 0.5, 1e6)),
    ):
        make, posture = _around(angle, gap)
        families.append(Family(name, make, extra=posture, smooth=False))
    pose = families[0].extra
    bad = Family("NaN", lambda g, n: (torch.full((n, 3), torch.nan, dtype=DOUBLE),), extra=pose)
    return Stress(
        name="inverse_skin",
        title="inverse skinning (cycle error of valid points)",
        domain="any point; one without a rest point within reach is masked; roots stop at 5 µm in "
        "float32, 1e-10 m in float64",
        error="1 m, the size of a body",
        families=(*families, dataclasses.replace(bad, smooth=False)),
        ways=tuple(_unskin_way(m) for m in ("newton", "broyden", "fixed_point", "surface")),
        exact=_cycle,
        cases=128,
        limit=1.01e-3,
        double=1.01e-3,
    )


def stresses() -> list[Stress]:
    """Operations on bodies."""
    return [_body(), _inverse()]
