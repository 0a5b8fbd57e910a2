"""monopart-mesh as a user runs it: results, pictures, reports, exit codes, untouched inputs."""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from foreign_files import bad_files, good_files, written
from mesh_samples import cube, tube
from sample_meshes import sample_meshes

from monopart.geometry.errors import InputError
from monopart.tools import cli
from monopart.tools.images import decoded
from monopart.tools.meshio import read_mesh, write_mesh

SNAPSHOT = Path(__file__).parents[1] / "snapshots" / "mesh_cli_help.txt"
PREFIX = "monopart-mesh: error: "
SAMPLES = sample_meshes()
GOOD, BAD = good_files(), bad_files()


@pytest.fixture(autouse=True)
def _no_plain_progress(monkeypatch):
    """On a busy machine even small work takes the ten seconds after which a line is printed."""
    monkeypatch.setattr("monopart.tools.progress.PLAIN_EVERY", 1e9)


def _run(capsys, *argv):
    """Exit code, stdout and stderr."""
    capsys.readouterr()
    code = cli.main([str(a) for a in argv])
    seen = capsys.readouterr()
    return code or 0, seen.out, seen.err


def _refused(capsys, *argv):
    """The one line of an error, without its prefix."""
    code, _, err = _run(capsys, *argv)
    lines = err.splitlines()
    assert code == 2 and len(lines) == 1 and lines[0].startswith(PREFIX), err
    return lines[0].removeprefix(PREFIX)


def _hashes(folder):
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.iterdir()}


def _help(*argv):
    code = "import sys; from monopart.tools.cli import main; main(sys.argv[1:])"
    done = subprocess.run(
        [sys.executable, "-c", code, *argv],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"COLUMNS": "100", "NO_COLOR": "1"},
    )
    assert done.returncode == 0 and not done.stderr, done.stderr
    return done.stdout


def test_help_is_the_snapshot():
    """After a deliberate change: UPDATE_SNAPSHOTS=1 pytest tests/tools/test_mesh_cli.py."""
    text = "\n\n".join([_help("--help"), *(_help(name, "--help") for name in cli.COMMANDS)])
    if os.environ.get("UPDATE_SNAPSHOTS"):
        SNAPSHOT.write_text(text)
    assert text == SNAPSHOT.read_text()


def test_help_loads_nothing_heavy():
    code = """
import sys
from monopart.tools import cli
try:
    cli.main(["convert", "--help"])
except SystemExit:
    pass
print([m for m in ("numpy", "torch", "rich", "igl", "trimesh") if m in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("[]\n")


def test_convert_writes_mesh_picture_and_report(tmp_path, capsys):
    mesh = tube()
    write_mesh(tmp_path / "in.glb", mesh)
    before = _hashes(tmp_path)
    code, out, err = _run(capsys, "convert", tmp_path / "in.glb", "-o", tmp_path / "out.ply")
    assert code == 0 and not err
    assert "lost: texture: .ply cannot hold them" in out
    back = read_mesh(tmp_path / "out.ply")
    np.testing.assert_allclose(back.weights, mesh.weights, atol=1e-6)
    report = json.loads((tmp_path / "out.convert.json").read_text())
    assert report["ok"] and report["command"] == "convert"
    assert report["output"]["lost"] == ["texture: .ply cannot hold them"]
    assert report["files"] == ["out.ply", "out.convert.png", "out.convert.json"]
    assert report["input"][0]["vertices"] == mesh.num_verts
    picture = decoded((tmp_path / "out.convert.png").read_bytes(), "picture")
    assert 0.02 < (picture < 0.9).any(axis=2).mean() < 0.9
    assert before.items() <= _hashes(tmp_path).items()


def test_convert_strict_and_scale(tmp_path, capsys):
    write_mesh(tmp_path / "in.npz", tube())
    args = ("convert", tmp_path / "in.npz", "-o", tmp_path / "out.stl")
    code, out, err = _run(capsys, *args, "--strict")
    assert code == 1 and "would be lost: weights" in out and "nothing written" in err
    assert [p.name for p in tmp_path.iterdir()] == ["in.npz"]
    code, out, _ = _run(capsys, *args[:3], tmp_path / "out.npz", "--strict", "--scale", "100")
    assert code == 0
    np.testing.assert_allclose(read_mesh(tmp_path / "out.npz").verts, tube().verts * 100)
    joints = read_mesh(tmp_path / "out.npz").skeleton.joints
    np.testing.assert_allclose(joints, tube().skeleton.joints * 100)
    for scale in ("0", "-1", "nan", "inf"):
        words = _refused(capsys, *args[:3], tmp_path / "b.npz", "--scale", scale)
        assert "--scale: expected a number above 0" in words


def test_options_of_files(tmp_path, capsys):
    write_mesh(tmp_path / "in.ply", cube())
    args = ["convert", tmp_path / "in.ply", "-o", tmp_path / "out.stl", "--text"]
    args += ["--report", tmp_path / "r.json", "--picture", tmp_path / "p.png"]
    assert _run(capsys, *args)[0] == 0
    assert (tmp_path / "out.stl").read_bytes().startswith(b"solid cube")
    assert {p.name for p in tmp_path.iterdir()} == {"in.ply", "out.stl", "r.json", "p.png"}
    assert "pass --overwrite" in _refused(capsys, *args)
    assert _run(capsys, *args, "--overwrite")[0] == 0
    args = ["convert", tmp_path / "in.ply", "-o", tmp_path / "b.obj", "--no-picture"]
    assert _run(capsys, *args)[0] == 0
    assert not (tmp_path / "b.convert.png").exists()


@pytest.mark.parametrize("link", ["same", "symlink", "hardlink", "dots"])
def test_an_input_is_never_replaced(tmp_path, capsys, link):
    source = tmp_path / "in.obj"
    write_mesh(source, cube())
    target = {"same": source, "dots": tmp_path / "x" / ".." / "in.obj"}.get(
        link, tmp_path / "l.obj"
    )
    (tmp_path / "x").mkdir()
    if link == "symlink":
        target.symlink_to(source)
    elif link == "hardlink":
        target.hardlink_to(source)
    before = source.read_bytes()
    for more in ([], ["--overwrite"]):
        words = _refused(capsys, "convert", source, "-o", target, *more)
        assert "inputs are never changed" in words
    report = ["-o", tmp_path / "b.obj", "--report", target, "--overwrite"]
    assert "never changed" in _refused(capsys, "convert", source, *report)
    assert source.read_bytes() == before


def test_pictures_beside_an_obj_are_not_replaced(tmp_path, capsys):
    write_mesh(tmp_path / "in.glb", tube())
    (tmp_path / "out.png").write_bytes(b"mine")
    words = _refused(capsys, "convert", tmp_path / "in.glb", "-o", tmp_path / "out.obj")
    assert "out.png" in words and "--overwrite" in words
    assert (tmp_path / "out.png").read_bytes() == b"mine"
    assert not (tmp_path / "out.obj").exists()


def test_wrong_arguments(tmp_path, capsys):
    write_mesh(tmp_path / "in.obj", cube())
    source = tmp_path / "in.obj"
    for argv, words in [
        (["convert", tmp_path / "no.obj", "-o", tmp_path / "a.obj"], "found nothing"),
        (["convert", source, "-o", tmp_path / "no" / "a.obj"], "existing folder"),
        (["convert", source, "-o", tmp_path / "a.fbx"], "found .fbx"),
        (["convert", tmp_path, "-o", tmp_path / "a.obj"], "found no ending"),
        (["convert", source, "-o", tmp_path / "a.obj", "--picture", tmp_path / "a.obj"], "twice"),
        (["remesh", source, "-o", tmp_path / "a.obj", "--faces", "99"], "from 4 to 11"),
    ]:
        if argv[0] == "remesh":
            pytest.importorskip("pymeshlab")
        assert words in _refused(capsys, *argv)
    for argv in ([], ["nonsense"], ["convert", source], ["remesh", source, "-o", "a.obj"]):
        with pytest.raises(SystemExit) as caught:
            cli.main([str(a) for a in argv])
        assert caught.value.code == 2
    assert [p.name for p in tmp_path.iterdir()] == ["in.obj"]


def test_a_missing_extra_is_said(tmp_path, capsys, monkeypatch):
    write_mesh(tmp_path / "in.obj", cube())
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    args = ["remesh", tmp_path / "in.obj", "-o", tmp_path / "a.obj", "--clean"]
    assert 'pip install "monopart[tools]"' in _refused(capsys, *args)
    assert [p.name for p in tmp_path.iterdir()] == ["in.obj"]


def test_interrupt_and_full_disk(tmp_path, capsys, monkeypatch):
    write_mesh(tmp_path / "in.obj", cube())
    args = ["convert", tmp_path / "in.obj", "-o", tmp_path / "a.obj"]

    def stop(*_):
        raise KeyboardInterrupt

    def full(*_):
        raise OSError(28, "No space left on device", "a.obj")

    monkeypatch.setattr("monopart.tools.mesh_job.read_mesh", stop)
    assert _run(capsys, *args)[0] == 130
    monkeypatch.undo()
    monkeypatch.setattr(os, "replace", full)
    assert "No space left" in _refused(capsys, *args)
    assert [p.name for p in tmp_path.iterdir()] == ["in.obj"]


def test_check_finds_and_passes(tmp_path, capsys):
    for name, code in (("sphere", 0), ("NaN", 1), ("cutting", 1), ("empty", 1)):
        path = tmp_path / f"{name}.ply"
        write_mesh(path, SAMPLES[name])
        report = tmp_path / f"{name}.json"
        picture = tmp_path / f"{name}.png"
        seen = _run(capsys, "check", path, "-o", report, "--picture", picture)
        assert seen[0] == code, seen
        assert json.loads(report.read_text())["ok"] == (code == 0)
        assert picture.is_file()
        assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]
    write_mesh(tmp_path / "hole.ply", SAMPLES["hole"])
    assert _run(capsys, "check", tmp_path / "hole.ply")[0] == 0
    code, out, _ = _run(capsys, "check", tmp_path / "hole.ply", "--strict")
    assert code == 1 and "watertight" in out
    assert not (tmp_path / "hole.json").exists()


def test_remesh_keeps_the_skin(tmp_path, capsys):
    pytest.importorskip("pymeshlab")
    write_mesh(tmp_path / "in.glb", tube(12, 12))
    for n, way in enumerate((["--faces", "60"], ["--edge", "0.1"], ["--clean"])):
        out = tmp_path / f"out{n}.glb"
        code, said, _ = _run(capsys, "remesh", tmp_path / "in.glb", "-o", out, *way)
        assert code == 0 and "apart" in said
        back = read_mesh(out)
        np.testing.assert_allclose(back.weights.sum(axis=1), 1, atol=1e-6)
        assert back.skeleton.names == tube().skeleton.names
        assert back.corner_uv is not None and back.texture is not None
        report = json.loads((tmp_path / f"out{n}.remesh.json").read_text())
        assert report["result"]["faces"] == back.num_faces


@pytest.mark.parametrize("name", GOOD)
def test_foreign_files_are_read(tmp_path, capsys, name):
    (path,) = written(tmp_path, {name: GOOD[name]})
    code, _, err = _run(capsys, "convert", path, "-o", tmp_path / "result.npz", "--no-picture")
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
        words = _refused(capsys, *argv)
        assert path.name in words and "expected" in words and len(words) < 500
    assert _hashes(tmp_path) == {name: hashlib.sha256(BAD[name]).hexdigest()}


WORK = {
    "check": (["check", "--picture-size", "64"], "r.json"),
    "convert": (["convert", "--picture-size", "64"], "r.glb"),
    "clean": (["remesh", "--no-picture", "--clean"], "r.npz"),
    "decimate": (["remesh", "--no-picture", "--faces", "8"], "r.npz"),
    "isotropic": (["remesh", "--no-picture", "--edge", "0.5"], "r.obj"),
}


@pytest.mark.parametrize("name", SAMPLES)
@pytest.mark.parametrize("work", WORK)
def test_every_command_on_every_mesh(tmp_path, capsys, name, work):
    """A result or a clear error; the input stays as it is, and nothing half done is left."""
    if "remesh" in WORK[work][0]:
        pytest.importorskip("pymeshlab")
    source = tmp_path / "in.ply"
    write_mesh(source, SAMPLES[name])
    before = source.read_bytes()
    argv, target = WORK[work]
    out = tmp_path / target
    code, _, err = _run(capsys, argv[0], source, "-o", out, *argv[1:])
    assert source.read_bytes() == before
    assert code in (0, 1, 2)
    names = {p.name for p in tmp_path.iterdir()} - {"in.ply"}
    if code == 2:
        assert err.startswith(PREFIX) and "expected" in err and len(err.splitlines()) == 1
        assert not names
    else:
        assert not err and out.name in names
        assert not [n for n in names if n.startswith(".")]


def test_the_hints_of_errors_are_commands():
    """What an error advises to run is there."""
    with pytest.raises(InputError) as caught:
        SAMPLES["NaN"].require()
    assert "remesh --clean" in str(caught.value)
    assert "remesh" in cli.COMMANDS
