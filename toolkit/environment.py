"""Facts about the machine and the software of a run, without names of users, hosts or folders."""

import os
import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

_PACKAGES = {
    "monopart": ("monopart",),
    "torch": ("torch",),
    "warp": ("warp-lang",),
    "kornia": ("kornia",),
    "numpy": ("numpy",),
    "opencv": (
        "opencv-contrib-python-headless",
        "opencv-contrib-python",
        "opencv-python-headless",
        "opencv-python",
    ),
}


def _version(names: tuple[str, ...]) -> str | None:
    """Version of the first installed distribution among `names`."""
    for name in names:
        try:
            return metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return None


def _cpu_model() -> str | None:
    """Name of the processor as the system states it."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.lower().startswith(("model name", "hardware")):
                return line.partition(":")[2].strip() or None
    except OSError:  # not Linux
        pass
    return platform.processor() or platform.machine() or None


def _system() -> str:
    """Name of the operating system; a kernel's release string may carry names of its builder."""
    try:
        return platform.freedesktop_os_release()["PRETTY_NAME"]
    except (OSError, KeyError):  # not Linux, or a bare container
        return f"{platform.system()} {platform.mac_ver()[0]}".strip()


def _memory_bytes() -> int | None:
    """Main memory in bytes."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):  # not POSIX
        return None


def _git_commit() -> str | None:
    """Commit of the source tree that runs, with "+changes" when it differs; None if installed."""
    root = Path(__file__).resolve().parents[1]
    if not (root / ".git").exists():  # an installed wheel: a repository above it is another one
        return None
    try:
        ask = ["git", "-C", str(root)]
        head = subprocess.run(
            [*ask, "rev-parse", "--short=12", "HEAD"],
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
        dirty = subprocess.run(
            [*ask, "status", "--porcelain"], capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):  # no git, no commit yet, or a slow disk
        return None
    return head.stdout.strip() + ("+changes" if dirty.stdout.strip() else "")


def peak_memory_bytes() -> int | None:
    """Largest resident memory of this process so far, in bytes; None where it is not known."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def usable_cores() -> int:
    """Processor cores that this process may run on: those of ``taskset`` or a container.

    >>> usable_cores() >= 1
    True
    """
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else (os.cpu_count() or 1)


def environment_facts() -> dict[str, Any]:
    """Collect what a reader needs to judge a run's timings and to repeat it.

    Returns:
        A mapping that JSON can hold: python, os, machine, cpu, cores (usable by this process),
        memory_gib, packages (name to version, None if absent), git_commit, threads (of torch),
        cuda (name of the device, None if there is none).

    >>> facts = environment_facts()
    >>> facts["cores"] >= 1 and "torch" in facts["packages"]
    True
    """
    import torch

    memory = _memory_bytes()
    return {
        "python": platform.python_version(),
        "os": _system(),
        "machine": platform.machine(),
        "cpu": _cpu_model(),
        "cores": usable_cores(),
        "memory_gib": None if memory is None else round(memory / 2**30, 1),
        "packages": {name: _version(names) for name, names in _PACKAGES.items()},
        "git_commit": _git_commit(),
        "threads": torch.get_num_threads(),
        "cuda": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }
