"""``monopart-bench cuda-sources``: compile every kernel for CUDA, where no GPU is needed.

Warp brings NVIDIA's run-time compiler, which needs no driver: the kernels that the CPU tests run
are translated to CUDA, compiled to PTX and assembled. That proves that they compile, not that they
run.
"""

import ast
import importlib
import inspect
import pkgutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from monopart.geometry.errors import BackendError

from .cubin import KernelFacts, kernel_facts

PACKAGES = ("monopart.geometry.kernels", "monopart.fields.kernels")
FACTORIES: dict[str, tuple[tuple[Any, ...], ...]] = {
    "attention_gradient_kernel": ((4, 8, 112),),
    "attention_kernel": ((4, 8, 112),),
    "bank_gradient_kernel": ((20,),),
    "bank_kernel": ((20,),),
    "forward_kernel": ((1,), (2,), (4,)),
    "points_kernel": ((1,), (2,), (4,)),
    "table_kernel": ((1,), (2,), (4,)),
    "row_adam_kernel": ((1,), (2,), (3,), (4,)),
}
"""Functions that make kernels, with all arguments that they serve, or those of the presets."""
LEAST_ARCH = 75  # Turing: PTX for it runs on every later GPU


@dataclass(frozen=True)
class Compiled:
    """One kernel compiled for one architecture."""

    name: str
    """Module and kernel."""
    arch: int
    """Compute capability, such as 80."""
    ptx_bytes: int
    """Size of the PTX of its module."""
    facts: KernelFacts
    """Registers and stack, as assembled for this architecture."""


def kernels() -> dict[str, Any]:
    """All kernels of the kernel packages by name, those of factories with their arguments.

    Raises:
        BackendError: a function makes kernels and is not in `FACTORIES`.
    """
    found: dict[str, Any] = {}
    for room in _rooms():
        for function, nested in _declared(room):
            if nested is None:
                found[f"{room.__name__}.{function}"] = getattr(room, function)
            elif nested not in FACTORIES:
                raise BackendError(
                    f"{room.__name__}.{nested}: makes kernels and is not listed; add it to "
                    "FACTORIES in tools/bench/cuda_sources.py"
                )
            else:
                for given in FACTORIES[nested]:
                    name = f"{room.__name__}.{function}{list(given)}"
                    found[name] = getattr(room, nested)(*given)
    return found


def _rooms() -> Iterator[Any]:
    for package in PACKAGES:
        folder = importlib.import_module(package)
        for info in pkgutil.iter_modules(folder.__path__):
            yield importlib.import_module(f"{package}.{info.name}")


def _declared(room: Any) -> Iterator[tuple[str, str | None]]:
    """Functions marked as kernels in a module, each with the function around it."""
    tree = ast.parse(inspect.getsource(room))
    for outer in tree.body:
        if not isinstance(outer, ast.FunctionDef):
            continue
        for inner in ast.walk(outer):
            if isinstance(inner, ast.FunctionDef) and _is_kernel(inner):
                yield inner.name, None if inner is outer else outer.name


def _is_kernel(function: ast.FunctionDef) -> bool:
    return any("wp.kernel" in ast.unparse(mark) for mark in function.decorator_list)


def has_compiler() -> bool:
    """Whether this build of Warp brings the CUDA compiler."""
    return bool(known_archs())


def known_archs() -> list[int]:
    """Compute capabilities that this build of Warp compiles for; none without a compiler."""
    import warp as wp

    from monopart.geometry.kernels.launch import init

    init()
    return wp.get_cuda_supported_archs()


def compile_all(arch: int = LEAST_ARCH) -> list[Compiled]:
    """Compile all kernels to PTX and assemble it.

    Args:
        arch: compute capability.

    Returns:
        One entry per kernel whose entry point is in the PTX and in the program.

    Raises:
        BackendError: an architecture that the compiler does not know, or a kernel that is missing
            from what was compiled of its module.
    """
    import warp as wp

    from monopart.geometry.kernels.launch import init

    init()
    if arch not in known_archs():
        raise BackendError(
            f"--arch {arch}: expected one of {', '.join(map(str, known_archs()))}; choose one"
        )
    named = kernels()
    modules = {id(kernel.module): kernel.module for kernel in named.values()}
    text: dict[int, str] = {}
    facts: dict[str, KernelFacts] = {}
    with tempfile.TemporaryDirectory() as folder:
        for number, (key, module) in enumerate(modules.items()):
            out = Path(folder) / str(number)
            wp.compile_aot_module(module, arch=arch, module_dir=out, use_ptx=True)
            text[key] = "\n".join(p.read_text() for p in sorted(out.glob("*.ptx")))
            wp.compile_aot_module(module, arch=arch, module_dir=out, use_ptx=False)
            for program in out.glob("*.cubin"):
                facts |= kernel_facts(program.read_bytes())
    compiled = []
    for name, kernel in named.items():
        ptx, entry = text[id(kernel.module)], f"{kernel.get_mangled_name()}_cuda_kernel_forward"
        if f".entry {entry}" not in ptx or entry not in facts:
            raise BackendError(f"{name}: expected its entry point in what compiled for sm_{arch}")
        compiled.append(Compiled(name, arch, len(ptx), facts[entry]))
    return compiled


def print_compiled(archs: tuple[int, ...]) -> None:
    """Compile for some architectures and print a table.

    Args:
        archs: compute capabilities.

    Raises:
        BackendError: this build of Warp has no CUDA compiler, or a kernel does not compile.
    """
    from rich.console import Console
    from rich.table import Table

    if not has_compiler():
        raise BackendError("cuda-sources: this build of Warp has no CUDA compiler; use Linux")
    table = Table(title="Kernels compiled for CUDA (no GPU ran them)")
    table.add_column("kernel", no_wrap=True)
    for arch in archs:
        table.add_column(f"sm_{arch}", justify="right", no_wrap=True)
    cells: dict[str, list[str]] = {}
    for arch in archs:
        for entry in compile_all(arch):
            size, needs = entry.ptx_bytes / 1000, entry.facts
            row = cells.setdefault(entry.name, [])
            row.append(f"{size:.0f}  {needs.registers:>3}  {needs.stack:>4}")
    for name, row in cells.items():
        table.add_row(name.removeprefix("monopart.").replace(".kernels.", "."), *row)
    table.caption = "kB of PTX of the kernel's module; registers and bytes of stack per thread"
    Console(width=120).print(table)
