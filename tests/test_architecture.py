"""Modules import alone, without optional packages, and importing has no effects."""

import subprocess
import sys

import pytest
from building import FOLDERS, ROOT, source_files

HEAVY = ("cv2", "igl", "pymeshlab", "trimesh", "tyro", "rich", "safetensors", "scipy", "xatlas")

ALONE = """
import importlib, pkgutil, sys
for name in {blocked!r}:
    sys.modules[name] = None  # any import of it now raises
import monopart.{root} as root
for info in pkgutil.walk_packages(root.__path__, "monopart.{root}."):
    importlib.import_module(info.name)
found = [m for m in sys.modules if m.startswith("monopart.") and sys.modules[m] is not None]
print(*sorted({{m.split(".")[1] for m in found}}))
"""

NO_EFFECTS = """
import builtins, importlib, os, pkgutil, random, sys, threading

class NoArguments(list):
    def __getitem__(self, index): raise RuntimeError("an import read sys.argv")
    __iter__ = __len__ = __getitem__

import numpy, rich.console, rich.progress, torch  # rich draws random numbers when it is imported

sys.argv = NoArguments()
seed, numpy_seed = torch.initial_seed(), numpy.random.get_state()[1].tolist()
state, python_state = torch.get_rng_state(), random.getstate()
threads, environment = threading.active_count(), dict(os.environ)
dtype, grad, count = torch.get_default_dtype(), torch.is_grad_enabled(), torch.get_num_threads()

def written(path, mode="r", *rest, _open=builtins.open, **options):
    if set(str(mode)) & set("wax+"):
        raise RuntimeError(f"an import wrote {path}")
    return _open(path, mode, *rest, **options)

builtins.open = written
for root in ("geometry", "fields", "toolkit", "tools"):
    package = importlib.import_module("monopart." + root)
    for info in pkgutil.walk_packages(package.__path__, f"monopart.{root}."):
        if info.name.rpartition(".")[2] != "__main__":
            importlib.import_module(info.name)
assert not torch.cuda.is_initialized()
assert torch.initial_seed() == seed, "an import seeded torch"
assert torch.equal(torch.get_rng_state(), state), "an import drew random numbers"
assert numpy.random.get_state()[1].tolist() == numpy_seed, "an import seeded numpy"
assert random.getstate() == python_state, "an import seeded random"
assert threading.active_count() == threads, threading.enumerate()
assert (torch.get_default_dtype(), torch.is_grad_enabled()) == (dtype, grad)
assert torch.get_num_threads() == count
if "warp" in sys.modules:  # the module may be loaded, its runtime must not be
    assert sys.modules["warp"]._src.context.runtime is None, "an import started warp"
print("clean")
"""

LIGHT = """
import sys
import monopart.geometry, monopart.fields, monopart.tools, monopart.toolkit
print([m for m in ("torch", "warp", "kornia", "numpy", "igl", "cv2") if m in sys.modules])
"""

COLD_WARP = """
import importlib, sys
for room in {rooms!r}:
    importlib.import_module(room)
print("warp" in sys.modules)
"""


def _python(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-I", "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.slow
def test_geometry_imports_alone() -> None:
    blocked = (*HEAVY, "monopart.fields", "monopart.toolkit", "monopart.tools")
    assert _python(ALONE.format(root="geometry", blocked=blocked)) == "geometry"


@pytest.mark.slow
def test_fields_import_with_geometry_alone() -> None:
    blocked = (*HEAVY, "monopart.toolkit", "monopart.tools")
    assert _python(ALONE.format(root="fields", blocked=blocked)) == "fields geometry"


@pytest.mark.slow
def test_importing_has_no_effects() -> None:
    assert _python(NO_EFFECTS) == "clean"


def test_packages_load_nothing_heavy() -> None:
    assert _python(LIGHT) == "[]"


@pytest.mark.slow
def test_rooms_do_not_import_warp() -> None:
    """Only the kernels do, and they are imported by the call that needs them."""
    rooms = [
        "monopart." + ".".join(p.relative_to(ROOT).with_suffix("").parts)
        for p in source_files()
        if p.parts[-2] in ("geometry", "fields") and p.name != "__init__.py"
    ]
    assert _python(COLD_WARP.format(rooms=rooms)) == "False"


def test_kernels_are_not_run_at_module_level() -> None:
    """``wp.init`` or a launch at import would compile."""
    for path in source_files():
        text = path.read_text()
        loud = [line for line in text.splitlines() if line.startswith(("wp.init", "wp.launch"))]
        assert not loud, path


def test_import_contracts() -> None:
    """The layers of pyproject.toml, with import-linter."""
    code = "from importlinter.cli import lint_imports_command as run; run()"
    done = subprocess.run(
        [sys.executable, "-c", code, "--no-cache"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


def test_folders_are_the_four() -> None:
    packages = {p.parent.name for p in ROOT.glob("*/__init__.py")}
    assert packages == set(FOLDERS)
