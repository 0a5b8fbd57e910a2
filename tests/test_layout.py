"""The wheel holds ``monopart.*`` only, and every file of the four source folders."""

import subprocess
import sys
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from building import FOLDERS, ROOT, source_files


def _package_files(names: list[str]) -> set[str]:
    return {n for n in names if ".dist-info/" not in n and not n.endswith("/")}


def test_wheel_is_namespaced(wheel_names: list[str]) -> None:
    assert {n.split("/")[0] for n in _package_files(wheel_names)} == {"monopart"}
    assert "monopart/__init__.py" not in wheel_names


def test_wheel_equals_the_folders(wheel_names: list[str]) -> None:
    source = {
        f"monopart/{p.relative_to(ROOT)}"
        for folder in FOLDERS
        for p in (ROOT / folder).rglob("*")
        if p.is_file() and "__pycache__" not in p.parts
    }
    assert source == _package_files(wheel_names)


def test_wheel_carries_body_licence_and_types(wheel: Path, wheel_names: list[str]) -> None:
    assert "monopart/geometry/assets/body.npz" in wheel_names
    assert {f"monopart/{folder}/py.typed" for folder in FOLDERS} <= set(wheel_names)
    licences = [n for n in wheel_names if n.endswith("licenses/LICENSE")]
    assert len(licences) == 1
    with zipfile.ZipFile(wheel) as archive:
        assert b"Apache License" in archive.read(licences[0])[:400]
    assert wheel.stat().st_size < 16e6


def test_tests_run_on_the_installed_package() -> None:
    """Same modules, same text: the suite would otherwise pass on a stale installation."""
    import monopart.geometry

    installed = Path(monopart.geometry.__file__).parents[1]
    for path in source_files():
        text = (installed / path.relative_to(ROOT)).read_bytes()
        assert text == path.read_bytes(), f"{path.relative_to(ROOT)}: reinstall (make install)"


def test_no_bare_names() -> None:
    assert not [name for name in FOLDERS if name in sys.modules]


@pytest.mark.parametrize("folder", FOLDERS)
def test_bare_import_is_refused(folder: str) -> None:
    code = [sys.executable, "-c", f"import {folder}"]
    done = subprocess.run(code, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert f"import monopart.{folder}, not '{folder}'" in done.stderr


def test_programs_point_at_functions() -> None:
    scripts = metadata.entry_points(group="console_scripts")
    ours = {e.name: e for e in scripts if e.value.startswith("monopart.")}
    assert "monopart" in ours
    for entry in ours.values():
        assert callable(entry.load())
