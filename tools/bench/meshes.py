"""Finer versions of a body, to see how cost grows with the mesh."""

import dataclasses

import torch
from torch import Tensor

from monopart.geometry.body import BodyModel
from monopart.geometry.uv import UVMap


def subdivided(body: BodyModel) -> BodyModel:
    """A body with every triangle cut into four; it moves as the given one does at its vertices."""
    edges = torch.cat([body.faces[:, [0, 1]], body.faces[:, [1, 2]], body.faces[:, [2, 0]]])
    unique, inverse = edges.sort(1).values.unique(dim=0, return_inverse=True)
    ab, bc, ca = (inverse + body.num_verts).view(3, -1).unbind(0)
    a, b, c = body.faces.unbind(1)
    rows = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    faces = torch.stack([torch.stack(row, -1) for row in rows], 1).flatten(0, 1)

    def grown(values: Tensor) -> Tensor:
        return torch.cat([values, values[unique].mean(1)])

    uv = None
    if body.uv is not None:
        u, v, w = body.uv.corner_uv.unbind(1)
        uv_ab, uv_bc, uv_ca = (u + v) / 2, (v + w) / 2, (w + u) / 2
        corners = [(u, uv_ab, uv_ca), (uv_ab, v, uv_bc), (uv_ca, uv_bc, w), (uv_ab, uv_bc, uv_ca)]
        uv = UVMap(torch.stack([torch.stack(row, 1) for row in corners], 1).flatten(0, 1))
    extra = body.joint_regressor.new_zeros(body.num_joints, len(unique))
    return dataclasses.replace(
        body,
        v_template=grown(body.v_template),
        faces=faces,
        weights=grown(body.weights),
        joint_regressor=torch.cat([body.joint_regressor, extra], 1),
        shapedirs=grown(body.shapedirs),
        posedirs=grown(body.posedirs),
        uv=uv,
    )
