"""monopart-mesh as a user runs it: results, pictures, reports, exit codes, untouched inputs."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mesh_runs import hashes, refused, run
from mesh_samples import cube, tube
from sample_meshes import sample_meshes

from monopart.geometry.errors import InputError
from monopart.tools import cli
from monopart.tools.images import decoded
from monopart.tools.meshio import read_mesh, write_mesh

SNAPSHOT = Path(__file__).parents[1] / "snapshots" / "mesh_cli_help.txt"
SAMPLES = sample_meshes()
SMALL = ("--picture-size", "48")


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
    before = hashes(tmp_path)
    code, out, err = run(capsys, "convert", tmp_path / "in.glb", "-o", tmp_path / "out.ply")
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
    assert before.items() <= hashes(tmp_path).items()


def test_convert_strict_and_scale(tmp_path, capsys):
    write_mesh(tmp_path / "in.npz", tube())
    args = ("convert", tmp_path / "in.npz", "-o", tmp_path / "out.stl")
    code, out, err = run(capsys, *args, "--strict")
    assert code == 1 and "would be lost: weights" in out and "nothing written" in err
    assert [p.name for p in tmp_path.iterdir()] == ["in.npz"]
    code, out, _ = run(capsys, *args[:3], tmp_path / "out.npz", "--strict", "--scale", "100")
    assert code == 0
    np.testing.assert_allclose(read_mesh(tmp_path / "out.npz").verts, tube().verts * 100)
    joints = read_mesh(tmp_path / "out.npz").skeleton.joints
    np.testing.assert_allclose(joints, tube().skeleton.joints * 100)
    for scale in ("0", "-1", "nan", "inf"):
        words = refused(capsys, *args[:3], tmp_path / "b.npz", "--scale", scale)
        assert "--scale: expected a number above 0" in words


def test_options_of_files(tmp_path, capsys):
    write_mesh(tmp_path / "in.ply", cube())
    args = ["convert", tmp_path / "in.ply", "-o", tmp_path / "out.stl", "--text"]
    args += ["--report", tmp_path / "r.json", "--picture", tmp_path / "p.png"]
    assert run(capsys, *args)[0] == 0
    assert (tmp_path / "out.stl").read_bytes().startswith(b"solid cube")
    assert {p.name for p in tmp_path.iterdir()} == {"in.ply", "out.stl", "r.json", "p.png"}
    assert "pass --overwrite" in refused(capsys, *args)
    assert run(capsys, *args, "--overwrite")[0] == 0
    args = ["convert", tmp_path / "in.ply", "-o", tmp_path / "b.obj", "--no-picture"]
    assert run(capsys, *args)[0] == 0
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
        words = refused(capsys, "convert", source, "-o", target, *more)
        assert "inputs are never changed" in words
    report = ["-o", tmp_path / "b.obj", "--report", target, "--overwrite"]
    assert "never changed" in refused(capsys, "convert", source, *report)
    assert source.read_bytes() == before


def test_pictures_beside_an_obj_are_not_replaced(tmp_path, capsys):
    write_mesh(tmp_path / "in.glb", tube())
    (tmp_path / "out.png").write_bytes(b"mine")
    words = refused(capsys, "convert", tmp_path / "in.glb", "-o", tmp_path / "out.obj")
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
        assert words in refused(capsys, *argv)
    for argv in ([], ["nonsense"], ["convert", source], ["remesh", source, "-o", "a.obj"]):
        with pytest.raises(SystemExit) as caught:
            cli.main([str(a) for a in argv])
        assert caught.value.code == 2
    assert [p.name for p in tmp_path.iterdir()] == ["in.obj"]


def test_a_missing_extra_is_said(tmp_path, capsys, monkeypatch):
    write_mesh(tmp_path / "in.obj", cube())
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    args = ["remesh", tmp_path / "in.obj", "-o", tmp_path / "a.obj", "--clean"]
    assert 'pip install "monopart[tools]"' in refused(capsys, *args)
    assert [p.name for p in tmp_path.iterdir()] == ["in.obj"]


def test_interrupt_and_full_disk(tmp_path, capsys, monkeypatch):
    write_mesh(tmp_path / "in.obj", cube())
    args = ["convert", tmp_path / "in.obj", "-o", tmp_path / "a.obj"]

    def stop(*_):
        raise KeyboardInterrupt

    def full(*_):
        raise OSError(28, "No space left on device", "a.obj")

    monkeypatch.setattr("monopart.tools.mesh_job.read_mesh", stop)
    assert run(capsys, *args)[0] == 130
    monkeypatch.undo()
    monkeypatch.setattr(os, "replace", full)
    assert "No space left" in refused(capsys, *args)
    assert [p.name for p in tmp_path.iterdir()] == ["in.obj"]


def test_check_finds_and_passes(tmp_path, capsys):
    for name, code in (("sphere", 0), ("NaN", 1), ("cutting", 1), ("empty", 1)):
        path = tmp_path / f"{name}.ply"
        write_mesh(path, SAMPLES[name])
        report = tmp_path / f"{name}.json"
        picture = tmp_path / f"{name}.png"
        seen = run(capsys, "check", path, "-o", report, "--picture", picture)
        assert seen[0] == code, seen
        assert json.loads(report.read_text())["ok"] == (code == 0)
        assert picture.is_file()
        assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]
    write_mesh(tmp_path / "hole.ply", SAMPLES["hole"])
    assert run(capsys, "check", tmp_path / "hole.ply")[0] == 0
    code, out, _ = run(capsys, "check", tmp_path / "hole.ply", "--strict")
    assert code == 1 and "watertight" in out
    assert not (tmp_path / "hole.json").exists()


def test_remesh_keeps_the_skin(tmp_path, capsys):
    pytest.importorskip("pymeshlab")
    write_mesh(tmp_path / "in.glb", tube(12, 12))
    for n, way in enumerate((["--faces", "60"], ["--edge", "0.1"], ["--clean"])):
        out = tmp_path / f"out{n}.glb"
        code, said, _ = run(capsys, "remesh", tmp_path / "in.glb", "-o", out, *way)
        assert code == 0 and "apart" in said
        back = read_mesh(out)
        np.testing.assert_allclose(back.weights.sum(axis=1), 1, atol=1e-6)
        assert back.skeleton.names == tube().skeleton.names
        assert back.corner_uv is not None and back.texture is not None
        report = json.loads((tmp_path / f"out{n}.remesh.json").read_text())
        assert report["result"]["faces"] == back.num_faces


def test_partition_by_weights_and_table(tmp_path, capsys):
    source, out = tmp_path / "in.npz", tmp_path / "out.glb"
    assert run(capsys, "body", "-o", source, "--faces", "1500", "--no-picture")[0] == 0
    code, said, _ = run(capsys, "partition", source, "-o", out, "--parts", "six", *SMALL)
    assert code == 0 and "left_leg" in said
    with np.load(tmp_path / "out.parts.npz") as parts:
        names, faces = parts["names"].tolist(), parts["face_part"]
    assert len(faces) == 1500 and set(faces.tolist()) == set(range(6))
    report = json.loads((tmp_path / "out.partition.json").read_text())
    assert [p["name"] for p in report["result"]["parts"]] == names
    assert len(np.unique(read_mesh(out).colors.round(3), axis=0)) == 6
    table = tmp_path / "table.json"
    table.write_text(json.dumps({"a": list(range(12)), "b": list(range(12, 24))}))
    args = ["partition", source, "-o", tmp_path / "b.ply", "--table", table, "--band", "0.05"]
    assert run(capsys, *args, "--no-picture")[0] == 0
    with np.load(tmp_path / "b.parts.npz") as parts:
        assert parts["names"].tolist() == ["a", "b"]
        assert parts["band_faces"].shape == (2, 1500)
    for text in ("{", "[1]", '{"a": ["x"]}', '{"a": 3}'):
        table.write_text(text)
        words = refused(capsys, *args[:3], tmp_path / "c.ply", "--table", table)
        assert "table.json" in words and "expected" in words
    assert "legs" in refused(capsys, *args[:3], tmp_path / "c.ply", "--parts", "legs")


def test_bake_every_kind(tmp_path, capsys):
    source, target = tmp_path / "source.glb", tmp_path / "target.obj"
    mesh = tube(10, 12)
    write_mesh(source, mesh)
    write_mesh(target, dataclasses.replace(mesh, weights=None, skeleton=None, colors=None))
    for what, suffix in (("weights", "glb"), ("uv", "obj"), ("colors", "ply"), ("texture", "glb")):
        out = tmp_path / f"{what}.{suffix}"
        more = ["--size", "16"] if what == "texture" else []
        code, said, _ = run(capsys, "bake", what, source, target, "-o", out, *more, *SMALL)
        assert code == 0 and "away from the source" in said
        done = read_mesh(out)
        kept = {"uv": "corner_uv"}.get(what, what)
        assert getattr(done, kept) is not None
        if what == "weights":
            np.testing.assert_allclose(done.weights, mesh.weights, atol=1e-4)
            assert done.skeleton.names == mesh.skeleton.names
    grid = ["bake", "distance", source, "-o", tmp_path / "grid.npz", "--spacing", "0.1"]
    assert "closed surface" in refused(capsys, *grid)
    assert run(capsys, *grid, "--unsigned", *SMALL)[0] == 0
    with np.load(tmp_path / "grid.npz") as arrays:
        assert float(arrays["spacing"]) == 0.1 and (arrays["values"] >= 0).all()
    for argv, words in [
        (["weights", source, "-o", tmp_path / "x.glb"], "TARGET"),
        (["weights", target, source, "-o", tmp_path / "x.glb"], "weights"),
        (["distance", source, target, "-o", tmp_path / "x.npz"], "one mesh"),
        (["distance", source, "-o", tmp_path / "x.ply"], "ends in .npz"),
        (["uv", source, target, "-o", target, "--overwrite"], "never changed"),
    ]:
        assert words in refused(capsys, "bake", *argv)


def test_body_of_a_subject(tmp_path, capsys):
    from monopart.geometry import BodyModel

    out = tmp_path / "anna.npz"
    args = ["body", "-o", out, "--betas", "1.5", "-0.5", "--height", "1.64", "--faces", "2000"]
    code, said, _ = run(capsys, *args, *SMALL)
    assert code == 0 and "height 1.6" in said
    body = BodyModel.load(out)
    assert body.faces.shape == (2000, 3)
    tall = body.v_template[:, 1].max() - body.v_template[:, 1].min()
    assert float(tall) == pytest.approx(1.64, abs=0.02)
    assert run(capsys, "body", "-o", tmp_path / "b.glb", "--source", out, *SMALL)[0] == 0
    rigged = read_mesh(tmp_path / "b.glb")
    assert rigged.skeleton.names[0] == "pelvis" and rigged.weights.shape[1] == 24
    assert "betas" in refused(capsys, "body", "-o", tmp_path / "c.npz", "--betas", *["1"] * 11)
    assert "never changed" in refused(capsys, "body", "-o", out, "--source", out, "--overwrite")
    assert "--overwrite" in refused(capsys, "body", "-o", out)
    write_mesh(tmp_path / "no.npz", cube())
    words = refused(capsys, "body", "-o", tmp_path / "c.npz", "--source", tmp_path / "no.npz")
    assert "weights" in words or "kintree" in words or "shapedirs" in words


def test_unwrap_writes_a_layout(tmp_path, capsys):
    write_mesh(tmp_path / "in.glb", dataclasses.replace(tube(8, 10), corner_uv=None, texture=None))
    out = tmp_path / "out.glb"
    code, said, _ = run(capsys, "unwrap", tmp_path / "in.glb", "-o", out, "--size", "256", *SMALL)
    assert code == 0 and "flips: 0" in said and "overlaps: 0" in said
    done = read_mesh(out)
    assert done.corner_uv.min() >= 0 and done.corner_uv.max() <= 1
    assert done.weights is not None and done.skeleton is not None
    report = json.loads((tmp_path / "out.unwrap.json").read_text())
    assert report["result"]["flips"] == 0 and report["result"]["charts"] >= 1
    words = refused(
        capsys, "unwrap", tmp_path / "in.glb", "-o", tmp_path / "b.glb", "--target", "3"
    )
    assert "target" in words


NO_TORCH = """
import sys
from pathlib import Path
for name in ("torch", "warp", "trimesh", "kornia", "cv2", "tyro"):
    sys.modules[name] = None  # any import of it now raises
from monopart.tools.cli import main
folder = Path(sys.argv[1])
source = str(folder / "in.glb")
for n, argv in enumerate((
    ["convert", source, "-o", "0.ply"],
    ["check", source, "-o", "1.json"],
    ["partition", source, "-o", "2.glb", "--parts", "single"],
    ["bake", "weights", source, source, "-o", "3.glb"],
    ["bake", "distance", source, "-o", "4.npz", "--unsigned", "--spacing", "0.1"],
    ["remesh", source, "-o", "5.glb", "--clean"],
)):
    argv[argv.index("-o") + 1] = str(folder / argv[argv.index("-o") + 1])
    print(argv[0], main([*argv, "--no-picture"]))
"""


@pytest.mark.slow
def test_only_unwrap_and_body_need_torch(tmp_path):
    pytest.importorskip("pymeshlab")
    write_mesh(tmp_path / "in.glb", tube())
    argv = [sys.executable, "-c", NO_TORCH, str(tmp_path)]
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    assert not done.stderr
    codes = [line for line in done.stdout.splitlines() if line.split()[0] in cli.COMMANDS]
    assert [line.split()[1] for line in codes] == ["0", "1", "0", "0", "0", "0"], done.stdout


def test_a_library_that_fails_is_one_line(tmp_path, capsys, monkeypatch):
    write_mesh(tmp_path / "in.obj", cube())

    def fails(*_, **__):
        raise RuntimeError("Factor is exactly singular")

    monkeypatch.delenv("MONOPART_DEBUG", raising=False)
    monkeypatch.setattr("monopart.tools.check.check_mesh", fails)
    assert "MONOPART_DEBUG=1" in refused(capsys, "check", tmp_path / "in.obj")
    monkeypatch.setenv("MONOPART_DEBUG", "1")
    with pytest.raises(RuntimeError, match="singular"):
        cli.main(["check", str(tmp_path / "in.obj")])


def test_the_hints_of_errors_are_commands():
    """What an error advises to run is there."""
    with pytest.raises(InputError) as caught:
        SAMPLES["NaN"].require()
    assert "remesh --clean" in str(caught.value)
    assert "remesh" in cli.COMMANDS
