"""Pose features ask a table of appearance codes: cross-attention per part (MonoPartNeRF, eq. 6)."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from monopart.geometry.errors import BackendError, InputError

from .backend import Backend, choose_backend
from .mlp import PartMLP


class CodeFusion(torch.nn.Module):
    """Multi-head cross-attention of samples over the appearance codes of their part.

    The codes of a part are a set: every sample sees all of them. Keys and values are made once
    per call. A bias of the keys would cancel in the softmax and one of the values is a bias of the
    output, so neither exists.

    Attributes:
        codes: [K, N, L] appearance codes (``rgb_latent``).
        to_keys: [K, L, D].
        to_values: [K, L, D].
        query: network that makes queries.
        out: network that makes features from what the heads found.

    Reference: MonoPartNeRF, section 3.3, F_k.

    >>> fusion = CodeFusion(parts=2, inputs=60)
    >>> fusion(torch.rand(5, 60), (2, 3)).shape
    torch.Size([5, 16])
    """

    def __init__(
        self,
        parts: int,
        inputs: int,
        codes: int = 100,
        length: int = 8,
        heads: int = 4,
        width: int = 32,
        outputs: int = 16,
    ) -> None:
        """Make codes and projections.

        Args:
            parts: number of parts.
            inputs: length of a pose feature.
            codes: codes of a part.
            length: length of a code.
            heads: heads of the attention.
            width: length of queries, keys and values, all heads together.
            outputs: length of the result.

        Raises:
            InputError: a size below 1, or a width that the heads do not divide.
        """
        super().__init__()
        if min(parts, inputs, codes, length, heads, width, outputs) < 1 or width % heads:
            raise InputError(
                f"CodeFusion: expected sizes ≥ 1 and a width that {heads} heads divide, found "
                f"parts {parts}, inputs {inputs}, codes {codes}, length {length}, width {width}, "
                f"outputs {outputs}"
            )
        self.heads = heads
        self.codes = torch.nn.Parameter(torch.randn(parts, codes, length))
        bound = 1 / math.sqrt(length)
        self.to_keys, self.to_values = (
            torch.nn.Parameter((torch.rand(parts, length, width) * 2 - 1) * bound) for _ in range(2)
        )
        self.query = PartMLP(parts, (inputs, width))
        self.out = PartMLP(parts, (width, outputs))

    @property
    def out_features(self) -> int:
        """Columns of the result."""
        return self.out.widths[-1]

    def forward(self, pose: Float[Tensor, "n p"], counts: Sequence[int]) -> Float[Tensor, "n o"]:
        """Fused features of samples sorted by part.

        Args:
            pose: pose features.
            counts: rows of each part.

        Returns:
            Features; differentiable in the pose features and all parameters.

        Raises:
            InputError: counts that do not fit.
        """
        query = self.query(pose, counts).unflatten(1, (self.heads, -1))
        keys = (self.codes @ self.to_keys).unflatten(2, (self.heads, -1))
        values = (self.codes @ self.to_values).unflatten(2, (self.heads, -1))
        return self.out(attend(query, keys, values, counts).flatten(1), counts)


def attend(
    query: Float[Tensor, "n h d"],
    keys: Float[Tensor, "k c h d"],
    values: Float[Tensor, "k c h d"],
    counts: Sequence[int],
    backend: Backend = "auto",
) -> Float[Tensor, "n h d"]:
    """Scaled dot-product attention of rows sorted by part over the set of their part.

    Args:
        query: queries per head.
        keys: keys of each part.
        values: values of each part.
        counts: rows of each part.
        backend: ``warp`` (float32, one derivative), ``torch`` (any dtype, any order), ``auto``:
            warp on the CPU, on CUDA torch, whose matrix products serve it there.

    Raises:
        InputError: counts that do not fit.
        BackendError: ``warp`` asked for and not able to run.

    Returns:
        Per head the mean of the values, weighted by the softmax of query · key / √d.

    >>> one = torch.ones(1, 1, 2, 3)
    >>> attend(torch.rand(4, 2, 3), one, 5 * one, (4,)).unique().tolist()
    [5.0]
    """
    if len(counts) != len(keys) or sum(counts) != len(query) or min(counts, default=0) < 0:
        raise InputError(
            f"attend counts: expected {len(keys)} numbers that add up to {len(query)} rows, found "
            f"{tuple(counts)}"
        )
    if backend == "auto" and query.device.type == "cuda":
        backend = "torch"
    if choose_backend(backend, query) == "warp":
        return _WarpAttention.apply(query, keys, values, tuple(counts))
    scale = 1 / math.sqrt(query.shape[-1])
    found = []
    for q, k, v in zip(query.split(list(counts)), keys, values, strict=True):
        score = torch.einsum("nhd,chd->hnc", q, k) * scale
        found.append(torch.einsum("hnc,chd->nhd", score.softmax(-1), v))
    return torch.cat(found)


_LANES = 16  # codes that the kernels take at once
_NEVER = -1e30  # score of a padded code


class _WarpAttention(torch.autograd.Function):
    """Attention and its first derivative on the Warp kernels."""

    @staticmethod
    def forward(
        ctx: Any, query: Tensor, keys: Tensor, values: Tensor, counts: tuple[int, ...]
    ) -> Tensor:
        from monopart.geometry.kernels.launch import launch, view

        from .kernels.fusion import attention_kernel

        query = query.contiguous()
        rows, heads, dim = query.shape
        codes = keys.shape[1]
        missing = -codes % _LANES
        # [part, head, d, code]
        keys, values = (
            functional.pad(x.permute(0, 2, 3, 1), (0, missing)).contiguous() for x in (keys, values)
        )
        bias = functional.pad(query.new_zeros(codes), (0, missing), value=_NEVER)
        ends = torch.tensor(list(itertools.accumulate(counts)), dtype=torch.int32)
        sets = (ends.to(query.device), query, keys, values, bias)
        out, total = torch.empty_like(query), query.new_empty(rows, heads, 2)
        args = [1 / math.sqrt(dim), *(view(x.view(-1)) for x in (*sets, out, total))]
        launch(attention_kernel(heads, dim, codes + missing), rows, args, query)
        ctx.save_for_backward(*sets, out, total)
        ctx.codes = codes
        return out

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise BackendError(
                "attend: the warp back end has no second derivative (create_graph=True); "
                "pass backend='torch'"
            )
        from monopart.geometry.kernels.launch import launch_jobs, view

        from .kernels.fusion import attention_gradient_kernel

        _, query, keys, values, *_ = saved = ctx.saved_tensors
        rows, heads, dim = query.shape
        cotangent = cotangents[0].contiguous()
        grads = [torch.zeros_like(x) for x in (query, keys, values)]
        args = [1 / math.sqrt(dim), *(view(x.view(-1)) for x in (*saved, cotangent))]
        places = [view(x.view(-1)) for x in grads]
        # disjoint heads per job: no atomics, and the same sums for any number of threads
        jobs = 1 if query.device.type == "cuda" else min(heads, torch.get_num_threads())
        launch_jobs(
            attention_gradient_kernel(heads, dim, keys.shape[-1]),
            [[*args, job, jobs, *places] for job in range(jobs)],
            rows,
            query,
        )
        by_code = (g[..., : ctx.codes].permute(0, 3, 1, 2) for g in grads[1:])
        return grads[0], *by_code, None
