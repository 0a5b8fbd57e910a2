"""A GPU that is not there: CPU tensors that say they are on ``cuda:0``, and keep to themselves.

Where no GPU can be had, this shows that code would find all it needs on the device. Inside the
mode every tensor has a home, the host or the device, and operations that CUDA would refuse are
refused: tensors of both homes in one operation, a kernel's argument on the wrong side, random
numbers from the other side's generator, numpy on a device tensor. Waits of the host for the device
are counted by the function that causes them. Values are computed on the CPU: kernels take their
CUDA branches (one launch, atomics), but no CUDA code runs.
"""

import functools
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest
import torch
import warp as wp
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.overrides import TorchFunctionMode
from torch.utils._device import _device_constructors
from torch.utils._pytree import tree_leaves

from monopart.geometry.kernels import launch

DEVICE = torch.device("cuda", 0)
HOST = torch.device("cpu")
WAITS = {
    "item", "tolist", "__bool__", "__int__", "__float__", "__index__", "nonzero", "argwhere",
    "bincount", "unique", "unique_consecutive", "masked_select", "equal", "allclose", "cpu",
    "_unique2",
}  # fmt: skip
_MIX = {"copy_", "__getitem__", "__get__", "__set__", "_has_compatible_shallow_copy_type"}
_MOVES = {"to", "cpu", "type_as"}
_REFUSED = {"numpy", "__array__"}
_STRICT = {"cat", "stack", "concat", "concatenate"}  # take no scalar of the host either
_DEVICE_OF, _IS_CUDA = Tensor.device.__get__, Tensor.is_cuda.__get__  # type: ignore[attr-defined]
_homes: dict[int, tuple[StorageWeakRef, torch.device]] = {}


def home_of(tensor: Tensor) -> torch.device | None:
    """Where a tensor is; None for what the mode has not seen being made."""
    if tensor.layout is not torch.strided:  # of oneDNN: only ever on the host
        return HOST
    found = _homes.get(tensor.untyped_storage()._cdata)
    return None if found is None else found[1]


def _settle(tensor: Tensor, home: torch.device) -> None:
    if tensor.layout is not torch.strided:
        return
    storage = tensor.untyped_storage()
    if storage._cdata not in _homes:  # a weak reference keeps the address from being used again
        _homes[storage._cdata] = (StorageWeakRef(storage), home)
    if len(_homes) > 20000:
        for key in [k for k, (ref, _) in _homes.items() if ref.expired()]:
            del _homes[key]


def _on_device(value: Any) -> bool:
    return isinstance(value, str | torch.device) and torch.device(value).type == "cuda"


class Pretending(TorchFunctionMode):
    """The mode; `waits` counts where the host waits for the device."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: Counter[str] = Counter()
        self.unseen = HOST  # home of what was made out of sight
        self.constructors = _device_constructors() | {torch.from_numpy, torch.as_tensor}

    def __torch_function__(
        self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None
    ) -> Any:
        kwargs = dict(kwargs or {})
        if func == _DEVICE_OF:
            return home_of(args[0]) or self.unseen
        if func == _IS_CUDA:
            return home_of(args[0]) == DEVICE
        name = func.__name__
        tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        homes = [home_of(t) for t in tensors]
        if name in _MOVES:
            return self._move(func, args, kwargs, homes)
        if name == "pin_memory":
            return args[0]
        self._check(name, args, tensors, homes)
        home = self._asked(kwargs, homes)
        out = func(*args, **kwargs)
        for leaf in tree_leaves(out):
            if isinstance(leaf, Tensor) and home is not None:
                _settle(leaf, home)
        return out

    def run_backward(self, engine: Any, roots: Sequence[Tensor], *args: Any, **kwargs: Any) -> Any:
        """Run autograd's engine inside the mode; gradients are made out of sight, by the roots."""
        self.unseen = home_of(roots[0]) or HOST
        with self:
            out = engine(roots, *args, **kwargs)
        self.unseen = HOST
        return out

    def _asked(self, kwargs: dict, homes: list) -> torch.device | None:
        """Home of the result: the device asked for, that of the arguments, or the host."""
        wanted = kwargs.get("device")
        if wanted is not None:
            kwargs["device"] = HOST
            home = DEVICE if _on_device(wanted) else HOST
        elif DEVICE in homes:
            home = DEVICE
        else:
            home = HOST if HOST in homes or not homes else None
        generator = kwargs.get("generator")
        if generator is not None and home == DEVICE:
            raise AssertionError(f"{_caller()}: the host's generator for numbers on the device")
        return home

    def _check(self, name: str, args: tuple, tensors: list[Tensor], homes: list) -> None:
        if DEVICE not in homes:
            return
        if name in _REFUSED:
            raise TypeError(f"{_caller()}: numpy of a device tensor; use .cpu() first")
        masks = [
            leaf for leaf in tree_leaves(args[1:2])
            if isinstance(leaf, Tensor) and leaf.dtype == torch.bool
        ] if name in ("__getitem__", "__setitem__") else []  # fmt: skip
        filled = name == "__setitem__" and not isinstance(args[2], Tensor)  # a fill: no wait
        if name in WAITS or (masks and not filled):
            self.waits[f"{_caller()} {'mask' if masks else name}"] += 1
        if name in _MIX:
            return
        for tensor, home in zip(tensors, homes, strict=True):
            index = name == "__setitem__" and tensor is not args[0] and tensor is not args[2]
            if home == HOST and not index and (tensor.ndim or name in _STRICT):
                raise AssertionError(
                    f"{_caller()}: {name} of tensors of the host {tuple(tensor.shape)} and the "
                    "device"
                )

    def _move(self, func: Any, args: tuple, kwargs: dict, homes: list) -> Tensor:
        """``to``, ``cpu`` and ``type_as``: the only ways from one home to the other."""
        own, home = args[0], homes[0] or HOST
        rest = list(args[1:])
        for i, value in enumerate(rest):
            if isinstance(value, str | torch.device):
                home, rest[i] = (DEVICE if _on_device(value) else HOST), HOST
            elif isinstance(value, Tensor):
                home = home_of(value) or HOST
        if kwargs.get("device") is not None:
            home = DEVICE if _on_device(kwargs["device"]) else HOST
            kwargs["device"] = HOST
        if func.__name__ == "cpu":
            home = HOST
        if homes[0] == DEVICE and home == HOST:
            self.waits[f"{_caller()} copy to the host"] += 1
        out = func(own, *rest, **kwargs)
        if home != (homes[0] or HOST) and home_of(out) is not None:
            out = out.clone()
        elif home == DEVICE and home_of(out) is None and out is own:
            out = out.clone()
        _settle(out, home)
        return out


def _caller() -> str:
    """The innermost function of the package on the stack."""
    frame = sys._getframe(1)
    while frame is not None:
        module = frame.f_globals.get("__name__", "")
        if module.startswith("monopart."):
            return f"{module.removeprefix('monopart.')}.{frame.f_code.co_name}"
        frame = frame.f_back  # type: ignore[assignment]
    return "outside"


@contextmanager
def pretend_cuda() -> Iterator[Pretending]:
    """A block in which ``torch.device("cuda", 0)`` can be used as if there were one."""
    view = launch.view

    def checked_view(tensor: Tensor, vector: int = 1) -> Any:
        with torch._C.DisableTorchFunction():
            argument = view(tensor, vector)
            argument.home = home_of(tensor)
        return argument

    def launch_one(kernel: Any, count: int, args: list[Any], like: Tensor) -> None:
        wrong = HOST if like.device.type == "cuda" else DEVICE
        for place, arg in enumerate(args):
            if getattr(arg, "home", None) == wrong and arg.tensor.numel():
                raise AssertionError(f"{kernel.key}: argument {place + 1} is on {wrong.type}")
        with torch._C.DisableTorchFunction():
            wp.launch(kernel, dim=count, inputs=[0, *args], device="cpu", record_tape=False)

    with pytest.MonkeyPatch.context() as patch, Pretending() as mode:
        engine = torch.autograd._engine_run_backward  # type: ignore[attr-defined]
        run = functools.partial(mode.run_backward, engine)
        patch.setattr(torch.autograd, "_engine_run_backward", run)
        patch.setattr(launch, "view", checked_view)
        patch.setattr(launch, "launch_one", launch_one)
        yield mode
