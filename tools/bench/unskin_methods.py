"""Inverse skinning: the methods of `monopart.geometry.unskin`, classical ones among them."""

import importlib.util
import inspect
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.posed_parts import full_bary
from monopart.geometry.skinning_field import SkinningField
from monopart.geometry.surface import SurfaceHit

from .bodies import SurfaceData, barycentrics, closest_exact
from .registry import Method, load
from .warp_plain import PlainMesh

_MODULE = "monopart.geometry.unskin"
STARTS = 13
"""First guesses of the many-start scheme: one per bone, as Fast-SNARF does."""


def _needs(parameter: str | None = None) -> Callable[[], str | None]:
    """Absent while the module, or a parameter of the function, is."""

    def check() -> str | None:
        if importlib.util.find_spec(_MODULE) is None:
            return f"{_MODULE} is not part of this version"
        known = inspect.signature(load(_MODULE).inverse_skin).parameters
        if parameter is not None and parameter not in known:
            return f"inverse_skin has no parameter {parameter!r} in this version"
        return None

    return check


class PlainIndex:
    """Closest surface points by Warp's plain query, in the place of our `SurfaceIndex`."""

    def __init__(self, verts: Tensor, faces: Tensor) -> None:
        """Build Warp's tree.

        Args:
            verts: vertices [V, 3], metres.
            faces: vertex indices [F, 3].
        """
        self.verts, self.faces = verts, faces
        self.mesh = PlainMesh(verts.numpy(), faces.numpy(), verts[:1].numpy())

    def refit(self, verts: Tensor) -> None:
        """Follow moved vertices."""
        self.verts = verts
        self.mesh.update(verts.numpy())

    def query(self, points: Tensor, max_distance: float = math.inf) -> SurfaceHit:
        """As `SurfaceIndex.query`, without gradients."""
        face, two = (torch.from_numpy(a) for a in self.mesh.query_points(points.numpy()))
        bary = full_bary(two)
        face = face.long()
        point = (bary[..., None] * self.verts[self.faces[face]]).sum(1)
        distance = (points - point).norm(dim=-1)
        return SurfaceHit(face, bary, point, distance, distance <= max_distance)


def _plain_field(data: SurfaceData) -> SkinningField:
    """Our forward field on Warp's plain query: Broyden as one writes it without our tree."""
    field: Any = SkinningField(data.body, data.rest)
    field.index = PlainIndex(data.rest, data.faces)
    posed = PlainIndex(data.verts, data.faces)

    def posed_index(verts: Tensor) -> PlainIndex:
        posed.refit(verts)
        return posed

    field.posed_index = posed_index
    return field


def _method(name: str, **options: Any) -> Callable[[Any], Callable[[], Any]]:
    def prepare(data: SurfaceData) -> Callable[[], Any]:
        solve = load(_MODULE).inverse_skin
        given = {"method": name, "rest_verts": data.rest} | options
        if given.pop("plain", False):
            given["rest_verts"] = _plain_field(data)
        return lambda: solve(data.points, data.posed, data.body, **given)

    return prepare


def unskin_methods() -> tuple[Method, ...]:
    """The methods, the classical ones in batched torch; ratios refer to the first one."""
    one, many = _needs(), _needs("starts")
    return (
        Method("newton (default)", _method("newton"), ours=True, needs=one),
        Method("newton, 1 start", _method("newton", starts=1), ours=True, needs=many),
        Method("newton, 3 starts", _method("newton", starts=3), ours=True, needs=many),
        Method(f"newton, {STARTS} starts", _method("newton", starts=STARTS), ours=True, needs=many),
        Method("broyden on Warp's query, 1 start", _method("broyden", plain=True), needs=many),
        Method(
            f"broyden on Warp's query, {STARTS} starts",
            _method("broyden", starts=STARTS, plain=True),
            needs=many,
            rare=True,
        ),
        Method("broyden on our tree, 1 start", _method("broyden"), ours=True, needs=many),
        Method(
            f"broyden on our tree, {STARTS} starts",
            _method("broyden", starts=STARTS),
            ours=True,
            needs=many,
            rare=True,
        ),
        Method("fixed point", _method("fixed_point"), ours=True, needs=one),
        Method("closest surface", _method("surface"), ours=True, needs=one),
        Method("nearest vertex", _method("nearest"), needs=one, rare=True),
    )


def forward_again(data: SurfaceData, rest: Tensor) -> np.ndarray:
    """Rest points skinned with the weights of their closest point of the rest surface, float64."""
    body, posed = data.body, data.posed
    points, shaped, faces = rest.double().numpy(), data.rest.double().numpy(), body.faces.numpy()
    _, face, on = closest_exact(points, shaped, faces)
    bary = barycentrics(on, shaped[faces[face]])
    weights = (bary[..., None] * body.weights.double().numpy()[faces[face]]).sum(1)
    maps = np.einsum("nj,jab->nab", weights, posed.transforms.double().numpy())
    return np.einsum("nab,nb->na", maps[:, :3, :3], points) + maps[:, :3, 3]


def judge_unskin(data: SurfaceData, result: Any) -> dict[str, float]:
    """Cycle error: the distance between a point and its rest point skinned forward again."""
    rest = torch.nan_to_num(result.points.detach(), nan=9.0, posinf=9.0, neginf=9.0)
    gap = np.linalg.norm(forward_again(data, rest) - data.arrays[0], axis=1)
    return {
        "error": float(np.quantile(gap, 0.95)),
        "share": float((gap <= 1e-3).mean() * 100),
        "valid": float(result.valid.double().mean() * 100),
    }
