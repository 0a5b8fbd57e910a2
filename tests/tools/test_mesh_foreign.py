"""monopart-mesh on what others leave behind: a result or a clear error, inputs left alone."""

import dataclasses
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
def test_broken_files_are_refused(tmp_path, capsys, name):
    (path,) = written(tmp_path, {name: BAD[name]})
    out = tmp_path / "result.npz"
    for argv in (["convert", path, "-o", out], ["check", path, "-o", tmp_path / "r.json"]):
        words = refused(capsys, *argv)
        assert path.name in words and len(words) < 500
        said, _, fix = words.rpartition("; ")
        assert "expected" in said and "found" in said and fix
    assert hashes(tmp_path) == {name: hashlib.sha256(BAD[name]).hexdigest()}


def test_what_is_not_kept_of_an_obj_is_said(tmp_path, capsys):
    """A broken picture and colours of some vertices are no reason to refuse the shape."""
    names = ("no_picture.obj", "some_colors.obj")
    for path in written(tmp_path, {name: GOOD[name] for name in names}):
        code, out, _ = run(capsys, "check", path)
        assert code in (0, 1)
        assert ("note: not read: no_picture.obj: expected a PNG" in out) == (path.name == names[0])
        assert ("options of the picture: not kept" in out) == (path.name == names[0])
        assert ("colors: not on every vertex, not read" in out) == (path.name == names[1])
        assert " at 0x" not in out  # no object of ours is of interest


def test_colors_of_an_obj_may_be_bytes(tmp_path):
    for largest in (1.0, 255.0, 1.5):  # 1.5 is brighter than white, not a byte
        path = tmp_path / "colors.obj"
        path.write_text(f"v 0 0 0 {largest} 0 0\nv 1 0 0 0 0 0\nv 0 1 0 0 0 0\nf 1 2 3\n")
        colors = read_mesh(path).colors
        assert colors is not None
        assert colors.max() == (1.5 if largest == 1.5 else 1.0)


CUBE = dataclasses.replace(SAMPLES["cube"], name="a name of its own")
REFUSED = {
    "far": dataclasses.replace(CUBE, verts=CUBE.verts * 1e300),
    "flat": dataclasses.replace(CUBE, verts=CUBE.verts * np.array([1, 0, 0])),
    "points": dataclasses.replace(CUBE, faces=np.zeros((0, 3))),
}
WORDS = {  # nothing where the tool gives a result
    "far": ("coordinates up to 1e+75", "coordinates up to 1e+75", "coordinates up to 1e+75"),
    "flat": ("", "a surface with area", "triangles with an area"),
    "points": ("at least one triangle", "at least one triangle", "triangles with finite corners"),
}


@pytest.mark.parametrize("name", REFUSED)
@pytest.mark.parametrize(("place", "work"), [(0, "unwrap"), (1, "partition"), (2, "clean")])
def test_errors_name_the_file_not_only_the_mesh(tmp_path, capsys, monkeypatch, name, place, work):
    if work == "clean":
        pytest.importorskip("pymeshlab")
    monkeypatch.setenv("MONOPART_DEBUG", "1")
    source = tmp_path / "in.npz"
    write_mesh(source, REFUSED[name])
    argv, target = WORK[work]
    if not WORDS[name][place]:
        assert run(capsys, *argv, source, "-o", tmp_path / target)[0] == 0
        return
    words = refused(capsys, *argv, source, "-o", tmp_path / target)
    assert words.startswith(f"{source}: ") and WORDS[name][place] in words


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
