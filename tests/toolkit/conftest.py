"""Lets the tests of the toolkit import what they share: `from miniature import write_miniature`."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch

from monopart.toolkit import cli

sys.path.insert(0, str(Path(__file__).parent))

from miniature import write_miniature
from training import TINY


@contextmanager
def _one_thread() -> Iterator[None]:
    """Pictures of 48 pixels gain nothing by a second thread, and lose much on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@pytest.fixture(scope="module", autouse=True)
def _small_tensors() -> Iterator[None]:
    with _one_thread():
        yield


@pytest.fixture(scope="session")
def small_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture of 48 pixels and 4 frames; not to be changed."""
    return write_miniature(tmp_path_factory.mktemp("capture") / "small", size=48)


@pytest.fixture(scope="session")
def trained_run(small_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three iterations on `small_capture`, made by the program; not to be changed."""
    run = tmp_path_factory.mktemp("runs") / "run"
    command = ["train", str(small_capture), "--out", str(run), "--preset", "tiny"]
    with pytest.MonkeyPatch.context() as patch, _one_thread():
        patch.setattr("monopart.toolkit.commands.STRIP_VIEWS", 2)
        assert cli.main([*command, "--iterations", "3", "--explain", "--set", *TINY]) is None
    return run


@pytest.fixture
def short_strip(monkeypatch: pytest.MonkeyPatch) -> None:
    """Turntables of reports have two pictures."""
    monkeypatch.setattr("monopart.toolkit.commands.STRIP_VIEWS", 2)
