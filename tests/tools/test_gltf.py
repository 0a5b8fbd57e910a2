"""glTF by its specification: what is written is valid, and other writers' layouts are read."""

import base64
import json

import numpy as np
import pytest
from gltf_rules import TYPES, validate
from mesh_samples import cube, many_joints, tube

from monopart.geometry.errors import InputError
from monopart.tools.meshio import Mesh, Skeleton, read_mesh, write_mesh


def _several_roots():
    skeleton = Skeleton(("a", "b", "c"), (-1, -1, 1), np.arange(9.0).reshape(3, 3))
    return Mesh(cube().verts, cube().faces, weights=np.full((8, 3), 1 / 3), skeleton=skeleton)


@pytest.mark.parametrize(
    "mesh",
    [
        tube(),
        cube(),
        many_joints(),
        _several_roots(),
        Mesh(np.eye(3), np.zeros((0, 3))),
        Mesh(np.eye(3), np.array([[0, 0, 0], [0, 1, 1]])),
        Mesh(cube().verts * 1e30, cube().faces),
        Mesh(np.arange(3.0 * 66000).reshape(-1, 3), np.array([[0, 65999, 7]])),
    ],
    ids=["all", "plain", "joints", "roots", "points", "degenerate", "huge", "wide"],
)
def test_what_is_written_is_valid(tmp_path, mesh):
    path = tmp_path / "a.glb"
    write_mesh(path, mesh)
    document, _ = validate(path)
    back = read_mesh(path)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_array_equal(back.verts, mesh.verts.astype(np.float32))
    if mesh.skeleton is not None:
        assert back.skeleton.parents == mesh.skeleton.parents
        assert document["nodes"][0]["skin"] == 0
    if mesh.texture is not None:
        assert document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["index"] == 0


def test_trimesh_sees_the_vertex_numbers_and_the_joints(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    mesh = tube()
    write_mesh(tmp_path / "a.glb", mesh)
    scene = trimesh.load(tmp_path / "a.glb", process=False)
    assert set(mesh.skeleton.names) <= set(scene.graph.nodes)
    for name, joint in zip(mesh.skeleton.names, mesh.skeleton.joints, strict=True):
        np.testing.assert_allclose(scene.graph.get(name)[0][:3, 3], joint, atol=1e-9)
    (geometry,) = scene.geometry.values()
    numbers = np.asarray(geometry.vertex_attributes["_VERTEX"]).reshape(-1).astype(int)
    np.testing.assert_allclose(geometry.vertices, mesh.verts[numbers], atol=1e-6)


@pytest.mark.parametrize("wrong", [0.5, np.nan, -0.1])
def test_weights_that_are_none(tmp_path, wrong):
    mesh = tube()
    weights = mesh.weights.copy()
    weights[5, 0] = wrong
    broken = Mesh(mesh.verts, mesh.faces, weights=weights, skeleton=mesh.skeleton)
    with pytest.raises(InputError, match="found row 5"):
        write_mesh(tmp_path / "a.glb", broken)
    assert not list(tmp_path.iterdir())


class _Foreign:
    """A glTF as another program might write it."""

    def __init__(self):
        self.document = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": []}
        self.data = b""

    def view(self, data, **more):
        self.data += b"\0" * (-len(self.data) % 4)
        entry = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)} | more
        self.document["bufferViews"].append(entry)
        self.data += data
        return len(self.document["bufferViews"]) - 1

    def accessor(self, values, code, kind, **more):
        values = np.ascontiguousarray(values, dtype=TYPES[code])
        entry = {"componentType": code, "type": kind, "count": len(values)} | more
        entry.setdefault("bufferView", self.view(values.tobytes()))
        self.document["accessors"].append(entry)
        return len(self.document["accessors"]) - 1

    def write(self, path, uri=None):
        text = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        if uri:
            (path.parent / uri).write_bytes(self.data)
        buffer = {"byteLength": len(self.data), "uri": uri or text}
        path.write_text(json.dumps(self.document | {"buffers": [buffer]}))
        return read_mesh(path)


TRIANGLE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])


def _plain(foreign, **primitive):
    foreign.document |= {
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "meshes": [{"primitives": [primitive]}],
    }


def test_interleaved_normalised_and_separate_buffer(tmp_path):
    foreign = _Foreign()
    rows = np.zeros(3, dtype=[("p", "<f4", 3), ("uv", "<u2", 2), ("c", "u1", 4)])
    rows["p"], rows["uv"] = TRIANGLE, [[0, 65535], [65535, 0], [0, 0]]
    rows["c"] = [255, 0, 255, 9]
    view = foreign.view(rows.tobytes(), byteStride=rows.itemsize)
    more = {"bufferView": view}
    attributes = {
        "POSITION": foreign.accessor(rows["p"], 5126, "VEC3", **more),
        "TEXCOORD_0": foreign.accessor(
            rows["uv"], 5123, "VEC2", byteOffset=12, normalized=True, **more
        ),
        "COLOR_0": foreign.accessor(
            rows["c"], 5121, "VEC4", byteOffset=16, normalized=True, **more
        ),
    }
    _plain(foreign, attributes=attributes)
    mesh = foreign.write(tmp_path / "a.gltf", uri="data.bin")
    np.testing.assert_array_equal(mesh.verts[mesh.faces][0], TRIANGLE)
    np.testing.assert_array_equal(mesh.corner_uv[0], [[0, 0], [1, 1], [0, 1]])
    np.testing.assert_allclose(mesh.colors, np.tile([1, 0, 1], (3, 1)), atol=1e-12)


def test_sparse_strip_fan_and_implicit_indices(tmp_path):
    foreign = _Foreign()
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], dtype=float)
    values = foreign.view(np.array([[5, 5, 5]], dtype="<f4").tobytes())
    places = foreign.view(np.array([3], dtype="<u2").tobytes())
    sparse = {
        "count": 1,
        "indices": {"bufferView": places, "componentType": 5123},
        "values": {"bufferView": values},
    }
    position = foreign.accessor(square, 5126, "VEC3", sparse=sparse)
    _plain(foreign, attributes={"POSITION": position}, mode=5)
    mesh = foreign.write(tmp_path / "a.gltf")
    square[3] = 5
    np.testing.assert_array_equal(mesh.verts[mesh.faces], square[[[0, 1, 2], [2, 1, 3]]])
    foreign.document["meshes"][0]["primitives"][0]["mode"] = 6
    mesh = foreign.write(tmp_path / "b.gltf")
    np.testing.assert_array_equal(mesh.verts[mesh.faces], square[[[0, 1, 2], [0, 2, 3]]])
    foreign.document["meshes"][0]["primitives"][0]["mode"] = 1
    with pytest.raises(InputError, match="expected a mesh in the scene"):
        foreign.write(tmp_path / "c.gltf")


def test_nodes_place_their_meshes_and_seams_close(tmp_path):
    """Two nodes share a mesh; matrix, scale and rotation; equal vertices become one."""
    foreign = _Foreign()
    position = foreign.accessor(TRIANGLE, 5126, "VEC3")
    half = np.sqrt(0.5)
    _plain(foreign, attributes={"POSITION": position})
    foreign.document["nodes"] = [
        {"mesh": 0, "children": [1], "scale": [2, 2, 2]},
        {"mesh": 0, "rotation": [0, 0, half, half], "translation": [1, 0, 0]},
    ]
    mesh = foreign.write(tmp_path / "a.gltf")
    turned = TRIANGLE @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + [1, 0, 0]
    wanted = np.stack([TRIANGLE, turned]) * 2
    np.testing.assert_allclose(mesh.verts[mesh.faces], wanted, atol=1e-12)
    matrix = np.eye(4)
    matrix[:3, 3] = [1, 2, 3]
    foreign.document["nodes"] = [{"mesh": 0, "matrix": matrix.T.reshape(-1).tolist()}]
    foreign.document["meshes"][0]["primitives"] *= 2
    mesh = foreign.write(tmp_path / "b.gltf")
    np.testing.assert_array_equal(mesh.verts, TRIANGLE + np.array([1, 2, 3]))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 1, 2]]
    assert mesh.notes == ("vertices: 3 merged with equal ones",)


def _skinned(foreign, order=(2, 1), bind=None, nodes=None):
    position = foreign.accessor(TRIANGLE, 5126, "VEC3")
    joints = foreign.accessor([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0]], 5121, "VEC4")
    weights = foreign.accessor([[102, 153, 0, 0], [255, 0, 0, 0], [255, 0, 0, 0]], 5121, "VEC4")
    foreign.document["accessors"][weights]["normalized"] = True
    _plain(foreign, attributes={"POSITION": position, "JOINTS_0": joints, "WEIGHTS_0": weights})
    skin = {"joints": list(order)}
    if bind is not None:
        skin["inverseBindMatrices"] = foreign.accessor(bind.transpose(0, 2, 1), 5126, "MAT4")
    foreign.document["skins"] = [skin]
    foreign.document["scenes"] = [{"nodes": [0, 1]}]
    foreign.document["nodes"] = [{"mesh": 0, "skin": 0, "translation": [9, 9, 9]}, *nodes]


def test_a_skin_is_shown_where_its_joints_are(tmp_path):
    """A child listed before its parent, a scaled armature, a node between the joints."""
    rng = np.random.default_rng(0)
    bind = np.tile(np.eye(4), (2, 1, 1))
    bind[:, :3, :] = rng.normal(size=(2, 3, 4)).astype(np.float32)
    nodes = [
        {"name": "root", "children": [3], "translation": [0, 1, 0], "scale": [2, 2, 2]},
        {"name": "tip", "translation": [0, 0, 1]},
        {"name": "between", "children": [2], "translation": [1, 0, 0]},
    ]
    foreign = _Foreign()
    _skinned(foreign, bind=bind, nodes=nodes)
    mesh = foreign.write(tmp_path / "a.gltf")
    assert mesh.skeleton.names == ("root", "tip")
    assert mesh.skeleton.parents == (-1, 0)
    np.testing.assert_allclose(mesh.skeleton.joints, [[0, 1, 0], [2, 1, 2]], atol=1e-12)
    np.testing.assert_allclose(mesh.weights, [[0.6, 0.4], [1, 0], [0, 1]], atol=1e-12)
    root, tip = np.diag([2.0, 2, 2, 1]), np.diag([2.0, 2, 2, 1])
    root[:3, 3], tip[:3, 3] = [0, 1, 0], [2, 1, 2]
    for row, vertex, shown in zip(mesh.weights, TRIANGLE, mesh.verts, strict=True):
        matrix = row[0] * root @ bind[1] + row[1] * tip @ bind[0]
        np.testing.assert_allclose(shown, (matrix @ [*vertex, 1])[:3], atol=1e-6)


def test_a_skin_without_bind_matrices(tmp_path):
    nodes = [{"children": [2]}, {"translation": [0, 0, 0]}]
    foreign = _Foreign()
    _skinned(foreign, order=(1, 2), nodes=nodes)
    mesh = foreign.write(tmp_path / "a.gltf")
    assert mesh.skeleton.names == ("joint_0", "joint_1")
    np.testing.assert_array_equal(mesh.verts, TRIANGLE)


def test_what_hangs_on_a_joint_moves_with_it(tmp_path):
    nodes = [{"children": [2]}, {"translation": [0, 0, 0], "children": [3]}, {"mesh": 1}]
    foreign = _Foreign()
    _skinned(foreign, order=(1, 2), nodes=nodes)
    position = foreign.accessor(TRIANGLE + 5, 5126, "VEC3")
    foreign.document["meshes"].append({"primitives": [{"attributes": {"POSITION": position}}]})
    mesh = foreign.write(tmp_path / "a.gltf")
    np.testing.assert_array_equal(mesh.weights[3:], [[0, 1]] * 3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"asset": {"version": "1.0"}}, "expected 2, found 1.0"),
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "without compression"),
        ({"nodes": [{"mesh": 0, "children": [0]}]}, "expected a tree"),
        ({"nodes": [{"mesh": 7}]}, "meshes: expected an index below 1, found 7"),
        ({"scene": 3}, "scenes: expected an index below 1, found 3"),
        ({"meshes": [{"primitives": []}]}, "expected a mesh in the scene"),
        ({"meshes": [{"primitives": [{"attributes": {}}]}]}, "expected positions"),
        ({"accessors": []}, "accessors: expected an index below 0"),
    ],
)
def test_other_content_is_refused(tmp_path, change, words):
    foreign = _Foreign()
    _plain(foreign, attributes={"POSITION": foreign.accessor(TRIANGLE, 5126, "VEC3")})
    foreign.write(tmp_path / "a.gltf")
    foreign.document |= change
    with pytest.raises(InputError, match=words) as caught:
        foreign.write(tmp_path / "a.gltf")
    assert str(tmp_path / "a.gltf") in str(caught.value)


def test_files_elsewhere_are_not_read(tmp_path):
    (tmp_path / "inner").mkdir()
    (tmp_path / "secret.bin").write_bytes(b"\0" * 36)
    foreign = _Foreign()
    _plain(foreign, attributes={"POSITION": foreign.accessor(TRIANGLE, 5126, "VEC3")})
    for uri in ("../secret.bin", str(tmp_path / "secret.bin"), "https://example.org/x.bin"):
        path = tmp_path / "inner" / "a.gltf"
        buffer = {"byteLength": 36, "uri": uri}
        path.write_text(json.dumps(foreign.document | {"buffers": [buffer]}))
        with pytest.raises(InputError, match="expected a file beside it"):
            read_mesh(path)


def test_an_accessor_beyond_its_view(tmp_path):
    foreign = _Foreign()
    _plain(foreign, attributes={"POSITION": foreign.accessor(TRIANGLE, 5126, "VEC3")})
    foreign.document["accessors"][0]["count"] = 4
    with pytest.raises(InputError, match="expected 4 values inside its buffer view"):
        foreign.write(tmp_path / "a.gltf")
