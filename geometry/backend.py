"""Which implementation runs: the torch reference or the Warp kernels."""

import functools
import importlib.util
from typing import Literal

import torch
from torch import Tensor

from .errors import BackendError, InputError

Backend = Literal["auto", "warp", "torch"]


@functools.cache
def warp_is_installed() -> bool:
    """Tell whether Warp can be imported, without importing it.

    Returns:
        True where ``import warp`` would find a package.
    """
    return importlib.util.find_spec("warp") is not None


def choose_backend(backend: str, like: Tensor) -> Literal["warp", "torch"]:
    """Resolve a back end by name; what is asked for by name runs or raises.

    Args:
        backend: ``auto`` is Warp where it is installed and serves dtype and device, else torch.
        like: a tensor of the call; tells the dtype and the device.

    Returns:
        ``warp`` or ``torch``.

    Raises:
        InputError: an unknown name.
        BackendError: Warp was asked for and is not installed or cannot serve the dtype or device.

    >>> choose_backend("torch", torch.zeros(1))
    'torch'
    """
    if backend not in ("auto", "warp", "torch"):
        raise InputError(f"backend: expected auto, warp or torch, found {backend!r}; pick one")
    if backend == "torch":
        return "torch"
    fits = like.dtype == torch.float32 and like.device.type in ("cpu", "cuda")
    if warp_is_installed() and fits:
        return "warp"
    if backend == "auto":
        return "torch"
    if not fits:
        raise BackendError(
            f"backend 'warp': expected float32 on cpu or cuda, found {like.dtype} on "
            f"{like.device}; convert the input or pass backend='torch'"
        )
    raise BackendError("backend 'warp' is not installed; run: pip install 'warp-lang>=1.19'")
