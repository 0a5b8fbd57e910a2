"""Bodies in poses and points around them, for the tests of inverse skinning."""

import torch
from torch import Tensor
from tube import tube

from monopart.geometry.body import BodyModel, BodyPose, PosedBody
from monopart.geometry.surface import vertex_normals

METHODS = ("nearest", "surface", "fixed_point", "broyden", "newton")
ITERATIVE = METHODS[2:]


def pose_of(body: BodyModel, pose: Tensor, betas: Tensor | None = None) -> PosedBody:
    """A body in a pose."""
    zero = BodyPose.zeros(body)
    betas = zero.betas if betas is None else betas
    return body(BodyPose(pose, betas, zero.rotation, zero.translation))


def bent_tube(dtype: torch.dtype = torch.float64) -> tuple[BodyModel, PosedBody]:
    """The tube, bent and twisted at its joints."""
    body = tube(dtype)
    pose = torch.tensor([[0.1, 0.2, -0.1], [0.2, 0.3, 0.7], [-0.3, 0.4, -0.5]], dtype=dtype)
    return body, pose_of(body, pose)


def around(verts: Tensor, faces: Tensor, count: int, reach: float = 0.03) -> Tensor:
    """Points on a surface, displaced along its normals by up to ``reach``."""
    face = torch.randint(0, len(faces), (count,))
    bary = torch.rand(count, 3, dtype=verts.dtype)
    bary = bary / bary.sum(-1, keepdim=True)
    shift = (2 * torch.rand(count, 1, 1, dtype=verts.dtype) - 1) * reach
    corners = verts[faces[face]] + shift * vertex_normals(verts, faces)[faces[face]]
    return (bary[..., None] * corners).sum(1)


def share(mask: Tensor) -> float:
    """Part of the elements that are True."""
    return mask.double().mean().item()
