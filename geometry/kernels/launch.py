"""Warp launches over torch tensors: the only file that knows threads, streams and interop.

A Warp kernel runs on one thread on the CPU and releases the GIL, so a launch over ``count`` items
is cut into chunks for a small pool. Kernels that are launched here take ``start: int`` as their
first argument and work on item ``start + wp.tid()``. On CUDA one launch goes to torch's current
stream, with no host synchronisation and no memory of Warp's own, so that launches can be captured
in a CUDA graph of torch's. The first launch of a kernel loads its module: it belongs before the
capture.
"""

import functools
import itertools
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
import warp as wp
from torch import Tensor

from monopart.geometry.stages import stage

_SMALL = 1024  # below this many items a second thread costs more than it saves
_CHUNKS = 4  # of a thread, at most
_LOCK = threading.Lock()
_READY: list[bool] = []
_COMPILED: set[Any] = set()  # kernels whose module is loaded for the CPU

_VECTOR = {
    (torch.float32, 1): wp.float32,
    (torch.float32, 2): wp.vec2,
    (torch.float32, 3): wp.vec3,
    (torch.float32, 4): wp.vec4,
    (torch.int32, 3): wp.vec3i,
}
_SCALAR = {
    torch.float32: wp.float32,
    torch.float64: wp.float64,
    torch.int32: wp.int32,
    torch.int64: wp.int64,
    torch.uint8: wp.uint8,
    torch.bool: wp.bool,
}


def view(tensor: Tensor, vector: int = 1) -> Any:
    """Warp's view of a contiguous tensor without a copy.

    Args:
        tensor: contiguous; float32, float64, int32, int64, uint8 or bool.
        vector: 2, 3 or 4 reads the last axis as one vector (float32 only); 1 keeps scalars.

    Returns:
        A launch argument: an array of the remaining axes, which keeps the tensor alive.
    """
    init()
    dtype = _VECTOR[tensor.dtype, vector] if vector > 1 else _SCALAR[tensor.dtype]
    argument: Any = wp.from_torch(
        tensor.detach(), dtype=dtype, requires_grad=False, return_ctype=True
    )
    argument.tensor = tensor  # Warp's struct holds a bare pointer: a temporary would be freed
    return argument


def view_rows(table: Tensor) -> Any:
    """Warp's view of a table [R, F] as R rows: vectors of 2, 3 or 4 floats, or single ones.

    Args:
        table: contiguous float32, F from 1 to 4.

    Returns:
        A launch argument.
    """
    width = table.shape[1]
    return view(table if width > 1 else table.view(-1), width)


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="warp")


def init() -> None:
    """Start Warp once, without its banner."""
    if _READY:
        return
    with _LOCK:
        # no banner; the native library's own line about a missing CUDA driver has no switch
        wp.config.log_level = wp.LOG_ERROR
        wp.init()
        wp.config.log_level = wp.LOG_WARNING
        _READY.append(True)


def launch(kernel: Any, count: int, args: list[Any], like: Tensor, smallest: int = _SMALL) -> None:
    """Run ``kernel`` over ``count`` items on the device of ``like``.

    Args:
        kernel: a Warp kernel whose first argument is ``start: int``.
        count: number of items; 0 does nothing.
        args: the arguments after ``start``; tensors go through :func:`view` first.
        like: any tensor of the launch; tells the device.
        smallest: fewer items than this stay on one thread.
    """
    if count == 0:
        return
    init()
    threads = torch.get_num_threads()
    if like.device.type == "cuda" or threads == 1 or count < smallest:
        launch_one(kernel, count, args, like)
        return
    # several chunks a thread: one that is held up leaves the rest to the others
    chunks = threads * max(1, min(_CHUNKS, count // (threads * _SMALL)))
    cuts = [count * i // chunks for i in range(chunks + 1)]
    _run_side_by_side(kernel, [(b - a, [a, *args]) for a, b in itertools.pairwise(cuts)])


def _run_side_by_side(kernel: Any, jobs: list[tuple[int, list[Any]]]) -> None:
    """Run CPU launches on the pool; the first ever runs alone, so that it compiles once."""
    if kernel not in _COMPILED:
        dim, inputs = jobs[0]
        _launch_on_cpu(kernel, dim, inputs)
        _COMPILED.add(kernel)
        jobs = jobs[1:]
    pool = _pool(torch.get_num_threads())
    futures = [pool.submit(_launch_on_cpu, kernel, dim, inputs) for dim, inputs in jobs]
    for future in futures:
        future.result()


def _launch_on_cpu(kernel: Any, dim: int, inputs: list[Any]) -> None:
    with stage(kernel.key, "kernel"):
        wp.launch(kernel, dim=dim, inputs=inputs, device="cpu", record_tape=False)


def launch_jobs(kernel: Any, jobs: list[list[Any]], count: int, like: Tensor) -> None:
    """Run one launch of ``count`` items per argument list, side by side on the CPU.

    The jobs must write to disjoint memory: so scatter kernels stay deterministic without atomics.

    Args:
        kernel: a Warp kernel whose first argument is ``start: int``.
        jobs: one argument list (after ``start``) per launch.
        count: items of each launch.
        like: any tensor of the launch; tells the device.
    """
    if count == 0:
        return
    init()
    if like.device.type == "cuda" or torch.get_num_threads() == 1:
        for args in jobs:
            launch_one(kernel, count, args, like)
        return
    _run_side_by_side(kernel, [(count, [0, *args]) for args in jobs])


@functools.lru_cache(maxsize=64)
def _warp_stream(device: int, handle: int) -> Any:
    """Warp's name for a stream of torch's, which owns it; made once, also for captures."""
    return wp.Stream(f"cuda:{device}", cuda_stream=handle)


def launch_one(kernel: Any, count: int, args: list[Any], like: Tensor) -> None:
    """Run one unsplit launch (a scatter kernel on one thread, or anything on CUDA)."""
    if like.device.type == "cuda":
        now = torch.cuda.current_stream(like.device)
        stream = _warp_stream(now.device_index, now.cuda_stream)
        with stage(kernel.key, "kernel"):
            wp.launch(kernel, dim=count, inputs=[0, *args], stream=stream, record_tape=False)
    else:
        _launch_on_cpu(kernel, count, [0, *args])
