"""Build the wheel, and list what is in the tree."""

import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("geometry", "fields", "toolkit", "tools")


def build_wheel(root: Path, out: Path) -> Path:
    """Build the wheel from a copy, so that no ``build`` folder is read from or left in the tree."""
    copy = out / "source"
    clutter = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for folder in FOLDERS:
        shutil.copytree(root / folder, copy / folder, ignore=clutter)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(root / name, copy / name)
    build = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation"]
    done = subprocess.run(
        [*build, "-w", str(out), str(copy)], check=False, capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(done.stderr)
    (wheel,) = out.glob("*.whl")
    return wheel


def tracked_files() -> list[Path]:
    """What git tracks or would track; everything but clutter where the tree is no git checkout."""
    listing = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if listing.returncode == 0:
        files = [ROOT / name for name in listing.stdout.split("\0") if name]
    else:
        clutter = {".venv", "build", "dist", "runs", "site", "__pycache__", ".git"}
        files = [p for p in ROOT.rglob("*") if not clutter & set(p.parts)]
    return [p for p in files if p.is_file()]


def source_files() -> list[Path]:
    """The Python files of the four folders."""
    return sorted(p for folder in FOLDERS for p in (ROOT / folder).rglob("*.py"))
