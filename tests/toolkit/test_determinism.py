"""The same seed gives the same avatar: bit for bit, on any number of threads within a bound."""

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from miniature import write_miniature

from monopart.geometry.errors import BackendError
from monopart.toolkit import determinism
from monopart.toolkit.avatar import Avatar, view_of
from monopart.toolkit.captures import read_capture
from monopart.toolkit.checkpoint import WEIGHTS
from monopart.toolkit.presets import preset, with_overrides
from monopart.toolkit.render import render_view
from monopart.toolkit.train import Trainer

# so many rays that torch splits its sums over threads: small batches would hide their order
RAYS = 2048
THREADS_BOUND = 1e-3  # mean change of a colour between one and two threads; 0 where measured


@contextmanager
def threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_miniature(tmp_path_factory.mktemp("captures") / "mini", size=64)


def trained(capture: Path, run: Path, count: int, seed: int = 0, **train: object) -> Avatar:
    loop = {"iterations": 4, "rays": RAYS, "lpips_start": 0.0, "patch": 24, **train}
    field = {"log2_size": 12, "levels": 4, "hidden": 16}
    config = with_overrides(preset("fast"), train=loop, field=field)
    run.mkdir(parents=True)
    with threads(count):
        torch.manual_seed(seed)
        avatar = Avatar.create(read_capture(capture), config)
        trainer = Trainer(avatar, run)
        trainer.generator.manual_seed(seed)
        trainer.loop()
    assert trainer.result.stats["colors_evaluated"] > 4 * 4096
    return avatar


@pytest.fixture(scope="module")
def runs(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Avatar]]:
    folder = tmp_path_factory.mktemp("runs")
    make = functools.partial(trained, capture)
    return {
        name: (folder / name, make(folder / name, count, seed))
        for name, count, seed in (("two", 2, 0), ("again", 2, 0), ("one", 1, 0), ("other", 2, 1))
    }


def test_the_same_seed_gives_the_same_file(runs: dict[str, tuple[Path, Avatar]]) -> None:
    files = {name: (run / WEIGHTS).read_bytes() for name, (run, _) in runs.items()}
    assert files["two"] == files["again"]
    assert files["two"] != files["other"], "the seed decides nothing"


def test_gradients_repeat_on_two_threads(runs: dict[str, tuple[Path, Avatar]]) -> None:
    avatar = runs["other"][1]
    found = set()
    with threads(2):
        trainer = Trainer(avatar)
        for _ in range(8):
            trainer.generator.manual_seed(0)
            avatar.model.zero_grad(set_to_none=True)
            terms, _ = trainer.losses(0, 1.0)
            torch.stack(list(terms.values())).sum().backward()
            grads = [p.grad for p in avatar.model.parameters() if p.grad is not None]
            found.add(b"".join(g.numpy().tobytes() for g in grads))
    assert len(found) == 1


def test_threads_change_little(runs: dict[str, tuple[Path, Avatar]]) -> None:
    images = {n: render_view(a, view_of(a.record, 1, 1)).color for n, (_, a) in runs.items()}
    assert float((images["one"] - images["two"]).abs().mean()) <= THREADS_BOUND
    assert float(images["one"].max()) > 0.2, "an empty picture proves nothing"
    with threads(2):
        _, avatar = runs["one"]
        again = render_view(avatar, view_of(avatar.record, 1, 1)).color
    torch.testing.assert_close(again, images["one"], atol=1e-5, rtol=0)


def test_the_switch_changes_nothing_on_the_cpu(
    runs: dict[str, tuple[Path, Avatar]], capture: Path, tmp_path: Path
) -> None:
    avatar = trained(capture, tmp_path / "run", 2, deterministic=True)
    assert (tmp_path / "run" / WEIGHTS).read_bytes() == (runs["two"][0] / WEIGHTS).read_bytes()
    assert avatar.model.field.grid.deterministic
    assert not runs["two"][1].model.field.grid.deterministic
    assert not torch.are_deterministic_algorithms_enabled(), "torch is left as it was"


def test_cuda_without_repeatable_sums_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    monkeypatch.delenv("CUBLAS_WORKSPACE_CONFIG", raising=False)
    with pytest.raises(BackendError, match="CUBLAS_WORKSPACE_CONFIG"):
        with determinism.repeatable(True):
            pass
    with determinism.repeatable(False):
        assert not torch.are_deterministic_algorithms_enabled()
    monkeypatch.setenv("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    with pytest.raises(ZeroDivisionError):
        with determinism.repeatable(True):
            assert torch.are_deterministic_algorithms_enabled()
            _ = 1 / 0
    assert not torch.are_deterministic_algorithms_enabled()
