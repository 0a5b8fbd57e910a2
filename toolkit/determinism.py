"""Runs that repeat bit for bit on CUDA too, where sums are atomic unless asked otherwise."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from monopart.geometry.errors import BackendError

_WORKSPACE = "CUBLAS_WORKSPACE_CONFIG"
_FIXED = (":4096:8", ":16:8")  # sizes with which cuBLAS repeats its sums, as NVIDIA documents them


@contextmanager
def repeatable(on: bool) -> Iterator[None]:
    """Have torch use operations that give the same bits every time, or refuse those that cannot.

    On the CPU training needs none of this: its kernels sum in one order.

    Args:
        on: False changes nothing.

    Raises:
        BackendError: CUDA is in use and cuBLAS was not told to repeat its sums.
    """
    if not on:
        yield
        return
    if torch.cuda.is_initialized() and os.environ.get(_WORKSPACE) not in _FIXED:
        raise BackendError(
            f"train.deterministic: expected {_WORKSPACE} to be {' or '.join(_FIXED)} on CUDA, "
            f"found {os.environ.get(_WORKSPACE)!r}; set it before the program starts"
        )
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before)
