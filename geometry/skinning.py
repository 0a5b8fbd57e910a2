"""Linear blend skinning and its inverse for known weights."""

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .backend import Backend, choose_backend
from .errors import BackendError, InputError
from .rigid import append_last_row, apply_linear, invert_linear, transform_points

_RUN = 64  # pairs summed at once: enough work for a thread, and little rounding
_FEW_RUNS = 128  # fewer runs stay on one thread


class _Lists(NamedTuple):
    """The non-zero weights by vertex, and by joint in runs of at most `_RUN`; all int32."""

    starts: Tensor  # N + 1: first entry of each vertex
    joints: Tensor  # joint of each entry
    weights: Tensor  # its weight
    run_starts: Tensor  # S + 1: first pair of each run
    verts: Tensor  # vertex of each pair, ascending in a joint
    run_weights: Tensor  # its weight
    joint_runs: Tensor  # J + 1: first run of each joint


@dataclass(frozen=True, eq=False)
class SkinWeights:
    """Skinning weights and, once a kernel needs them, the lists of those that are not zero."""

    dense: Float[Tensor, "N J"]
    """Weights; rows sum to 1. Must not change in place after the first use."""

    @functools.cached_property
    def _lists(self) -> _Lists:
        weights = self.dense.detach()
        vertex, joint = weights.nonzero().unbind(1)  # sorted by vertex
        order = joint.argsort(stable=True)
        counts = torch.bincount(joint, minlength=weights.shape[1]).tolist()
        runs, joint_runs, first = [0], [0], 0
        for count in counts:
            runs += [first + min(at + _RUN, count) for at in range(0, count, _RUN)]
            joint_runs.append(len(runs) - 1)
            first += count
        starts = torch.searchsorted(vertex, torch.arange(len(weights) + 1, device=vertex.device))
        values = weights[vertex, joint]

        def whole(numbers: Tensor | list[int]) -> Tensor:
            return torch.as_tensor(numbers, dtype=torch.int32, device=weights.device).contiguous()

        by_vertex = (whole(starts), whole(joint), values.contiguous())
        by_run = (whole(runs), whole(vertex[order]), values[order].contiguous())
        return _Lists(*by_vertex, *by_run, whole(joint_runs))


def blend_transforms(
    transforms: Float[Tensor, "*b J 4 4"], weights: Float[Tensor, "N J"]
) -> Float[Tensor, "*b N 4 4"]:
    """Weighted sums of joint transforms: affine maps, in general not rigid.

    Args:
        transforms: joint transforms with last row (0, 0, 0, 1), (*b, J, 4, 4).
        weights: skinning weights, (N, J); each row must sum to 1, for the last row of the result
            is set to (0, 0, 0, 1) and not summed.

    Returns:
        Blended maps, (*b, N, 4, 4); differentiable in both.

    Reference:
        Loper et al. 2015 (SMPL), equation 2.

    >>> blend_transforms(torch.eye(4)[None], torch.ones(2, 1)).shape
    torch.Size([2, 4, 4])
    """
    flat = transforms[..., :3, :].flatten(-2)
    return append_last_row((weights @ flat).unflatten(-1, (3, 4)))


def skin(
    points: Float[Tensor, "*b N 3"], blended: Float[Tensor, "*b N 4 4"]
) -> Float[Tensor, "*b N 3"]:
    """Move rest points by their blended maps: x = A p.

    Args:
        points: points of the rest pose in metres, (*b, N, 3).
        blended: their maps from `blend_transforms`, (*b, N, 4, 4).

    Returns:
        Posed points in metres, (*b, N, 3); differentiable in both.

    >>> skin(torch.ones(2, 3), torch.eye(4).expand(2, 4, 4)).tolist()
    [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]
    """
    return transform_points(blended, points)


def blend_skin(
    points: Float[Tensor, "*#b N 3"],
    transforms: Float[Tensor, "*#b J 4 4"],
    weights: SkinWeights,
    backend: Backend = "auto",
) -> Float[Tensor, "*b N 3"]:
    """Linear blend skinning in one step: `skin` of `blend_transforms`, without the blended maps.

    Args:
        points: points of the rest pose in metres, (*b, N, 3).
        transforms: joint transforms with last row (0, 0, 0, 1), (*b, J, 4, 4).
            Batches of 1 are expanded to the other's.
        weights: skinning weights; joints of weight 0 are passed over, exactly.
        backend: ``warp`` (float32, one derivative, no gradient in the weights, no `torch.func`
            transforms), ``torch`` (any dtype, any order), ``auto``.

    Returns:
        Posed points in metres, (*b, N, 3); differentiable in points and transforms, and in the
        weights where they require a gradient (``auto`` is torch then).

    Raises:
        InputError: points or transforms do not fit the weights.
        BackendError: ``warp`` asked for and not able to run.

    Reference:
        Loper et al. 2015 (SMPL), equation 2.

    >>> transforms = torch.eye(4)[None]
    >>> blend_skin(torch.ones(2, 3), transforms, SkinWeights(torch.ones(2, 1))).tolist()
    [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]
    """
    found = (points.shape[-2], transforms.shape[-3])
    if found != weights.dense.shape or points.dtype != transforms.dtype:
        raise InputError(
            f"skinning: expected {tuple(weights.dense.shape)} points and transforms (as the "
            f"weights) of one dtype, found {found}, {points.dtype} and {transforms.dtype}; pass "
            "the weights of these points"
        )
    chosen = choose_backend(backend, points)
    needs_weights = torch.is_grad_enabled() and weights.dense.requires_grad
    if backend == "warp" and needs_weights:
        raise BackendError(
            "skinning: the warp back end has no gradient in the weights; pass backend='torch'"
        )
    batch = torch.broadcast_shapes(points.shape[:-2], transforms.shape[:-3])
    points, transforms = points.expand(*batch, -1, -1), transforms.expand(*batch, -1, -1, -1)
    if chosen == "torch" or needs_weights:
        return skin(points, blend_transforms(transforms, weights.dense))
    return _WarpSkin.apply(points, transforms, weights._lists)


class _WarpSkin(torch.autograd.Function):
    """Blended and applied transforms and their first derivatives on the Warp kernels."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, transforms: Tensor, lists: _Lists) -> Tensor:
        points, transforms = points.contiguous(), transforms.contiguous()
        ctx.save_for_backward(points, transforms, *lists)
        return _each_vertex("skin_points", points, transforms, lists)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise BackendError(
                "skinning: the warp back end has no second derivative (create_graph=True); "
                "pass backend='torch'"
            )
        points, transforms, *saved = ctx.saved_tensors
        lists, cotangent = _Lists(*saved), cotangents[0].contiguous()
        grad_points = grad_transforms = None
        if ctx.needs_input_grad[0]:
            grad_points = _each_vertex("points_gradient", cotangent, transforms, lists)
        if ctx.needs_input_grad[1]:
            grad_transforms = _transforms_gradient(cotangent, points, transforms, lists)
        return grad_points, grad_transforms, None


def _each_vertex(kernel: str, vectors: Tensor, transforms: Tensor, lists: _Lists) -> Tensor:
    """Run a kernel that reads and writes one vector per body and vertex."""
    from .kernels import skin as kernels
    from .kernels.launch import launch, view

    result = torch.empty_like(vectors)
    weights = map(view, (lists.starts, lists.joints, lists.weights))
    args = [view(vectors.view(-1, 3), 3), view(transforms.view(-1, 4), 4), *weights]
    args += [transforms.shape[-3], view(result.view(-1, 3), 3)]
    launch(getattr(kernels, kernel), vectors.numel() // 3, args, vectors)
    return result


def _transforms_gradient(
    cotangent: Tensor, points: Tensor, transforms: Tensor, lists: _Lists
) -> Tensor:
    from .kernels import skin as kernels
    from .kernels.launch import launch, view

    grad = torch.empty_like(transforms)
    bodies, runs = transforms.shape[:-3].numel(), len(lists.run_starts) - 1
    sums = transforms.new_empty(bodies * runs * 3, 4)
    pairs = map(view, (lists.run_starts, lists.verts, lists.run_weights))
    args = [view(cotangent.view(-1, 3), 3), view(points.view(-1, 3), 3), *pairs]
    args += [points.shape[-2], view(sums, 4)]
    launch(kernels.run_sums, bodies * runs, args, points, smallest=_FEW_RUNS)
    args = [view(sums, 4), view(lists.joint_runs), runs, view(grad.view(-1, 4), 4)]
    launch(kernels.transforms_gradient, grad.numel() // 16, args, points)
    return grad


def unskin(
    points: Float[Tensor, "*b N 3"], blended: Float[Tensor, "*b N 4 4"], min_det: float = 1e-2
) -> tuple[Float[Tensor, "*b N 3"], Bool[Tensor, "*b N"]]:
    """Move posed points back by their blended maps: p = A⁻¹ x.

    Args:
        points: posed points in metres, (*b, N, 3).
        blended: their rest-to-posed maps, (*b, N, 4, 4).
        min_det: smallest |determinant| of the 3×3 part that counts as invertible.

    Returns:
        Rest points in metres (*b, N, 3) and the mask of points whose map is invertible (*b, N);
        an invalid point is only shifted (or returned as it is where its map is not finite).
        Differentiable in both.

    >>> unskin(torch.ones(1, 3), torch.eye(4)[None])[0].tolist()
    [[1.0, 1.0, 1.0]]
    """
    # the translation is taken off first: inverting it with the rest would cancel large terms
    offset = blended[..., :3, 3]
    finite = offset.isfinite().all(-1)
    offset = torch.where(finite[..., None], offset, torch.zeros_like(offset))
    inverse, valid = invert_linear(blended[..., :3, :3], min_det)
    return apply_linear(inverse, points - offset), valid & finite
