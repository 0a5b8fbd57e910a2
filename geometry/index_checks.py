"""Indices into tables, checked before a kernel reads what is not there."""

from torch import Tensor

from .errors import InputError


def check_indices(name: str, index: Tensor, count: int, fix: str = "") -> None:
    """See that indices name rows that exist, on the CPU alone: elsewhere a look would wait.

    Args:
        name: what errors name.
        index: whole numbers.
        count: number of rows.
        fix: end of the message.

    Raises:
        InputError: an index below 0, or of ``count`` or more.
    """
    if index.device.type != "cpu" or not index.numel():
        return
    low, high = (int(v) for v in index.aminmax())
    if low < 0 or high >= count:
        raise InputError(f"{name}: expected indices in [0, {count - 1}], found {low} … {high}{fix}")
