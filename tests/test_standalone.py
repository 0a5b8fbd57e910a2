"""Geometry installs and works in a fresh environment with its declared dependencies alone."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

PROBE = """
import importlib, importlib.util, pkgutil, sys
absent = ("cv2", "trimesh", "tyro", "rich", "safetensors", "pymeshlab", "beartype", "pytest")
absent += ("monopart.fields", "monopart.toolkit", "monopart.tools")
found = [name for name in absent if importlib.util.find_spec(name)]
if found:
    sys.exit(f"not a bare environment: {found}")
import monopart.geometry as g
for info in pkgutil.walk_packages(g.__path__, "monopart.geometry."):
    importlib.import_module(info.name)
import torch
body = g.BodyModel.default()
rest = g.BodyPose.zeros(body)
shift = torch.tensor([0.0, 1.0, 0.0])
posed = body(g.BodyPose(rest.pose, rest.betas, rest.rotation, shift))
blended = g.blend_transforms(posed.transforms, body.weights)
error = (g.skin(body.v_template, blended) + shift - posed.verts_world).abs().max()
print(g.__file__)
print("skinned", bool(error < 1e-6))
"""


def _closure(names: list[str]) -> set[str]:
    """Distributions that the named ones need, extras left out."""
    done: set[str] = set()
    todo = list(names)
    while todo:
        name = todo.pop()
        if name in done:
            continue
        done.add(name)
        needs = [Requirement(line) for line in metadata.requires(name) or []]
        todo += [n.name.lower() for n in needs if not n.marker or n.marker.evaluate({"extra": ""})]
    return done


def _link(distribution: str, site: Path) -> None:
    """Make a distribution of this environment visible in another, without a copy."""
    here = metadata.distribution(distribution)
    tops = {f.parts[0] for f in here.files or [] if f.parts[0] not in ("..", "__pycache__")}
    for top in tops:
        source, target = Path(str(here.locate_file(top))), site / top
        if source.exists() and not target.exists():
            target.symlink_to(source)


@pytest.mark.slow
def test_geometry_alone_in_a_fresh_environment(wheel: Path, tmp_path: Path) -> None:
    venv.EnvBuilder(symlinks=True, with_pip=False).create(tmp_path / "env")
    version = f"python{sysconfig.get_python_version()}"
    site = tmp_path / "env" / "lib" / version / "site-packages"
    python = tmp_path / "env" / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "-q", "--no-index"]
    done = subprocess.run(
        [*pip, "--no-deps", str(wheel)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    for folder in ("fields", "toolkit", "tools"):
        shutil.rmtree(site / "monopart" / folder)
    needs = [Requirement(line) for line in metadata.requires("monopart") or []]
    for name in _closure([n.name.lower() for n in needs if "extra" not in str(n.marker)]):
        _link(name, site)
    environment = {
        k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV"))
    }
    done = subprocess.run(
        [str(python), "-I", "-c", PROBE],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    where, verdict = done.stdout.splitlines()
    assert where.startswith(str(site))
    assert verdict == "skinned True"
