"""Files are whole or absent; the environment names no person, host or folder."""

import dataclasses
import getpass
import json
import os
import platform
from pathlib import Path

import numpy as np
import pytest

from monopart.geometry.errors import InputError
from monopart.toolkit import atomic
from monopart.toolkit.environment import environment_facts, peak_memory_bytes


def test_write_and_overwrite_leave_one_file(tmp_path):
    path = tmp_path / "a.txt"
    assert atomic.write_text(path, "één\n") == path
    atomic.write_bytes(str(path), b"two")
    assert path.read_bytes() == b"two"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_new_file_follows_the_umask(tmp_path):
    old = os.umask(0o022)
    try:
        path = atomic.write_text(tmp_path / "a.txt", "x")
    finally:
        os.umask(old)
    assert path.stat().st_mode & 0o777 == 0o644


def test_interrupted_write_keeps_the_old_file(tmp_path):
    path = atomic.write_text(tmp_path / "a.txt", "old")
    with pytest.raises(KeyboardInterrupt), atomic.replacing(path) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".txt"
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_failed_rename_keeps_the_old_file(tmp_path, monkeypatch):
    path = atomic.write_text(tmp_path / "a.txt", "old")

    def full(*_args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="space"):
        atomic.write_text(path, "new")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_missing_folder_and_folder_as_file(tmp_path):
    with pytest.raises(InputError, match="folder"):
        atomic.write_text(tmp_path / "none" / "a.txt", "x")
    with pytest.raises(InputError, match="file name"):
        atomic.write_text(tmp_path, "x")
    with pytest.raises(InputError, match="found none"), atomic.replacing(tmp_path / "b"):
        pass


@dataclasses.dataclass(frozen=True)
class _Config:
    rate: float = 0.5
    parts: tuple[int, ...] = (1, 2)


def test_json_converts_what_a_run_holds(tmp_path):
    value = {
        "config": _Config(),
        "array": np.arange(3),
        "number": np.float32(0.5),
        "path": Path("a") / "b",
        "none": None,
        "flag": True,
        3: "é",
    }
    path = atomic.write_json(tmp_path / "a.json", value)
    assert json.loads(path.read_text(encoding="utf-8")) == {
        "config": {"rate": 0.5, "parts": [1, 2]},
        "array": [0, 1, 2],
        "number": 0.5,
        "path": os.path.join("a", "b"),
        "none": None,
        "flag": True,
        "3": "é",
    }


def test_json_refuses_or_nulls_what_is_not_finite(tmp_path):
    value = {"full": {"psnr": [1.0, float("nan")]}}
    with pytest.raises(InputError, match=r"a\.json\.full\.psnr\[1\].*nan"):
        atomic.write_json(tmp_path / "a.json", value)
    assert list(tmp_path.iterdir()) == []
    path = atomic.write_json(tmp_path / "a.json", value, nonfinite="null")
    assert json.loads(path.read_text()) == {"full": {"psnr": [1.0, None]}}
    with pytest.raises(InputError, match="object"):
        atomic.write_json(tmp_path / "b.json", {"x": object()})


def test_environment_is_json_and_names_nobody(tmp_path):
    facts = environment_facts()
    text = atomic.write_json(tmp_path / "environment.json", facts).read_text()
    assert set(facts) >= {"python", "os", "cpu", "cores", "memory_gib", "packages", "threads"}
    assert facts["packages"]["torch"] and facts["packages"]["opencv"]
    assert facts["git_commit"] is None or len(facts["git_commit"]) >= 12
    assert str(Path.home()) not in text or str(Path.home()) == "/"
    words = {w.strip('",') for w in text.split()}
    assert platform.node() not in words
    assert getpass.getuser() not in words
    assert not [w for w in words if w.startswith("/")]


def test_peak_memory_is_plausible():
    peak = peak_memory_bytes()
    assert peak is None or 10 * 2**20 < peak < 2**40
