"""monopart-mesh on what others leave behind: a result or a clear error, inputs left alone."""

import dataclasses
import hashlib
import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
from foreign_files import bad_files, good_files, written
from mesh_runs import PREFIX, hashes, refused, run
from sample_meshes import sample_meshes

from monopart.tools.bench import foreign
from monopart.tools.bench.cli import main as bench
from monopart.tools.meshio import read_mesh, write_mesh

SHIPPED = {
    "pymeshlab": ("tests/sample_meshes", ("cube.obj", "bone.ply", "airplane.obj")),
    "pyvista": ("examples", ("sphere.ply", "nut.ply")),
}
"""Meshes in packages: the folder and some of its smaller files."""
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


@pytest.mark.slow
@pytest.mark.parametrize("package", SHIPPED)
def test_meshes_that_others_ship(package):
    """All commands: a result or a clear error, inputs left alone, layouts without a fault."""
    found = importlib.util.find_spec(package)
    if found is None or found.origin is None:
        pytest.skip(f"{package} is not installed, which has the meshes")
    folder, names = SHIPPED[package]
    for name in names:
        path = Path(found.origin).parent / folder / name
        if not path.is_file():
            pytest.skip(f"this {package} comes without {folder}/{name}")
        before = path.read_bytes()
        done = {run.command: run for run in foreign.runs(name, path)}
        assert path.read_bytes() == before
        assert set(done) == set(foreign.COMMANDS)
        for run_ in done.values():
            assert "Traceback" not in run_.words
            assert run_.code in (0, 1, 2), (run_.command, run_.words)
            assert run_.code < 2 or "expected" in run_.words
            assert run_.code == 2 or run_.report["input"][0]["faces"] > 0
        layout = done["unwrap"].report["result"]
        assert done["unwrap"].code == layout["flips"] == layout["overlaps"] == 0
        assert 4 <= layout["symmetric_dirichlet"] <= 4.0301 and layout["charts"] <= 35


def _broken_program(argv):
    """Crashes on one mesh, writes into another, and is fine with the rest."""
    name = Path(argv[1]).name
    if name == "crash.obj":
        raise RuntimeError("boom")
    if name == "change.obj":
        Path(argv[1]).write_bytes(b"")
    return 0


@pytest.mark.slow
def test_the_bench_of_meshes_tells_crashes_and_changed_inputs(tmp_path, capsys, monkeypatch):
    folder, page = tmp_path / "shop", tmp_path / "page.md"
    folder.mkdir()
    written(folder, {name: GOOD[name] for name in ("quad.obj", "many.ply", "nothing.stl")})
    written(folder, {"empty.obj": b""})
    page.write_text("top\n<!-- meshes: begin -->\nold\n<!-- meshes: end -->\nend\n")
    monkeypatch.setattr(
        foreign, "COMMANDS", {name: foreign.COMMANDS[name] for name in ("check", "unwrap")}
    )
    argv = ["meshes", str(folder), "--out", str(tmp_path / "out"), "--into", str(page)]
    assert bench(argv) is None
    text = page.read_text()
    assert text.startswith("top\n") and text.endswith("\nend\n") and "old" not in text
    assert "4 meshes, 8 runs: " in text and "3 refused in one line, 0 tracebacks" in text
    assert "| shop: quad.obj | 2 | ok | " in text
    assert "`unwrap`: monopart-mesh: error: " in text and "found an empty file" in text
    assert len(json.loads((tmp_path / "out" / "meshes.json").read_text())) == 8
    assert bench([*argv, "--each", "2"]) is None
    assert "2 meshes, 4 runs: " in page.read_text()
    written(folder, dict.fromkeys(("crash.obj", "change.obj"), GOOD["quad.obj"]))
    monkeypatch.setattr(foreign, "mesh_program", _broken_program)
    assert bench(argv) is None
    text = page.read_text()
    assert "2 tracebacks, 1 inputs changed" in text and "RuntimeError: boom" in text
    capsys.readouterr()
    assert bench(["meshes", str(tmp_path / "none")]) == 2
    assert "expected a folder with meshes, found none" in capsys.readouterr().err
