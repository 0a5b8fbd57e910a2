"""Linear blend skinning of a batch of bodies: ours, plain torch and other libraries."""

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.body import BodyModel, BodyPose

from .registry import Method, load


@dataclass(eq=False)
class SkinningData:
    """A batch of poses and shapes for one body."""

    body: BodyModel
    pose: Tensor
    betas: Tensor
    backward: bool

    @cached_property
    def exact(self) -> Tensor:
        """Vertices in double precision, by the plain function."""
        arrays = [a.double() for a in plain_arrays(self.body)]
        return plain_skinning(
            self.pose.detach().double(),
            self.betas.detach().double(),
            arrays,
            self.body.tree.parents,
        )

    @cached_property
    def exact_gradient(self) -> Tensor:
        """Gradient of the mean squared vertex in the pose, double precision."""
        pose = self.pose.detach().double().requires_grad_()
        arrays = [a.double() for a in plain_arrays(self.body)]
        betas = self.betas.detach().double()
        verts = plain_skinning(pose, betas, arrays, self.body.tree.parents)
        return torch.autograd.grad(verts.square().mean(), pose)[0]


def plain_arrays(body: BodyModel) -> list[Tensor]:
    """The tensors that `plain_skinning` reads."""
    return [body.v_template, body.shapedirs, body.posedirs, body.joint_regressor, body.weights]


def plain_skinning(
    pose: Tensor, betas: Tensor, arrays: list[Tensor], parents: tuple[int, ...]
) -> Tensor:
    """Vertices [B, V, 3] by Loper et al. 2015, equations 2 to 9, with nothing but torch.

    Args:
        pose: axis-angles [B, J, 3].
        betas: shape coefficients [B, S].
        arrays: from `plain_arrays`.
        parents: parent of every joint.
    """
    template, shapedirs, posedirs, regressor, weights = arrays
    shaped = template + torch.einsum("bs,vcs->bvc", betas, shapedirs)
    joints = torch.einsum("jv,bvc->bjc", regressor, shaped)
    angle = pose.square().sum(-1, keepdim=True).clamp(min=1e-24).sqrt()
    x, y, z = (pose / angle).unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    eye = torch.eye(3, dtype=pose.dtype, device=pose.device)
    sin, cos = angle.sin()[..., None], angle.cos()[..., None]
    rotmats = eye + sin * cross + (1 - cos) * (cross @ cross)
    feature = (rotmats[:, 1:] - eye).flatten(1)
    shaped = shaped + torch.einsum("bp,vcp->bvc", feature, posedirs)
    turn, shift = [rotmats[:, 0]], [joints[:, 0]]
    for joint in range(1, len(parents)):
        parent = parents[joint]
        turn.append(turn[parent] @ rotmats[:, joint])
        offset = (joints[:, joint] - joints[:, parent])[..., None]
        shift.append((turn[parent] @ offset).squeeze(-1) + shift[parent])
    turns, shifts = torch.stack(turn, 1), torch.stack(shift, 1)
    shifts = shifts - (turns @ joints[..., None]).squeeze(-1)
    rows = torch.cat([turns, shifts[..., None]], -1).flatten(2)
    maps = (weights @ rows).unflatten(-1, (3, 4))
    return (maps[..., :3] @ shaped[..., None]).squeeze(-1) + maps[..., 3]


Run = Callable[[Tensor, Tensor], Tensor]


def _method(make: Callable[[SkinningData], Run]) -> Callable[[Any], Callable[[], Any]]:
    """Forward, or forward and backward, of a function of pose and betas."""

    def prepare(data: SkinningData) -> Callable[[], Any]:
        run = make(data)
        if not data.backward:

            def forward() -> tuple[Tensor, None]:
                with torch.no_grad():
                    return run(data.pose, data.betas), None

            return forward
        pose = data.pose.detach().clone().requires_grad_()
        betas = data.betas.detach().clone().requires_grad_()

        def both() -> tuple[Tensor, Tensor]:
            verts = run(pose, betas)
            gradient, _ = torch.autograd.grad(verts.square().mean(), (pose, betas))
            return verts.detach(), gradient

        return both

    return prepare


def _ours(data: SkinningData) -> Run:
    still = torch.zeros(len(data.pose), 3)
    return lambda pose, betas: data.body(BodyPose(pose, betas, still, still)).verts


def _plain(data: SkinningData) -> Run:
    arrays, parents = plain_arrays(data.body), data.body.tree.parents
    return lambda pose, betas: plain_skinning(pose, betas, arrays, parents)


def _compiled(data: SkinningData) -> Run:
    arrays, parents = plain_arrays(data.body), data.body.tree.parents
    compiled = torch.compile(plain_skinning, dynamic=False)
    return lambda pose, betas: compiled(pose, betas, arrays, parents)


def _smplx(data: SkinningData) -> Run:
    lbs = load("smplx.lbs").lbs
    template, shapedirs, posedirs, regressor, weights = plain_arrays(data.body)
    rows = posedirs.flatten(0, 1).mT.contiguous()
    parents = torch.tensor(data.body.tree.parents)

    def run(pose: Tensor, betas: Tensor) -> Tensor:
        inputs = (template[None], shapedirs, rows, regressor, parents, weights)
        return lbs(betas, pose.flatten(1), *inputs)[0]

    return run


def _body_models(data: SkinningData) -> Run:
    body = data.body
    smpl = load("body_models.smpl.torch").SMPL
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "body.npz"
        template, shapedirs, posedirs, regressor, weights = (a.numpy() for a in plain_arrays(body))
        np.savez(
            path,
            v_template=template,
            shapedirs=shapedirs,
            posedirs=posedirs,
            J_regressor=regressor,
            weights=weights,
            kintree_table=np.array([body.tree.parents, range(body.num_joints)]),
            f=body.faces.numpy(),
        )
        model = smpl(model_path=path)

    def run(pose: Tensor, betas: Tensor) -> Tensor:
        return model.forward_vertices(pose[:, 1:], pelvis_rotation=pose[:, 0], shape=betas)

    return run


def no_compiler() -> str | None:
    """Why torch.compile cannot run here, or None."""
    if any(shutil.which(name) for name in ("c++", "g++", "clang++")):
        return None
    return "torch.compile needs a C++ compiler; install one"


def skinning_methods() -> tuple[Method, ...]:
    """Methods of linear blend skinning."""
    return (
        Method("monopart", _method(_ours), ours=True),
        Method("plain torch", _method(_plain)),
        Method(
            "torch.compile of plain torch", _method(_compiled), needs=no_compiler, slow_start=True
        ),
        Method("smplx", _method(_smplx), ("smplx",), "pip install --no-deps smplx"),
        Method(
            "body-models", _method(_body_models), ("body_models",), "pip install body-models[torch]"
        ),
    )


def judge_skinning(data: SkinningData, result: tuple[Tensor, Tensor | None]) -> dict[str, float]:
    """Largest vertex error, metres; largest gradient error relative to the largest gradient."""
    verts, gradient = result
    gap = (verts.double() - data.exact).norm(dim=-1).max()
    figures = {"error": float(gap)}
    if gradient is not None:
        exact = data.exact_gradient
        off = (gradient.double() - exact).abs().max() / exact.abs().max()
        figures["gradient error"] = float(off)
    return figures
