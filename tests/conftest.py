"""What every test shares: where the captures are, seeds, threads, a repeatable hypothesis."""

import os
import zipfile
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest
import torch
from building import build_wheel

ROOT = Path(__file__).resolve().parents[1]

hypothesis.settings.register_profile("house", derandomize=True, deadline=None, max_examples=50)
hypothesis.settings.load_profile("house")
torch.set_num_threads(min(2, os.cpu_count() or 1))


@pytest.fixture(scope="session", autouse=True)
def _cache_of_the_tests(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Tests do not touch the cache of the user."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MONOPART_CACHE", str(tmp_path_factory.mktemp("monopart_cache")))
        yield


@pytest.fixture(autouse=True)
def _same_numbers_every_run() -> None:
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def _gpu_tests_need_a_gpu(request: pytest.FixtureRequest) -> None:
    if request.node.get_closest_marker("gpu") and not torch.cuda.is_available():
        pytest.skip("needs CUDA")


@pytest.fixture(scope="session")
def captures_dir() -> Path:
    """The folder of the full captures; they do not travel with the code."""
    named = os.environ.get("MONOPART_CAPTURES")
    folder = Path(named) if named else ROOT.parent / "shared" / "captures"
    if not folder.is_dir():
        pytest.skip(f"no captures at {folder}; set MONOPART_CAPTURES")
    return folder


@pytest.fixture(scope="session")
def demo_capture() -> Path:
    """The small capture that the repository carries."""
    return ROOT / "examples" / "capture"


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel built from the working tree."""
    return build_wheel(ROOT, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="session")
def wheel_names(wheel: Path) -> list[str]:
    """The wheel's file names."""
    with zipfile.ZipFile(wheel) as archive:
        return archive.namelist()
