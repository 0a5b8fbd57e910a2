"""Compositing along rays: packed samples, and the dense reference."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from monopart.geometry.errors import BackendError, InputError

from .backend import Backend, choose_backend

# beyond these nothing is seen to change, and infinities would turn into NaN
_MAX_SIGMA = 1e30
_MAX_OPTICAL = 1000.0  # exp(-1000) is 0 in float64 too


@dataclass(frozen=True)
class Composite:
    """What rays see, over black: the caller adds ``background * (1 - opacity)``."""

    color: Float[Tensor, "*r 3"]
    """Σ w c."""
    opacity: Float[Tensor, "*r"]
    """Σ w, in [0, 1]."""
    depth: Float[Tensor, "*r"] | None
    """Σ w depth (not divided by the opacity), or None where no depth was given."""
    weights: Float[Tensor, "*m"]
    """w = T α per sample."""


def composite_dense(
    sigma: Float[Tensor, "*r s"],
    color: Float[Tensor, "*r s 3"],
    delta: Float[Tensor, "*r s"],
    depth: Float[Tensor, "*r s"] | None = None,
    stop: float = 0.0,
) -> Composite:
    """Composite rays that all have S samples, front to back; the reference of :func:`composite`.

    α = 1 − exp(−σΔ), T = Π (1 − α) over the samples in front, w = T α.

    Args:
        sigma: density ≥ 0 per metre; infinity is opaque.
        color: [..., S, 3].
        delta: length Δ ≥ 0 of each sample, metres, finite.
        depth: metres along the ray.
        stop: samples with T ≤ stop count as nothing; changes opacity and colours in [0, 1] by at
            most ``stop``. 0 is exact.

    Returns:
        The composite, weights [..., S]; differentiable to any order in all tensors.

    Reference: Max, Optical models for direct volume rendering, 1995.

    >>> one = torch.ones(1, 1)
    >>> composite_dense(torch.inf * one, one[..., None].expand(1, 1, 3), one).opacity
    tensor([1.])
    """
    optical = (sigma.clamp(max=_MAX_SIGMA) * delta).clamp(max=_MAX_OPTICAL)
    in_front = optical.cumsum(-1)[..., :-1]
    in_front = torch.cat((torch.zeros_like(optical[..., :1]), in_front), dim=-1)
    transmittance = torch.exp(-in_front)
    weights = torch.where(transmittance > stop, transmittance * -torch.expm1(-optical), 0.0)
    return Composite(
        color=(weights[..., None] * color).sum(-2),
        opacity=weights.sum(-1),
        depth=None if depth is None else (weights * depth).sum(-1),
        weights=weights,
    )


def composite(
    sigma: Float[Tensor, "m"],
    color: Float[Tensor, "m 3"],
    delta: Float[Tensor, "m"],
    ray_start: Int[Tensor, "r1"],
    depth: Float[Tensor, "m"] | None = None,
    backend: Backend = "auto",
    stop: float = 0.0,
) -> Composite:
    """Composite rays with any number of samples each, front to back.

    α = 1 − exp(−σΔ), T = Π (1 − α) over the samples in front, w = T α. A ray without samples is 0.

    Args:
        sigma: [M] density ≥ 0 per metre; infinity is opaque.
        color: [M, 3].
        delta: [M] length Δ ≥ 0 of each sample, metres, finite.
        ray_start: [R + 1]; the samples of ray r are the rows ray_start[r] … ray_start[r + 1] − 1.
        depth: [M] metres along the ray.
        backend: ``warp`` (float32, one derivative), ``torch`` (any dtype, any order), ``auto``.
        stop: samples with T ≤ stop count as nothing; changes opacity and colours in [0, 1] by at
            most ``stop``. 0 is exact.

    Returns:
        The composite, weights [M]; differentiable through all its fields in sigma, color and delta,
        and in depth on torch.

    Raises:
        InputError: ``ray_start`` does not cut M samples into rays (checked on the CPU).
        BackendError: ``warp`` asked for and not able to run.

    Reference: Max, Optical models for direct volume rendering, 1995.

    >>> start = torch.tensor([0, 2, 2])
    >>> composite(torch.ones(2), torch.ones(2, 3), torch.ones(2), start).opacity
    tensor([0.8647, 0.0000])
    """
    _check_ray_start(ray_start, len(sigma))
    ray_start = ray_start.to(torch.int64)
    same = {t.dtype for t in (sigma, color, delta, depth) if t is not None}
    if len(same) > 1:
        raise InputError(f"composite: expected one dtype, found {sorted(map(str, same))}")
    chosen = choose_backend(backend, sigma)
    if chosen == "warp" and depth is not None and depth.requires_grad:
        if backend == "warp":
            raise BackendError(
                "composite: the warp back end has no gradient in depth; pass backend='torch'"
            )
        chosen = "torch"
    if chosen == "torch":
        return _composite_padded(sigma, color, delta, ray_start, depth, stop)
    results = _WarpComposite.apply(sigma, color, delta, depth, ray_start, stop)
    return Composite(results[0], results[1], None if depth is None else results[2], results[3])


def _check_ray_start(ray_start: Tensor, samples: int) -> None:
    if len(ray_start) == 0:
        raise InputError("composite ray_start: expected rays + 1 numbers, found none")
    if ray_start.device.type != "cpu":  # a look would wait for the device
        return
    first, last = int(ray_start[0]), int(ray_start[-1])
    if first != 0 or last != samples or bool((ray_start.diff() < 0).any()):
        raise InputError(
            f"composite ray_start: expected ascending numbers from 0 to {samples} (samples), "
            f"found {first} … {last}"
        )


def _composite_padded(
    sigma: Tensor,
    color: Tensor,
    delta: Tensor,
    ray_start: Tensor,
    depth: Tensor | None,
    stop: float,
) -> Composite:
    """Pad all rays to the longest and use the dense reference."""
    counts = ray_start.diff()
    rays, longest = len(counts), int(counts.max()) if len(counts) else 0
    ray = torch.repeat_interleave(torch.arange(rays, device=sigma.device), counts)
    index = (ray, torch.arange(len(sigma), device=sigma.device) - ray_start[ray])

    def pad(values: Tensor) -> Tensor:
        return values.new_zeros(rays, longest, *values.shape[1:]).index_put(index, values)

    dense = composite_dense(
        pad(sigma), pad(color), pad(delta), None if depth is None else pad(depth), stop
    )
    return Composite(dense.color, dense.opacity, dense.depth, dense.weights[index])


class _WarpComposite(torch.autograd.Function):
    """Compositing and its first derivative on the Warp kernels."""

    @staticmethod
    def forward(
        ctx: Any,
        sigma: Tensor,
        color: Tensor,
        delta: Tensor,
        depth: Tensor | None,
        ray_start: Tensor,
        stop: float,
    ) -> tuple[Tensor, ...]:
        from monopart.geometry.kernels.launch import launch, view

        from .kernels.volume import composite_forward

        sigma, color, delta = sigma.contiguous(), color.contiguous(), delta.contiguous()
        depth = sigma.new_zeros(0) if depth is None else depth.contiguous()
        ray_start = ray_start.contiguous()
        rays = len(ray_start) - 1
        ray_color, ray_opacity = sigma.new_empty(rays, 3), sigma.new_empty(rays)
        ray_depth = sigma.new_empty(rays)
        weights, behind = torch.empty_like(sigma), torch.empty_like(sigma)
        args = [view(sigma), view(color, 3), view(delta), view(depth), view(ray_start), stop]
        args += [view(ray_color, 3), view(ray_opacity), view(ray_depth), view(weights)]
        launch(composite_forward, rays, [*args, view(behind)], sigma)
        ctx.save_for_backward(sigma, color, delta, depth, ray_start, weights, behind)
        return ray_color, ray_opacity, ray_depth, weights

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        from monopart.geometry.kernels.launch import launch, view

        from .kernels.volume import composite_backward

        if torch.is_grad_enabled():
            raise BackendError(
                "composite: the warp back end has no second derivative (create_graph=True); "
                "pass backend='torch'"
            )
        sigma, color, delta, depth, ray_start, weights, behind = ctx.saved_tensors
        of_color, *others = [cotangent.contiguous() for cotangent in cotangents]
        grad_optical, grad_color = torch.empty_like(sigma), torch.empty_like(color)
        args = [view(color, 3), view(depth), view(ray_start), view(weights), view(behind)]
        args += [view(of_color, 3), *map(view, others), view(grad_optical), view(grad_color, 3)]
        launch(composite_backward, len(ray_start) - 1, args, sigma)
        grad_delta = None
        if ctx.needs_input_grad[2]:
            grad_delta = grad_optical * sigma.clamp(max=_MAX_SIGMA)
        return grad_optical * delta, grad_color, grad_delta, None, None, None
