"""Adam for hash tables: only the rows that received a gradient are read and written."""

import functools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from monopart.geometry.errors import BackendError, InputError

from .backend import Backend, choose_backend

_LONGEST = 2048  # missed steps after which nothing is left of the moments (0.99^2048 = 1e-9)
_STATE = ("step", "mean", "square", "seen")
_WIDEST = 4  # columns that the kernel serves
_BLOCK = 4096  # rows of one work item on the CPU


@dataclass(frozen=True)
class AdamRule:
    """Constants of Adam.

    Attributes:
        betas: decay of the mean and of the mean square, per step.
        eps: added to the root mean square.

    Raises:
        InputError: betas outside [0, 1), or the first above the root of the second: the ratio of a
            resting row would grow with every missed step, and overflow.
    """

    betas: tuple[float, float] = (0.9, 0.99)
    eps: float = 1e-15

    def __post_init__(self) -> None:
        first, second = self.betas
        if not (0 <= first < 1 and 0 < second < 1 and first * first <= second):
            raise InputError(
                f"AdamRule betas: expected 0 <= first <= root of second < 1, found {self.betas}; "
                "use (0.9, 0.99)"
            )


@dataclass(frozen=True)
class RowMoments:
    """What Adam remembers of a table.

    Attributes:
        mean: [R, F] running mean of the gradient.
        square: [R, F] running mean square.
        seen: [R] int32, step at which a row was touched last; 0 is never.
    """

    mean: Float[Tensor, "r f"]
    square: Float[Tensor, "r f"]
    seen: Int[Tensor, "r"]


def row_adam(
    table: Float[Tensor, "r f"],
    grad: Float[Tensor, "r f"],
    moments: RowMoments,
    now: int,
    rate: float,
    rule: AdamRule,
    backend: Backend = "auto",
) -> None:
    """One step of Adam, in place, on the rows whose gradient is not zero, which it then zeroes.

    A row of zero gradient is not touched. Dense Adam would go on moving it by its momentum and
    let its moments decay; both are made up when the row is touched next, with the rate of that
    step. Where every row is touched at every step this is Adam; elsewhere a look-up sees a resting
    row without the momentum of the steps it has missed.

    Args:
        table: parameters.
        grad: their gradient; zero afterwards.
        moments: what was remembered; updated.
        now: number of this step, from 1.
        rate: learning rate.
        rule: constants.
        backend: ``warp`` (float32), ``torch``, ``auto``.

    Raises:
        BackendError: ``warp`` asked for and not able to run.

    Reference: Kingma and Ba, Adam, 2015, algorithm 1.

    >>> table, grad = torch.zeros(2, 1), torch.tensor([[3.0], [0.0]])
    >>> moments = RowMoments(torch.zeros(2, 1), torch.zeros(2, 1), torch.zeros(2).int())
    >>> row_adam(table, grad, moments, 1, 0.5, AdamRule())
    >>> [round(value, 4) for value in table.flatten().tolist()], grad.flatten().tolist()
    ([-0.5, 0.0], [0.0, 0.0])
    """
    beta1, beta2 = rule.betas
    scaled, root = rate / (1 - beta1**now), 1 / math.sqrt(1 - beta2**now)
    decay = _missed(beta1, beta2, table.device, table.dtype)
    chosen = choose_backend(backend, table)
    if chosen == "warp" and table.shape[1] > _WIDEST:
        if backend == "warp":
            raise BackendError(
                f"backend 'warp': expected at most {_WIDEST} columns, found {table.shape[1]}; "
                "pass backend='torch'"
            )
        chosen = "torch"
    if chosen == "torch":
        _row_adam_torch(table, grad, moments, (now, scaled, root), rule, decay)
        return
    from monopart.geometry.kernels.launch import launch, view, view_rows

    from .kernels.adam import row_adam_kernel

    rows, features = table.shape
    block = _BLOCK if table.device.type == "cpu" else 1
    args = [rows, block, now, scaled, root, rule.eps, beta1, beta2, view(decay, 3)]
    args += [view_rows(t) for t in (grad, table, moments.mean, moments.square)]
    items = -(-rows // block)
    launch(row_adam_kernel(features), items, [*args, view(moments.seen)], table)


def _row_adam_torch(
    table: Tensor,
    grad: Tensor,
    moments: RowMoments,
    step: tuple[int, float, float],
    rule: AdamRule,
    decay: Tensor,
) -> None:
    """The readable twin of the kernel."""
    now, rate, root = step
    rows = (grad != 0).any(1).nonzero().squeeze(1)
    gap = (now - 1 - moments.seen[rows].long()).clamp(max=len(decay) - 1)
    mean_decay, square_decay, movement = decay[gap][:, :, None].unbind(1)
    g, mean, square = grad[rows], moments.mean[rows], moments.square[rows]
    missed = rate * movement * mean / (square.sqrt() * root + rule.eps)
    mean = rule.betas[0] * mean_decay * mean + (1 - rule.betas[0]) * g
    square = rule.betas[1] * square_decay * square + (1 - rule.betas[1]) * g * g
    table[rows] -= missed + rate * mean / (square.sqrt() * root + rule.eps)
    moments.mean[rows], moments.square[rows], moments.seen[rows] = mean, square, now
    grad[rows] = 0.0


@functools.cache
def _missed(beta1: float, beta2: float, device: torch.device, dtype: torch.dtype) -> Tensor:
    """[gap, 3]: factors of the moments and the sum of the missed movements after resting steps.

    A resting row moves by rate · mean/root mean square, and that ratio falls by beta1/sqrt(beta2)
    each step: the movements are a geometric series.
    """
    gap = torch.arange(_LONGEST, dtype=torch.float64)
    ratio = beta1 / math.sqrt(beta2)
    movement = torch.cat([gap[:1], (ratio ** gap[1:]).cumsum(0)])  # its closed form cancels at 1
    return torch.stack([beta1**gap, beta2**gap, movement], -1).to(device, dtype)


class RowAdam(torch.optim.Optimizer):
    """Adam over tables [R, F], see :func:`row_adam`.

    The step consumes the gradient: it is zero afterwards, so that no new one is allocated, and
    :meth:`zero_grad` has nothing to do. With ``HashGrid.accumulate`` the backward pass adds to it
    in place.

    >>> table = torch.nn.Parameter(torch.ones(3, 2))
    >>> optimizer = RowAdam([table], lr=0.1)
    >>> table[1].sum().backward()
    >>> optimizer.step()
    >>> [round(total, 4) for total in table.sum(1).tolist()]
    [2.0, 1.8, 2.0]
    """

    def __init__(self, params: Iterable[Any], lr: float = 1e-3, rule: AdamRule | None = None):
        """Take the tables.

        Args:
            params: tables or groups of tables, [R, F] each.
            lr: learning rate.
            rule: constants; those of :class:`AdamRule` if None.
        """
        self.rule = rule or AdamRule()
        super().__init__(params, {"lr": lr})

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Nothing: the step has zeroed the gradients it used."""

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """One step on every table that has a gradient.

        Args:
            closure: evaluates the model again and gives the loss.
        """
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for table in group["params"]:
                if table.grad is not None:
                    self._step_of(table, table.grad, group["lr"])
        return loss

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Put back what ``state_dict`` gave.

        Args:
            state_dict: state and groups.

        Raises:
            KeyError: the state of another kind of optimiser.
        """
        super().load_state_dict(state_dict)
        missing = [n for s in self.state.values() for n in _STATE if n not in s]
        if missing:
            raise KeyError(f"state of RowAdam: no {missing[0]}")
        for state in self.state.values():  # torch casts all of it to the type of the table
            state["step"] = state["step"].to("cpu", torch.int64)
            state["seen"] = state["seen"].to(torch.int32)

    def _step_of(self, table: Tensor, grad: Tensor, rate: float) -> None:
        state = self.state[table]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.int64)
            state["mean"], state["square"] = torch.zeros_like(table), torch.zeros_like(table)
            state["seen"] = torch.zeros(len(table), dtype=torch.int32, device=table.device)
        state["step"] += 1
        moments = RowMoments(state["mean"], state["square"], state["seen"])
        row_adam(table, grad, moments, int(state["step"]), rate, self.rule)
