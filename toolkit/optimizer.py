"""Adam for an avatar: hash tables and everything else, each at its own rate."""

import inspect
from collections.abc import Iterator
from typing import Any

import torch

from monopart.fields.hash_grid import HashGrid
from monopart.fields.row_adam import AdamRule, RowAdam

from .config import Config, RefineConfig

_RULE = AdamRule()
CORRECTIONS = {
    "corrections.rotations": 1.0,
    "corrections.translations": 0.3,
    "corrections.betas": 10.0,
}
"""Parameters of the pose corrections, and their rates in units of `refine.lr`."""


class Adam(torch.optim.Adam):
    """Torch's Adam, bit for bit, without its import of torch.compile, which takes over a second."""

    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)
    zero_grad = inspect.unwrap(torch.optim.Adam.zero_grad)
    state_dict = inspect.unwrap(torch.optim.Adam.state_dict)
    load_state_dict = inspect.unwrap(torch.optim.Adam.load_state_dict)
    step = torch.no_grad()(inspect.unwrap(torch.optim.Adam.step))


class SplitAdam:
    """:class:`RowAdam` for the tables and fused Adam for the rest, seen as one optimiser."""

    def __init__(self, tables: RowAdam, others: torch.optim.Adam) -> None:
        """Join two optimisers.

        Args:
            tables: of the hash tables.
            others: of everything else.
        """
        self.tables, self.others = tables, others

    @property
    def param_groups(self) -> list[dict[str, Any]]:
        """The groups of both; entries may be set."""
        return self.tables.param_groups + self.others.param_groups

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Forget the gradients that a step does not consume.

        Args:
            set_to_none: drop them instead of filling them with zeros.
        """
        self.others.zero_grad(set_to_none)

    def step(self) -> None:
        """One step of both."""
        self.tables.step()
        self.others.step()

    def state_dict(self) -> dict[str, Any]:
        """The state of every parameter, numbered through the groups of both."""
        tables, others = self.tables.state_dict(), self.others.state_dict()
        count = self._tables()
        state = tables["state"] | {count + i: v for i, v in others["state"].items()}
        return {"state": state, "param_groups": tables["param_groups"] + others["param_groups"]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Put back what :meth:`state_dict` gave.

        Args:
            state_dict: state and groups.

        Raises:
            KeyError: the state of another kind of optimiser.
        """
        count, groups = self._tables(), state_dict["param_groups"]
        state, split = state_dict["state"], len(self.tables.param_groups)
        tables = {i: v for i, v in state.items() if i < count}
        others = {i - count: v for i, v in state.items() if i >= count}
        self.tables.load_state_dict({"state": tables, "param_groups": groups[:split]})
        self.others.load_state_dict({"state": others, "param_groups": groups[split:]})

    def _tables(self) -> int:
        return sum(len(group["params"]) for group in self.tables.param_groups)


def make_optimizer(model: torch.nn.Module, config: Config) -> torch.optim.Adam | SplitAdam:
    """Adam with the rates of hash tables and of everything else.

    Args:
        model: an avatar's model; its hash grids are told how to hand over their gradients.
        config: rates, whether tables are stepped row by row, and in which order they are summed.
    """
    sparse = config.train.sparse_optimizer
    for grid in _grids(model):
        grid.accumulate = sparse
        grid.deterministic = config.train.deterministic
    loop = config.train
    residuals = ("backward_residual.", "forward_residual.")
    slower = {residuals: config.deform.lr, ("appearance.bank.",): config.appearance.lr}
    named = [(n, p) for n, p in model.named_parameters() if n not in CORRECTIONS]
    tables, others = (
        [(n, p) for n, p in named if n.endswith("grid.table") == is_table]
        for is_table in (True, False)
    )
    groups = _groups(tables, loop.lr_table, slower)
    count = len(groups)
    groups += _groups(others, loop.lr_network, slower)
    groups += _pose_groups(dict(model.named_parameters()), config.refine)
    rule: Any = {"betas": _RULE.betas, "eps": _RULE.eps}
    if not sparse:
        return Adam(groups, lr=1e-3, fused=True, **rule)
    others_only = Adam(groups[count:], lr=1e-3, fused=True, **rule)
    return SplitAdam(RowAdam(groups[:count], rule=_RULE), others_only)


def _groups(
    named: list[tuple[str, torch.nn.Parameter]],
    rate: float,
    slower: dict[tuple[str, ...], float],
) -> list[dict[str, Any]]:
    """Groups by rate, in the order of the factors: 1 first, then those of prefixes of names."""
    found: dict[float, list[torch.nn.Parameter]] = {1.0: []}
    for name, parameter in named:
        factor = next((f for start, f in slower.items() if name.startswith(start)), 1.0)
        found.setdefault(factor, []).append(parameter)
    return [{"params": p, "base_lr": rate * f} for f, p in found.items() if p]


def _pose_groups(named: dict[str, torch.nn.Parameter], spec: RefineConfig) -> list[dict[str, Any]]:
    """Groups of the pose corrections among named parameters; none where there are none."""
    shares = {named[n]: share for n, share in CORRECTIONS.items() if n in named}
    return [{"params": [p], "base_lr": share * spec.lr} for p, share in shares.items()]


def _grids(model: torch.nn.Module) -> Iterator[HashGrid]:
    return (m for m in model.modules() if isinstance(m, HashGrid))
