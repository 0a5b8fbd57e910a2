"""Pose features of canonical points: blended line banks of key poses (MonoPartNeRF, eq. 5)."""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from monopart.geometry.errors import BackendError, InputError
from monopart.geometry.index_checks import check_indices

from .backend import Backend, choose_backend
from .hash_grid import zeros_of

_INIT = 0.1


class PoseBank(torch.nn.Module):
    """Learnable lines of features, one per part, key pose and canonical axis.

    A point is looked up on the three lines of its part, linearly between the knots, and the lines
    are those of the pose of its body: a weighted mean of the lines of some key poses. Key poses
    start equal, so that a blend of them starts as each of them.

    Attributes:
        lines: [K, Q, 3, R, C] features of K parts, Q key poses, 3 axes and R knots.

    Reference: MonoPartNeRF, section 3.3, P_k.

    >>> bank = PoseBank(torch.zeros(2, 3), torch.ones(2, 3), poses=4, knots=8, channels=5)
    >>> rows, weights = torch.tensor([[[0, 3], [1, 2]]]), torch.full((1, 2, 2), 0.5)
    >>> bank(torch.rand(6, 3), torch.tensor([0, 0, 1, 1, 1, 1]), None, rows, weights).shape
    torch.Size([6, 15])
    """

    lo: Tensor
    extent: Tensor

    def __init__(
        self,
        lo: Float[Tensor, "k 3"],
        hi: Float[Tensor, "k 3"],
        poses: int,
        knots: int = 128,
        channels: int = 20,
        generator: torch.Generator | None = None,
    ) -> None:
        """Make the lines.

        Args:
            lo: lower corners of the parts' canonical boxes, metres.
            hi: upper corners, beyond the lower ones.
            poses: number of key poses.
            knots: values along an axis.
            channels: features of a line.
            generator: source of the initial values; the global one if None.

        Raises:
            InputError: no key pose, fewer than two knots, no channel or a box without extent.
        """
        super().__init__()
        if poses < 1 or knots < 2 or channels < 1:
            raise InputError(
                f"PoseBank: expected poses ≥ 1, knots ≥ 2 and channels ≥ 1, found {poses}, {knots} "
                f"and {channels}"
            )
        if not bool((hi > lo).all()):
            raise InputError("PoseBank lo, hi: expected hi > lo on every axis; check the boxes")
        self.register_buffer("lo", lo.clone(), persistent=False)
        self.register_buffer("extent", hi - lo, persistent=False)
        start = _INIT * torch.randn(len(lo), 1, 3, knots, channels, generator=generator)
        self.lines = torch.nn.Parameter(start.to(lo.dtype).repeat(1, poses, 1, 1, 1))

    @property
    def out_features(self) -> int:
        """Columns of the result, 3·C."""
        return 3 * self.lines.shape[-1]

    def extra_repr(self) -> str:
        """Sizes for ``print(module)``."""
        parts, poses, _, knots, channels = self.lines.shape
        return f"{parts=}, {poses=}, {knots=}, {channels=}"

    def blend(
        self, rows: Int[Tensor, "b k n"], weights: Float[Tensor, "b k n"]
    ) -> Float[Tensor, "k b 3 r c"]:
        """Lines of bodies: weighted means of those of key poses.

        Args:
            rows: key poses of each body and part.
            weights: their weights.

        Returns:
            One line per part, body and axis; differentiable in the lines and the weights.
        """
        parts, poses = self.lines.shape[:2]
        mix = weights.new_zeros(parts, len(rows), poses)
        mix = mix.scatter_add(2, rows.transpose(0, 1).long(), weights.transpose(0, 1))
        return (mix @ self.lines.flatten(2)).unflatten(2, self.lines.shape[2:])

    def forward(
        self,
        points: Float[Tensor, "n 3"],
        part: Int[Tensor, "n"],
        body: Int[Tensor, "n"] | None,
        rows: Int[Tensor, "b k m"],
        weights: Float[Tensor, "b k m"],
        backend: Backend = "auto",
    ) -> Float[Tensor, "n f"]:
        """Pose features of canonical points.

        Args:
            points: canonical points, metres; outside the box of their part the ends of the lines
                go on. Not differentiated.
            part: part of each point.
            body: body of each point; None is body 0.
            rows: key poses of each body and part.
            weights: their weights.
            backend: ``warp`` (float32, one derivative, in the lines alone), ``torch`` (any dtype,
                any order, also in the weights), ``auto``: warp where it serves.

        Returns:
            [N, 3·C] features, x before y before z; differentiable in the lines and the weights.

        Raises:
            InputError: rows and weights that do not fit the parts or each other.
            BackendError: ``warp`` asked for and not able to run.
        """
        self._check(part, rows, weights)
        last = self.lines.shape[3] - 1
        place = ((points.detach() - self.lo[part]) / self.extent[part]).clamp(0, 1) * last
        owner = torch.zeros_like(part) if body is None else body
        if backend == "auto" and weights.requires_grad:
            backend = "torch"
        if choose_backend(backend, self.lines) == "torch":
            return self._forward_torch(place, part, owner, rows, weights)
        if weights.requires_grad:
            raise BackendError(
                "backend 'warp': expected weights that need no gradient; pass backend='torch'"
            )
        if len(rows) == 1 and rows.shape[2] > 1:  # one body: its lines once, not for each point
            lines, first = self.blend(rows, weights), slice(0, 1)
            rows, weights = torch.zeros_like(rows[..., first]), torch.ones_like(weights[..., first])
            return _WarpBank.apply(lines, place, part, owner, rows, weights)
        return _WarpBank.apply(self.lines, place, part, owner, rows, weights)

    def _check(self, part: Tensor, rows: Tensor, weights: Tensor) -> None:
        parts, poses = self.lines.shape[:2]
        if rows.shape != weights.shape or rows.shape[1] != parts or rows.shape[2] < 1:
            raise InputError(
                f"PoseBank rows, weights: expected equal shapes [bodies, {parts}, 1 or more], "
                f"found {tuple(rows.shape)} and {tuple(weights.shape)}"
            )
        check_indices("PoseBank part", part, parts)
        check_indices("PoseBank rows", rows, poses)

    def _forward_torch(
        self, place: Tensor, part: Tensor, owner: Tensor, rows: Tensor, weights: Tensor
    ) -> Tensor:
        """Blend the lines of all bodies, then look up: the readable twin of the kernels."""
        cell = place.long().clamp(0, self.lines.shape[3] - 2)
        lines = self.blend(rows, weights)
        knots, channels = lines.shape[-2:]
        line = (part.long() * lines.shape[1] + owner.long())[:, None] * 3
        at = (line + torch.arange(3, device=line.device)) * knots + cell
        table = lines.reshape(-1, channels)
        # index_select: the gradient of [] adds up in an order that changes with two threads
        near = table.index_select(0, at.flatten()).view(-1, 3, channels)
        far = table.index_select(0, at.flatten() + 1).view(-1, 3, channels)
        return torch.lerp(near, far, (place - cell)[..., None]).flatten(1)


class _WarpBank(torch.autograd.Function):
    """Look-up on blended lines and its derivative in the lines on the Warp kernels."""

    @staticmethod
    def forward(
        ctx: Any,
        lines: Tensor,
        place: Tensor,
        part: Tensor,
        owner: Tensor,
        rows: Tensor,
        weights: Tensor,
    ) -> Tensor:
        from monopart.geometry.kernels.launch import launch, view

        from .kernels.pose_bank import bank_kernel

        parts, poses, _, knots, channels = lines.shape
        lines, count = lines.contiguous(), rows.shape[2]
        shape = torch.tensor([poses, knots, parts], dtype=torch.int32).to(lines.device)
        part, owner, rows = (x.to(torch.int32).contiguous() for x in (part, owner, rows))
        saved = (place.contiguous().view(-1), part, owner, rows.view(-1, count))
        saved = (*saved, weights.to(lines.dtype).contiguous().view(-1), shape)
        out = lines.new_empty(len(part), 3 * channels)
        args = [view(x) for x in (*saved, lines.view(-1), out.view(-1))]
        launch(bank_kernel(channels), len(part), args, lines)
        ctx.save_for_backward(*saved)
        ctx.size = lines.shape
        return out

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise BackendError(
                "pose bank: the warp back end has no second derivative (create_graph=True); "
                "pass backend='torch'"
            )
        from monopart.geometry.kernels.launch import launch_jobs, view

        from .kernels.pose_bank import bank_gradient_kernel

        cotangent = cotangents[0].contiguous()
        grad = zeros_of(ctx.size, cotangent)
        args = [view(x) for x in (*ctx.saved_tensors, cotangent.view(-1))]
        # disjoint key poses per job: no atomics, and the same sums for any number of threads
        jobs = 1 if grad.device.type == "cuda" else torch.get_num_threads()
        launch_jobs(
            bank_gradient_kernel(ctx.size[-1]),
            [[*args, job, jobs, view(grad.view(-1))] for job in range(jobs)],
            len(cotangent),
            grad,
        )
        return grad, *(None,) * 5
