"""Every kernel compiles for CUDA. No GPU runs here: that they compute right is shown on the CPU."""

import textwrap
from pathlib import Path
from types import ModuleType

import pytest

from monopart.geometry.errors import BackendError, InputError
from monopart.tools.bench import cuda_sources
from monopart.tools.bench.cubin import kernel_facts


@pytest.mark.slow
def test_every_kernel_compiles_for_cuda() -> None:
    if not cuda_sources.has_compiler():
        pytest.skip("this build of Warp has no CUDA compiler")
    compiled = cuda_sources.compile_all()  # PTX for Turing runs on every later GPU
    names = {entry.name for entry in compiled}
    assert names == set(cuda_sources.kernels())
    for part in (
        "face_tree.closest_hits",
        "newton.solve",
        "skin.",
        "shell.fill_samples",
        "volume.",
        "splats.blend",
    ):
        assert any(part in name for name in names), part
    assert "monopart.fields.kernels.hash_grid.hash_grid_forward[2]" in names
    assert all(entry.ptx_bytes > 1000 for entry in compiled)
    assert all(8 <= entry.facts.registers <= 255 for entry in compiled)
    # the search keeps a stack of 64 nodes and distances, which no register file holds
    (search,) = [e for e in compiled if e.name.endswith("face_tree.closest_hits")]
    assert search.facts.stack >= 512


def test_no_kernel_is_declared_elsewhere() -> None:
    """A kernel outside of the `kernels` folders would not be compiled here."""
    root = Path(__file__).resolve().parents[1]
    found = {
        path.relative_to(root).parent.as_posix()
        for room in ("geometry", "fields", "toolkit", "tools")
        for path in (root / room).rglob("*.py")
        if any(line.strip().startswith("@wp.kernel") for line in path.read_text().splitlines())
    }
    assert found == {"geometry/kernels", "fields/kernels", "tools/bench"}  # a plain peer to beat


def test_a_file_that_is_no_cubin_is_named() -> None:
    for data in (b"", b"\x7fELF\x02\x01", b"PTX" * 50):
        with pytest.raises(InputError, match="cubin"):
            kernel_facts(data)


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
