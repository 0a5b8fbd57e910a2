"""monopart-mesh on what others leave behind: a result or a clear error, inputs left alone."""

import hashlib

import numpy as np
import pytest
from foreign_files import bad_files, good_files, written
from mesh_runs import PREFIX, hashes, refused, run
from sample_meshes import sample_meshes

from monopart.tools.meshio import read_mesh, write_mesh

SAMPLES = sample_meshes()
GOOD, BAD = good_files(), bad_files()


@pytest.mark.parametrize("name", GOOD)
def test_foreign_files_are_read(tmp_path, capsys, name):
    (path,) = written(tmp_path, {name: GOOD[name]})
    code, _, err = run(capsys, "convert", path, "-o", tmp_path / "result.npz", "--no-picture")
    assert code == 0 and not err
    assert path.read_bytes() == GOOD[name]
    mesh = read_mesh(tmp_path / "result.npz")
    assert np.isfinite(mesh.verts).all()
    assert (mesh.num_faces == 0) == (name in ("points.obj", "nothing.stl"))


@pytest.mark.parametrize("name", BAD)
def test_broken_files_arerefused(tmp_path, capsys, name):
    (path,) = written(tmp_path, {name: BAD[name]})
    out = tmp_path / "result.npz"
    for argv in (["convert", path, "-o", out], ["check", path, "-o", tmp_path / "r.json"]):
        words = refused(capsys, *argv)
        assert path.name in words and "expected" in words and len(words) < 500
    assert hashes(tmp_path) == {name: hashlib.sha256(BAD[name]).hexdigest()}


WORK = {
    "unwrap": (["unwrap", "--no-picture"], "r.obj"),
    "partition": (["partition", "--no-picture"], "r.ply"),
    "distance": (["bake", "distance", "--no-picture", "--unsigned", "--spacing", "0.25"], "r.npz"),
    "check": (["check", "--picture-size", "64"], "r.json"),
    "convert": (["convert", "--picture-size", "64"], "r.glb"),
    "clean": (["remesh", "--no-picture", "--clean"], "r.npz"),
    "decimate": (["remesh", "--no-picture", "--faces", "8"], "r.npz"),
    "isotropic": (["remesh", "--no-picture", "--edge", "0.5"], "r.obj"),
}


@pytest.mark.parametrize("name", SAMPLES)
@pytest.mark.parametrize("work", WORK)
def test_every_command_on_every_mesh(tmp_path, capsys, monkeypatch, name, work):
    """A result or a clear error; the input stays as it is, and nothing half done is left."""
    if "remesh" in WORK[work][0]:
        pytest.importorskip("pymeshlab")
    source = tmp_path / "in.ply"
    write_mesh(source, SAMPLES[name])
    before = source.read_bytes()
    argv, target = WORK[work]
    monkeypatch.setenv("MONOPART_DEBUG", "1")  # what fails is seen, not reported
    out = tmp_path / target
    code, _, err = run(capsys, *argv, source, "-o", out)
    assert source.read_bytes() == before
    assert code in (0, 1, 2)
    names = {p.name for p in tmp_path.iterdir()} - {"in.ply"}
    if code == 2:
        assert err.startswith(PREFIX) and "expected" in err and len(err.splitlines()) == 1
        assert not names
    else:
        assert not err and out.name in names
        assert not [n for n in names if n.startswith(".")]
