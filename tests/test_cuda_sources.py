"""Every kernel compiles for CUDA. No GPU runs here: that they compute right is shown on the CPU."""

import textwrap
from types import ModuleType

import pytest

from monopart.geometry.errors import BackendError
from monopart.tools.bench import cuda_sources


@pytest.mark.slow
def test_every_kernel_compiles_for_cuda() -> None:
    if not cuda_sources.has_compiler():
        pytest.skip("this build of Warp has no CUDA compiler")
    compiled = cuda_sources.compile_all()
    names = {entry.name for entry in compiled}
    assert names == set(cuda_sources.kernels())
    for part in (
        "face_tree.closest_hits",
        "newton.solve",
        "skin.",
        "shell.fill_samples",
        "volume.",
    ):
        assert any(part in name for name in names), part
    assert "monopart.fields.kernels.hash_grid.hash_grid_forward[2]" in names
    assert all(entry.ptx_bytes > 1000 for entry in compiled)


def test_a_factory_that_is_not_listed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    source = """
    def made_kernel(n):
        @wp.kernel
        def inner(start: int): ...
        return inner
    """
    room = ModuleType("monopart.geometry.kernels.extra")
    monkeypatch.setattr(cuda_sources, "_rooms", lambda: iter([room]))
    monkeypatch.setattr(cuda_sources.inspect, "getsource", lambda _: textwrap.dedent(source))
    with pytest.raises(BackendError, match="made_kernel: makes kernels and is not listed"):
        cuda_sources.kernels()
