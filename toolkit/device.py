"""Which device trains and renders, and how what the host draws gets there."""

import re

import torch
from jaxtyping import Shaped
from torch import Tensor

from monopart.geometry.errors import InputError

CPU = torch.device("cpu")


def pick_device(name: str) -> torch.device:
    """The device that a command line names.

    Args:
        name: ``cpu``, ``cuda``, ``cuda:1`` and so on, or ``auto``: CUDA where there is a GPU.

    Returns:
        The device; of CUDA always one with a number.

    Raises:
        InputError: another name, or a GPU that is not there.

    >>> pick_device("cpu")
    device(type='cpu')
    """
    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if name == "cpu" or (name == "auto" and not gpus):
        return CPU
    match = re.fullmatch(r"auto|cuda(?::(\d+))?", name)
    if match is None:
        raise InputError(
            f"--device: expected cpu, cuda, cuda:N or auto, found {name!r}; choose one of them"
        )
    index = int(match[1] or 0)
    if index >= gpus:
        raise InputError(
            f"--device {name}: expected a GPU of that number, found {gpus} in all (CUDA of this "
            f"torch: {torch.version.cuda or 'none'}); use --device cpu"
        )
    return torch.device("cuda", index)


def sent(tensor: Shaped[Tensor, "..."], device: torch.device) -> Shaped[Tensor, "..."]:
    """A tensor of the host on a device; the host does not wait for the copy.

    Args:
        tensor: on the CPU.
        device: where it is needed.

    Returns:
        The copy; the tensor itself where that is on the CPU too.
    """
    if device.type == "cpu":
        return tensor
    return tensor.pin_memory().to(device, non_blocking=True)
