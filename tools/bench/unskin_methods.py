"""Inverse skinning: the methods of `monopart.geometry.unskin`, classical ones among them."""

import importlib.util
import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .bodies import SurfaceData, barycentrics, closest_exact
from .registry import Method, load

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


def _method(name: str, **options: Any) -> Callable[[Any], Callable[[], Any]]:
    def prepare(data: SurfaceData) -> Callable[[], Any]:
        solve = load(_MODULE).inverse_skin
        given = {"method": name, "rest_verts": data.rest} | options
        return lambda: solve(data.points, data.posed, data.body, **given)

    return prepare


def unskin_methods() -> tuple[Method, ...]:
    """The methods, the classical ones in batched torch; ratios refer to the first one."""
    one, many = _needs(), _needs("starts")
    return (
        Method("newton (default)", _method("newton"), ours=True, needs=one),
        Method("newton, 1 start", _method("newton", starts=1), ours=True, needs=many),
        Method("newton, 3 starts", _method("newton", starts=3), ours=True, needs=many),
        Method("broyden, 1 start", _method("broyden", starts=1), needs=many),
        Method(f"broyden, {STARTS} starts", _method("broyden", starts=STARTS), needs=many),
        Method("fixed point", _method("fixed_point"), needs=one),
        Method("closest surface", _method("surface"), needs=one),
        Method("nearest vertex", _method("nearest"), needs=one),
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
        "reported ≤ 1 mm": float((result.residual <= 1e-3).double().mean() * 100),
    }
