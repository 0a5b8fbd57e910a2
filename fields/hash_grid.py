"""Multiresolution hash grids, one per part, in a single table."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from monopart.geometry.errors import BackendError, InputError
from monopart.geometry.index_checks import check_indices

from .backend import Backend, choose_backend

PRIMES = (1, 2654435761, 805459861)
WARP_FEATURES = (1, 2, 4)  # the kernels read a table row as one vector
_INIT = 1e-4


@dataclass(frozen=True)
class GridSpec:
    """Shape of one multiresolution grid over the unit cube.

    Reference: Müller et al., Instant Neural Graphics Primitives, 2022, section 3.
    """

    levels: int
    """Number of resolutions."""
    features: int
    """Features per level; the Warp kernels serve 1, 2 and 4."""
    log2_size: int
    """A level holds at most 2**log2_size rows."""
    base: int
    """Cells per axis of the first level."""
    growth: float
    """Ratio of the resolutions of neighbouring levels."""

    def __post_init__(self) -> None:
        """Refuse shapes that no table can hold."""
        low = {"levels": 1, "features": 1, "log2_size": 3, "base": 1, "growth": 1.0}
        for name, least in low.items():
            if not getattr(self, name) >= least:
                found = getattr(self, name)
                raise InputError(f"GridSpec.{name}: expected at least {least}, found {found}")
        if self.log2_size > 28 or max(self.resolutions) >= 2**24:
            raise InputError(
                f"GridSpec: expected log2_size ≤ 28 and a last level under 2**24 cells, found "
                f"{self.log2_size} and {max(self.resolutions)}; lower log2_size or growth"
            )

    @property
    def resolutions(self) -> tuple[int, ...]:
        """Cells per axis of each level, floor(base·growth^l)."""
        # the tolerance lets growth = (last / base)**(1 / (levels - 1)) reach `last`
        return tuple(
            math.floor(self.base * self.growth**level + 1e-6) for level in range(self.levels)
        )

    @property
    def sizes(self) -> tuple[int, ...]:
        """Rows of each level: dense where (resolution + 1)³ fits, else 2**log2_size."""
        return tuple(min((r + 1) ** 3, 2**self.log2_size) for r in self.resolutions)

    @property
    def dense(self) -> tuple[bool, ...]:
        """Which levels are stored without hashing."""
        return tuple((r + 1) ** 3 <= 2**self.log2_size for r in self.resolutions)


class HashGrid(torch.nn.Module):
    """Hash grids of K parts that share levels and features, in one flat parameter.

    Attributes:
        table: [total, F] features; the rows of part k and level l start at ``offsets[k, l]``.
        offsets: [K, L] int32, first row.
        sizes: [K, L] int32, rows.
        masks: [K, L] int32, ``sizes − 1`` of a hashed level, 0 of a dense one.
        resolutions: [K, L] int32, cells per axis.
        accumulate: the Warp backward pass adds to ``table.grad`` in place in place of handing a
            new gradient of the whole table to autograd, for an optimiser that zeroes what it used
            (:class:`RowAdam`). ``torch.autograd.grad`` then finds none for the table.
        deterministic: on CUDA the backward pass sorts the gradient of the table by row and sums it
            in one order, in place of atomic sums whose order, and so rounding, changes from run to
            run; slower. The CPU always sums in one order.

    Reference: Müller et al., Instant Neural Graphics Primitives, 2022, section 3.

    >>> grid = HashGrid([GridSpec(levels=4, features=2, log2_size=10, base=4, growth=1.5)])
    >>> grid(torch.rand(5, 3), None).shape
    torch.Size([5, 8])
    """

    offsets: Tensor
    sizes: Tensor
    masks: Tensor
    resolutions: Tensor

    def __init__(self, specs: Sequence[GridSpec], generator: torch.Generator | None = None):
        """Build the tables, uniform in ±1e-4.

        Args:
            specs: one per part; levels and features must agree.
            generator: source of the initial values; the global one if None.

        Raises:
            InputError: no spec, or specs that disagree in levels or features.
        """
        super().__init__()
        specs = tuple(specs)
        if not specs:
            raise InputError("HashGrid specs: expected one per part, found none")
        shapes = {(spec.levels, spec.features) for spec in specs}
        if len(shapes) > 1:
            raise InputError(
                f"HashGrid specs: expected one (levels, features) for all parts, found "
                f"{sorted(shapes)}; vary log2_size, base or growth instead"
            )
        self.specs = specs
        ((self.levels, self.features),) = shapes
        sizes = torch.tensor([spec.sizes for spec in specs])
        total = int(sizes.sum())
        if total >= 2**31:
            raise InputError(f"HashGrid: expected under 2**31 rows, found {total}; lower log2_size")
        dense = torch.tensor([spec.dense for spec in specs])
        offsets = sizes.flatten().cumsum(0).view_as(sizes) - sizes
        masks = torch.where(dense, 0, sizes - 1)
        resolutions = torch.tensor([spec.resolutions for spec in specs])
        named = {"offsets": offsets, "sizes": sizes, "masks": masks, "resolutions": resolutions}
        for name, values in named.items():
            self.register_buffer(name, values.to(torch.int32), persistent=False)
        table = torch.rand(total, self.features, generator=generator)
        self.table = torch.nn.Parameter((table * 2 - 1) * _INIT)
        self.accumulate = False
        self.deterministic = False

    @property
    def out_features(self) -> int:
        """Columns of the result, L·F."""
        return self.levels * self.features

    def extra_repr(self) -> str:
        """Sizes for ``print(module)``."""
        rows = self.table.shape[0]
        return f"parts={len(self.specs)}, levels={self.levels}, features={self.features}, {rows=}"

    def forward(
        self,
        points: Float[Tensor, "n 3"],
        part: Int[Tensor, "n"] | None = None,
        backend: Backend = "auto",
    ) -> Float[Tensor, "n out"]:
        """Look up points, trilinearly per level.

        Args:
            points: [N, 3] in [0, 1]; outside is clamped and has gradient 0 on the clamped axes.
            part: [N] part of each point, int32 or int64; None means part 0 of a single part.
            backend: ``warp`` (float32, one derivative), ``torch`` (any dtype, any order), ``auto``.

        Returns:
            [N, L·F] features, level by level; differentiable in the table and, where
            ``points.requires_grad``, in the points.

        Raises:
            InputError: ``part`` missing for several parts, or out of range (checked on the CPU).
            BackendError: ``warp`` asked for and not able to run.
        """
        part = self._check_part(part)
        if points.dtype != self.table.dtype:
            raise InputError(
                f"HashGrid points: expected {self.table.dtype} as the table, found {points.dtype}"
            )
        if choose_backend(backend, points) == "torch":
            return self._forward_torch(points, part)
        if self.features in WARP_FEATURES:
            layout = (self.offsets, self.masks, self.resolutions)
            # a table put in by functional_call has no .grad of its own
            own = self.table if self.accumulate and self.table.is_leaf else None
            return _WarpHashGrid.apply(points, self.table, part, layout, own, self.deterministic)
        if backend == "auto":
            return self._forward_torch(points, part)
        raise BackendError(
            f"backend 'warp': expected {WARP_FEATURES} features per level, found {self.features}; "
            "pass backend='torch'"
        )

    def _check_part(self, part: Tensor | None) -> Tensor | None:
        parts = len(self.specs)
        if part is None:
            if parts > 1:
                raise InputError(f"HashGrid part: expected an index below {parts}, found None")
            return None
        check_indices("HashGrid part", part, parts)
        return part

    def _forward_torch(self, points: Tensor, part: Tensor | None) -> Tensor:
        """Look up all corners of all levels at once: the readable twin of the kernels."""
        out = points.new_zeros(())
        for row, share in _corners(points, part, (self.offsets, self.masks, self.resolutions)):
            out = out + share[..., None] * self.table[row]
        return out.flatten(1)


def _corners(
    points: Tensor, part: Tensor | None, layout: Sequence[Tensor]
) -> Iterator[tuple[Tensor, Tensor]]:
    """Table row [N, L] and weight [N, L] of each of the eight corners of the cells of points."""
    k = torch.zeros_like(points[:, 0], dtype=torch.long) if part is None else part.long()
    offset, mask, res = (values[k].long() for values in layout)
    position = points.clamp(0, 1)[:, None, :] * res[..., None]
    last = res[..., None] - 1  # 1 is in the last cell
    cell = position.detach().long().clamp_min(0).minimum(last)
    inside = position - cell
    for corner in ((x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)):
        far = torch.tensor(corner, device=points.device)
        u, v, w = torch.where(far == 1, inside, 1 - inside).unbind(-1)
        x, y, z = (cell + far).unbind(-1)
        hashed = ((x * PRIMES[0]) ^ (y * PRIMES[1]) ^ (z * PRIMES[2])) & mask
        direct = x + (res + 1) * (y + (res + 1) * z)
        yield offset + torch.where(mask == 0, direct, hashed), u * v * w


class _WarpHashGrid(torch.autograd.Function):
    """Look-up and its first derivative on the Warp kernels."""

    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        table: Tensor,
        part: Tensor | None,
        layout: tuple[Tensor, ...],
        own: Tensor | None,
        deterministic: bool,
    ) -> Tensor:
        from monopart.geometry.kernels.launch import launch, view, view_rows

        from .kernels.hash_grid import forward_kernel

        points, table = points.contiguous(), table.contiguous()
        part = layout[0].new_zeros(0) if part is None else part.to(torch.int32).contiguous()
        n, features = points.shape[0], table.shape[1]
        out = points.new_empty(n, layout[0].shape[1] * features)
        args = [view(points, 3), view(part), view_rows(table), *map(view, layout)]
        launch(forward_kernel(features), n, [*args, _level_rows(out, features)], points)
        ctx.save_for_backward(points, table, part, *layout)
        ctx.own = own
        ctx.sorts = deterministic and points.device.type == "cuda"
        return out

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise BackendError(
                "hash grid: the warp back end has no second derivative (create_graph=True); "
                "pass backend='torch'"
            )
        points, table, part, *layout = ctx.saved_tensors
        cotangent = cotangents[0].contiguous()
        saved = (points, table, part, layout, cotangent)
        grad_points = _points_gradient(*saved) if ctx.needs_input_grad[0] else None
        rest = (None, None, None, None)
        if not ctx.needs_input_grad[1]:
            return grad_points, None, *rest
        add = _add_sorted_gradient if ctx.sorts else _add_table_gradient
        if ctx.own is None:
            grad_table = zeros_of(table.shape, table)
            add(grad_table, *saved)
            return grad_points, grad_table, *rest
        if ctx.own.grad is None:
            ctx.own.grad = zeros_of(table.shape, table)
        add(ctx.own.grad, *saved)
        return grad_points, None, *rest


def _level_rows(values: Tensor, features: int) -> Any:
    """View [N, L·F] as [N, L] rows of F numbers."""
    from monopart.geometry.kernels.launch import view

    shape = (values.shape[0], values.shape[1] // features, features)
    return view(values.view(shape) if features > 1 else values, features)


def zeros_of(shape: Sequence[int], like: Tensor) -> Tensor:
    """Zeros of a large shape, with the dtype and on the device of a tensor.

    Args:
        shape: shape of the result.
        like: float32 or float64.

    Returns:
        Zeros.

    >>> zeros_of((2, 1), torch.zeros(0)).tolist()
    [[0.0], [0.0]]
    """
    if like.device.type != "cpu":
        return like.new_zeros(*shape)
    # numpy asks for huge pages: 5 ms in place of 30 for 50 MB
    kind = np.float32 if like.dtype == torch.float32 else np.float64
    return torch.from_numpy(np.zeros(tuple(shape), kind))


def _points_gradient(
    points: Tensor, table: Tensor, part: Tensor, layout: list[Tensor], cotangent: Tensor
) -> Tensor:
    from monopart.geometry.kernels.launch import launch, view, view_rows

    from .kernels.hash_grid import points_kernel

    features = table.shape[1]
    grad = torch.empty_like(points)
    args = [view(points, 3), view(part), view_rows(table), *map(view, layout)]
    args += [_level_rows(cotangent, features), view(grad, 3)]
    launch(points_kernel(features), len(points), args, points)
    return grad


def _add_table_gradient(
    grad: Tensor,
    points: Tensor,
    table: Tensor,
    part: Tensor,
    layout: list[Tensor],
    cotangent: Tensor,
) -> None:
    from monopart.geometry.kernels.launch import launch_jobs, view, view_rows

    from .kernels.hash_grid import table_kernel

    features, levels = table.shape[1], layout[0].shape[1]
    args = [view(points, 3), view(part), *map(view, layout), _level_rows(cotangent, features)]
    cuda = points.device.type == "cuda"
    # disjoint levels per job: no atomics, and the same sums for any number of threads
    jobs = 1 if cuda else min(levels, torch.get_num_threads())
    launch_jobs(
        table_kernel(features),
        [[*args, job, jobs, view_rows(grad)] for job in range(jobs)],
        len(points),
        points,
    )


def _add_sorted_gradient(
    grad: Tensor,
    points: Tensor,
    table: Tensor,
    part: Tensor,
    layout: list[Tensor],
    cotangent: Tensor,
) -> None:
    """As `_add_table_gradient`; on CUDA this sum of torch sorts by row and has one order."""
    by_level = cotangent.unflatten(1, (-1, table.shape[1]))
    for row, share in _corners(points, part if len(part) else None, layout):
        grad.index_put_((row,), share[..., None] * by_level, accumulate=True)
