"""Warp launches: pieces over threads give what one thread gives, whatever the count."""

import os
import subprocess
import sys
import weakref
from collections.abc import Iterator
from typing import no_type_check

import pytest
import torch
import warp as wp

from monopart.geometry.kernels import launch as room
from monopart.geometry.kernels.launch import launch, launch_jobs, launch_one, view

THRESHOLD = room._SMALL


@no_type_check
@wp.kernel
def add_index(
    start: int, source: wp.array(dtype=wp.vec3), scale: float, out: wp.array(dtype=wp.vec3)
):
    """Each item adds, so that an item that runs twice or never is seen."""
    i = start + wp.tid()
    out[i] = out[i] + source[i] * scale + wp.vec3(float(i), 0.0, 0.0)


@no_type_check
@wp.kernel
def mark(start: int, column: int, out: wp.array2d(dtype=wp.int32)):
    """Each job owns a column."""
    i = start + wp.tid()
    out[i, column] = out[i, column] + 10 * column + 1


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def run(count: int, threads: int, smallest: int = THRESHOLD) -> torch.Tensor:
    torch.set_num_threads(threads)
    torch.manual_seed(1)
    source, out = torch.randn(count, 3), torch.zeros(count, 3)
    launch(add_index, count, [view(source, 3), 0.5, view(out, 3)], source, smallest)
    expected = source * 0.5
    expected[:, 0] += torch.arange(count)
    torch.testing.assert_close(out, expected)
    return out


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("count", [0, 1, 2, 3, THRESHOLD - 1, THRESHOLD, THRESHOLD + 1, 5001])
def test_threads_do_not_change_the_result(count: int) -> None:
    one = run(count, 1)
    for threads in (2, 3):
        assert torch.equal(run(count, threads), one)
        assert torch.equal(run(count, threads, smallest=2), one)


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("count", [THRESHOLD - 1, THRESHOLD])
def test_small_counts_stay_on_one_thread(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    side_by_side = room._run_side_by_side

    def spy(kernel: object, jobs: list[tuple[int, list[object]]]) -> None:
        seen.extend(items for items, _ in jobs)
        side_by_side(kernel, jobs)

    monkeypatch.setattr(room, "_run_side_by_side", spy)
    run(count, 2)
    assert seen == ([] if count < THRESHOLD else [count // 2, count - count // 2])


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("count", [0, 1, 3000])
@pytest.mark.parametrize("threads", [1, 2])
def test_jobs_run_once_each(count: int, threads: int) -> None:
    torch.set_num_threads(threads)
    out = torch.zeros(count, 5, dtype=torch.int32)
    launch_jobs(mark, [[c, view(out)] for c in range(5)], count, out)
    expected = torch.tensor([1, 11, 21, 31, 41], dtype=torch.int32).expand(count, 5)
    assert torch.equal(out, expected)
    launch_jobs(mark, [], count, out)
    assert torch.equal(out, expected)


def test_one_unsplit_launch() -> None:
    out = torch.zeros(2000, 5, dtype=torch.int32)
    launch_one(mark, 2000, [2, view(out)], out)
    assert torch.equal(out[:, 2], torch.full((2000,), 21, dtype=torch.int32))
    launch_one(mark, 0, [2, view(out)], out)
    assert int(out.sum()) == 21 * 2000


def test_views_share_memory_and_know_vectors() -> None:
    tensor = torch.zeros(4, 3)
    launch(add_index, 4, [view(torch.ones(4, 3), 3), 2.0, view(tensor, 3)], tensor)
    assert tensor[3].tolist() == [5.0, 2.0, 2.0]
    kinds = [torch.float32, torch.float64, torch.int32, torch.int64, torch.uint8, torch.bool]
    for dtype in kinds:
        view(torch.zeros(3, dtype=dtype))
    with pytest.raises(KeyError):
        view(torch.zeros(3, 3, dtype=torch.float64), 3)


def test_a_view_keeps_its_tensor() -> None:
    tensor = torch.zeros(1000)
    alive = weakref.ref(tensor)
    argument = view(tensor)
    del tensor
    assert alive() is not None
    del argument
    assert alive() is None


def test_starting_warp_prints_no_banner() -> None:
    code = "from monopart.geometry.kernels.launch import init; init(); init()"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=os.environ
    )
    assert done.stdout == ""
    # one line may come from the native library, which has no switch for it
    assert all("CUDA driver" in line for line in done.stderr.splitlines())
