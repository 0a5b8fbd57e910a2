"""The rules of glTF 2.0 that a mesh with a skin can break, checked with plain loops."""

import json
import struct

import numpy as np

SIZES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


def _glb(path):
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    assert length % 4 == 0
    chunks, place = [], 12
    while place < length:
        size, kind = struct.unpack_from("<II", data, place)
        assert size % 4 == 0
        chunks.append((kind, data[place + 8 : place + 8 + size]))
        place += 8 + size
    (json_kind, text), (bin_kind, binary) = chunks
    assert (json_kind, bin_kind) == (0x4E4F534A, 0x004E4942)
    assert place == length
    return json.loads(text), binary


def _values(document, binary, index):
    """An accessor, read with plain loops."""
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    width, size = WIDTHS[accessor["type"]], SIZES[accessor["componentType"]]
    code = {1: "B", 2: "H"}.get(size, "I" if accessor["componentType"] == 5125 else "f")
    start = view["byteOffset"] + accessor.get("byteOffset", 0)
    assert start % size == 0, "components stand on multiples of their size"
    assert accessor["count"] >= 1
    assert accessor["count"] * width * size <= view["byteLength"]
    assert start + accessor["count"] * width * size <= len(binary)
    step = width * size
    rows = [
        struct.unpack_from(f"<{width}{code}", binary, start + n * step)
        for n in range(accessor["count"])
    ]
    return np.array(rows)


def validate(path):
    """The rules of glTF 2.0 that a mesh with a skin can break."""
    document, binary = _glb(path)
    assert document["asset"]["version"] == "2.0"
    (buffer,) = document["buffers"]
    assert 0 <= len(binary) - buffer["byteLength"] <= 3
    for view in document["bufferViews"]:
        assert view["buffer"] == 0 and view["byteOffset"] % 4 == 0
        assert view["byteOffset"] + view["byteLength"] <= buffer["byteLength"]
    for index, accessor in enumerate(document["accessors"]):
        values = _values(document, binary, index)
        for name, fold in (("min", np.min), ("max", np.max)):
            if name in accessor:
                np.testing.assert_array_equal(np.float32(accessor[name]), fold(values, axis=0))
    nodes = document["nodes"]
    children = [c for n in nodes for c in n.get("children", [])]
    assert len(children) == len(set(children)), "a node has one parent"
    for root in document["scenes"][document["scene"]]["nodes"]:
        assert root not in children
    for node in nodes:
        assert not ("matrix" in node and "translation" in node)
    for mesh in document["meshes"]:
        for primitive in mesh["primitives"]:
            _validate_primitive(document, binary, primitive)
    for skin in document.get("skins", []):
        _validate_skin(document, binary, skin)
    return document, binary


def _validate_primitive(document, binary, primitive):
    attributes = {k: _values(document, binary, v) for k, v in primitive["attributes"].items()}
    accessors = document["accessors"]
    assert "min" in accessors[primitive["attributes"]["POSITION"]]
    count = len(attributes["POSITION"])
    for name, values in attributes.items():
        assert len(values) == count, name
        accessor = accessors[primitive["attributes"][name]]
        view = document["bufferViews"][accessor["bufferView"]]
        assert view["target"] == 34962
        width = WIDTHS[accessor["type"]] * SIZES[accessor["componentType"]]
        assert width % 4 == 0, "vertex attributes stand on multiples of four"
        if name.startswith("_"):
            assert accessor["componentType"] != 5125
    if "indices" in primitive:
        indices = _values(document, binary, primitive["indices"])
        assert indices.max() < count
        assert len(indices) % 3 == 0
        kind = accessors[primitive["indices"]]["componentType"]
        assert indices.max() < {5121: 255, 5123: 65535, 5125: 2**32 - 1}[kind]
    if "NORMAL" in attributes:
        np.testing.assert_allclose(np.linalg.norm(attributes["NORMAL"], axis=1), 1, atol=5e-4)
    _validate_weights(document, attributes)


def _validate_weights(document, attributes):
    sets = [k for k in attributes if k.startswith("JOINTS_")]
    assert len(sets) == len([k for k in attributes if k.startswith("WEIGHTS_")])
    if not sets:
        return
    joints = np.concatenate([attributes[f"JOINTS_{n}"] for n in range(len(sets))], axis=1)
    weights = np.concatenate([attributes[f"WEIGHTS_{n}"] for n in range(len(sets))], axis=1)
    assert (weights >= 0).all()
    used = np.maximum((weights > 0).sum(axis=1), 1)
    assert (np.abs(weights.astype(np.float64).sum(axis=1) - 1) < 2e-7 * used).all()
    assert (joints[weights == 0] == 0).all()
    assert joints.max() < len(document["skins"][0]["joints"])
    for row, weight in zip(joints, weights, strict=True):
        chosen = row[weight > 0]
        assert len(set(chosen.tolist())) == len(chosen)


def _validate_skin(document, binary, skin):
    matrices = _values(document, binary, skin["inverseBindMatrices"]).reshape(-1, 4, 4)
    assert len(matrices) >= len(skin["joints"]) == len(set(skin["joints"]))
    np.testing.assert_array_equal(matrices[:, :, 3], np.tile([0, 0, 0, 1], (len(matrices), 1)))
    world = {}

    def visit(index, above):
        node = document["nodes"][index]
        world[index] = above + np.array(node.get("translation", [0, 0, 0]))
        for child in node.get("children", []):
            visit(child, world[index])

    for root in document["scenes"][0]["nodes"]:
        visit(root, np.zeros(3))
    for joint, matrix in zip(skin["joints"], matrices, strict=True):
        # columns first: the translation is the last row; bind and node cancel at rest
        np.testing.assert_allclose(matrix[3, :3], -world[joint], rtol=0, atol=1e-6)
        np.testing.assert_array_equal(matrix[:3, :3], np.eye(3))
