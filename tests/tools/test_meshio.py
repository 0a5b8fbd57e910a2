"""Every format keeps what it says it keeps, and says what it loses."""

import dataclasses
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from building import ROOT
from mesh_samples import cube, many_joints, tube

from monopart.geometry.errors import InputError
from monopart.tools.mesh_npz import joint_regressor
from monopart.tools.meshio import FORMATS, Mesh, Skeleton, losses, read_mesh, write_mesh

SINGLE = (".stl", ".glb", ".gltf")
CASES = [(suffix, text) for suffix in FORMATS for text in (False, True)]


def _tolerance(suffix):
    return 1e-6 if suffix in SINGLE else 1e-15


def _corners(mesh):
    return mesh.verts[mesh.faces]


@pytest.mark.parametrize(("suffix", "text"), CASES)
def test_every_attribute_makes_the_round_trip(tmp_path, suffix, text):
    mesh = tube()
    said = write_mesh(tmp_path / f"ü b{suffix}", mesh, text=text)
    back = read_mesh(tmp_path / f"ü b{suffix}")
    holds = FORMATS[suffix].holds
    lost = {line.split(":")[0] for line in said}
    assert not back.notes
    if suffix == ".stl":
        np.testing.assert_allclose(_corners(back), _corners(mesh), atol=1e-6)
    else:
        assert back.name == mesh.name
        np.testing.assert_array_equal(back.faces, mesh.faces)
        np.testing.assert_allclose(back.verts, mesh.verts, rtol=0, atol=_tolerance(suffix))
    for field, word in {"corner_uv": "texture coordinates"}.items():
        assert (getattr(back, field) is None) == (word in lost)
    for field in ("weights", "colors", "texture"):
        value = getattr(back, field)
        assert (value is None) == (field in lost) == (field not in holds)
        if value is not None:
            atol = 1e-6 if suffix in (*SINGLE, ".ply") else 1e-12
            np.testing.assert_allclose(value, getattr(mesh, field), rtol=0, atol=atol)
    if back.corner_uv is not None:
        atol = 1e-6 if suffix in (*SINGLE, ".ply") else 0
        np.testing.assert_allclose(back.corner_uv, mesh.corner_uv, rtol=0, atol=atol)
    assert (back.skeleton is None) == ("skeleton" in lost)
    if back.skeleton:
        assert back.skeleton.names == mesh.skeleton.names
        assert back.skeleton.parents == mesh.skeleton.parents
        np.testing.assert_allclose(back.skeleton.joints, mesh.skeleton.joints, rtol=0, atol=1e-12)


@pytest.mark.parametrize("suffix", sorted(FORMATS))
@pytest.mark.parametrize("field", ["corner_uv", "weights", "skeleton", "colors", "texture"])
def test_one_attribute_alone(tmp_path, suffix, field):
    """What a format holds only in company is said."""
    whole = tube()
    mesh = Mesh(whole.verts, whole.faces, **{field: getattr(whole, field)})
    said = " ".join(write_mesh(tmp_path / f"a{suffix}", mesh))
    back = getattr(read_mesh(tmp_path / f"a{suffix}"), field)
    word = "texture coordinates: " if field == "corner_uv" else f"{field}: "
    assert (back is None) == (word in said), said


@pytest.mark.parametrize("suffix", [s for s in sorted(FORMATS) if s != ".stl"])
def test_point_clouds(tmp_path, suffix):
    mesh = Mesh(np.random.default_rng(0).normal(size=(9, 3)), np.zeros((0, 3)))
    write_mesh(tmp_path / f"a{suffix}", mesh)
    back = read_mesh(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(back.verts, mesh.verts, rtol=0, atol=1e-6)
    assert back.num_faces == 0
    with pytest.raises(InputError, match="at least one triangle"):
        back.require()


@pytest.mark.parametrize("suffix", sorted(FORMATS))
def test_duplicates_and_unused_vertices(tmp_path, suffix):
    """Vertices at the same place stay apart, those of no face stay (STL: says that it cannot)."""
    box = cube()
    verts = np.concatenate([box.verts, box.verts, [[5.0, 5, 5]]])
    mesh = Mesh(verts, np.concatenate([box.faces, box.faces + 8]))
    uv = np.random.default_rng(0).random((24, 3, 2))
    mesh = dataclasses.replace(mesh, corner_uv=uv)
    said = write_mesh(tmp_path / f"a{suffix}", mesh)
    back = read_mesh(tmp_path / f"a{suffix}")
    if suffix == ".stl":
        assert back.num_verts == 8
        assert "vertices: merged where equal, unused ones dropped" in said
    else:
        np.testing.assert_array_equal(back.faces, mesh.faces)
        np.testing.assert_array_equal(back.verts, mesh.verts)
        np.testing.assert_allclose(back.corner_uv, uv, atol=1e-7)


@pytest.mark.parametrize("suffix", [".glb", ".ply", ".npz"])
def test_many_joints_and_more_than_four_weights(tmp_path, suffix):
    mesh = many_joints()
    assert "weights" not in " ".join(write_mesh(tmp_path / f"a{suffix}", mesh))
    back = read_mesh(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(back.weights, mesh.weights, rtol=0, atol=1e-7)
    np.testing.assert_allclose(back.skeleton.joints, mesh.skeleton.joints, rtol=0, atol=1e-12)


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".npz"])
def test_nan_is_kept_to_be_reported(tmp_path, suffix):
    box = cube()
    verts = box.verts.copy()
    verts[3, 1], verts[4, 0] = np.nan, np.inf
    write_mesh(tmp_path / f"a{suffix}", Mesh(verts, box.faces), text=True)
    back = read_mesh(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(back.verts, verts)
    with pytest.raises(InputError, match="found 2 of 8 with NaN"):
        back.require()


@pytest.mark.parametrize("suffix", [".stl", ".glb", ".gltf"])
@pytest.mark.parametrize("value", [np.nan, 1e39])
def test_formats_that_hold_no_such_number_refuse_and_leave_nothing(tmp_path, suffix, value):
    box = cube()
    verts = box.verts.copy()
    verts[3, 1] = value
    path = tmp_path / f"a{suffix}"
    with pytest.raises(InputError, match="within float32") as caught:
        write_mesh(path, Mesh(verts, box.faces))
    assert str(path) in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    write_mesh(path, cube())
    before = path.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="No space"):
        write_mesh(path, tube())
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.parametrize(("suffix", "text"), CASES)
def test_truncated_files(tmp_path, suffix, text):
    """Cut anywhere, a file is refused in one line that names it, or (text) is shorter."""
    path = tmp_path / f"a{suffix}"
    write_mesh(path, tube(3, 4), text=text)
    whole = path.read_bytes()
    refused = 0
    for cut in np.linspace(0, 0.98 * len(whole), 40).astype(int).tolist():
        path.write_bytes(whole[:cut])
        try:
            read_mesh(path)
        except InputError as error:
            refused += 1
            assert str(path) in str(error) and "expected" in str(error)
    assert refused >= (1 if suffix == ".obj" else 40), refused


@pytest.mark.parametrize("suffix", sorted(FORMATS))
def test_flipped_bytes_raise_nothing_else(tmp_path, suffix):
    """Damage is read or refused; no other error and no endless loop."""
    path = tmp_path / f"a{suffix}"
    write_mesh(path, tube(3, 4))
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(150):
        data = bytearray(whole)
        for place in rng.integers(0, min(len(whole), 2500), size=rng.integers(1, 6)):
            data[place] = int(rng.integers(0, 256))
        path.write_bytes(bytes(data))
        try:
            read_mesh(path)
        except InputError as error:
            assert "expected" in str(error)


@pytest.mark.parametrize("suffix", sorted(FORMATS))
def test_empty_files_and_other_content(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    for data in (b"", b"\0" * 200, b"hello", b"{}", b"[1, 2]", b"\xff\xfe\x00"):
        path.write_bytes(data)
        with pytest.raises(InputError) as caught:
            read_mesh(path)
        assert str(path) in str(caught.value), data


def test_paths_that_are_no_meshes(tmp_path):
    for path, words in [
        (tmp_path / "a.obj", "found nothing"),
        (tmp_path / "a.fbx", "found .fbx"),
        (tmp_path / "a", "found no ending"),
    ]:
        with pytest.raises(InputError, match=words):
            read_mesh(path)
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(InputError, match="found a folder"):
        read_mesh(tmp_path / "folder.obj")
    with pytest.raises(InputError, match="expected an existing folder"):
        write_mesh(tmp_path / "none" / "a.obj", cube())
    with pytest.raises(InputError, match=r"found \.fbx"):
        write_mesh(tmp_path / "a.fbx", cube())


def test_arrays_that_do_not_agree():
    box = cube()
    for changes, words in [
        ({"faces": np.array([[0, 1, 8]])}, r"indices in 0\.\.7, found 0\.\.8"),
        ({"faces": np.array([[0, 1, -1]])}, "found -1"),
        ({"weights": np.ones((3, 2))}, r"weights: expected the shape \(8, any\)"),
        ({"corner_uv": np.ones((3, 3, 2))}, "corner_uv"),
        ({"colors": np.ones((8, 4))}, "colors"),
        ({"verts": np.ones((8, 2))}, "verts"),
    ]:
        with pytest.raises(InputError, match=words):
            dataclasses.replace(box, **changes)
    skeleton = Skeleton(("a",), (-1,), np.zeros((1, 3)))
    with pytest.raises(InputError, match="expected 2 joints"):
        dataclasses.replace(box, weights=np.ones((8, 2)), skeleton=skeleton)
    with pytest.raises(InputError, match="parents before"):
        Skeleton(("a", "b"), (1, -1), np.zeros((2, 3)))
    with pytest.raises(InputError, match="as many names"):
        Skeleton(("a",), (-1, 0), np.zeros((2, 3)))


def test_a_body_file_is_a_body(tmp_path):
    """The npz of a rigged mesh is read by `BodyModel.load`, joints where they were."""
    from monopart.geometry import BodyModel

    mesh = read_mesh(ROOT / "geometry" / "assets" / "body.npz")
    assert mesh.skeleton.names[15] == "head"
    assert mesh.notes  # the shapes are not kept, which is said
    for name in ("a.glb", "a.npz"):
        write_mesh(tmp_path / name, mesh)
    rigged = read_mesh(tmp_path / "a.glb")
    write_mesh(tmp_path / "b.npz", rigged)
    reference = BodyModel.default()
    for name in ("a.npz", "b.npz"):
        body = BodyModel.load(tmp_path / name)
        assert body.tree.parents == reference.tree.parents
        np.testing.assert_array_equal(body.faces, reference.faces)
        np.testing.assert_allclose(body.weights, reference.weights, atol=1e-6)
        rest = body.joint_regressor @ body.v_template
        wanted = reference.joint_regressor @ reference.v_template
        np.testing.assert_allclose(rest, wanted, atol=2e-6)
        np.testing.assert_allclose(body.uv.corner_uv, reference.uv.corner_uv, atol=1e-6)


def test_joint_regressor_where_it_is_hard():
    line = np.linspace(0, 1, 5)[:, None] * np.ones(3)
    rows = joint_regressor(line, np.array([[0.3, 0.3, 0.3], [2.0, 2, 2]]))
    np.testing.assert_allclose(rows.sum(axis=1), 1)
    np.testing.assert_allclose(rows @ line, [[0.3] * 3, [2.0] * 3], atol=1e-12)
    assert joint_regressor(np.zeros((1, 3)), np.zeros((2, 3))).tolist() == [[1.0], [1.0]]


def test_pickled_members_are_left_alone(tmp_path):
    trap = tmp_path / "executed"

    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(trap),)

    path = tmp_path / "a.npz"
    box = cube()
    np.savez(path, v_template=box.verts, f=box.faces, extra=np.array([Evil()], dtype=object))
    mesh = read_mesh(path)
    assert mesh.notes == ("extra: holds objects, not read",)
    assert not trap.exists()
    np.savez(path, v_template=np.array([Evil()], dtype=object), f=box.faces)
    with pytest.raises(InputError, match="v_template"):
        read_mesh(path)
    assert not trap.exists()
    np.load(path, allow_pickle=True)["v_template"]
    assert trap.exists()


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".stl", ".glb", ".gltf"])
@pytest.mark.parametrize("text", [False, True])
def test_trimesh_reads_the_same_surface(tmp_path, suffix, text):
    trimesh = pytest.importorskip("trimesh")
    mesh = tube()
    write_mesh(tmp_path / f"a{suffix}", mesh, text=text)
    other = trimesh.load(tmp_path / f"a{suffix}", process=False, force="mesh")
    np.testing.assert_allclose(
        np.asarray(other.vertices)[np.asarray(other.faces)], _corners(mesh), rtol=0, atol=1e-6
    )
    if suffix != ".stl":
        uv = np.asarray(other.visual.uv)[np.asarray(other.faces)]
        np.testing.assert_allclose(uv, mesh.corner_uv, rtol=0, atol=1e-6)
    if suffix in (".obj", ".glb", ".gltf"):
        material = other.visual.material
        image = getattr(material, "image", None) or material.baseColorTexture
        np.testing.assert_allclose(np.asarray(image.convert("RGB")) / 255, mesh.texture, atol=1e-9)


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".stl", ".glb"])
def test_what_trimesh_writes_is_read(tmp_path, suffix):
    trimesh = pytest.importorskip("trimesh")
    other = trimesh.creation.icosphere(subdivisions=2)
    other.visual.vertex_colors = [200, 100, 50, 255]
    other.export(tmp_path / f"a{suffix}")
    mesh = read_mesh(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(_corners(mesh), other.triangles, rtol=0, atol=1e-6)
    if suffix != ".stl":
        assert mesh.num_verts == len(other.vertices)
        if suffix != ".glb":  # trimesh writes its colours as linear ones
            np.testing.assert_allclose(
                mesh.colors, np.tile([200, 100, 50], (162, 1)) / 255, atol=1e-8
            )


def test_no_torch_no_trimesh(tmp_path):
    """Reading and writing need numpy alone (and Pillow for pictures)."""
    code = """
import sys
from pathlib import Path
for name in ("torch", "trimesh", "warp", "igl", "pymeshlab", "rich", "PIL"):
    sys.modules[name] = None
import numpy as np
from monopart.tools.meshio import FORMATS, Mesh, read_mesh, write_mesh
mesh = Mesh(np.eye(3), np.array([[0, 1, 2]]), corner_uv=np.ones((1, 3, 2)), colors=np.eye(3))
for suffix in FORMATS:
    write_mesh(Path(sys.argv[1]) / ("a" + suffix), mesh)
    assert read_mesh(Path(sys.argv[1]) / ("a" + suffix)).num_faces == 1
print("read")
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.stdout == "read\n", done.stderr


def test_losses_are_for_the_format(tmp_path):
    mesh = tube()
    assert losses(mesh, "a.npz") == losses(mesh, "a.gltf")[1:] == ()
    assert losses(mesh, "a.glb") == ("positions: rounded to float32",)
    odd = dataclasses.replace(mesh, colors=mesh.colors * 0.123, texture=mesh.texture * 0.123)
    assert "colors: rounded to 8 bits" in losses(odd, "a.ply")
    assert "texture: rounded to 8 bits" in losses(odd, "a.obj")
    json.dumps(losses(odd, "a.stl"))
