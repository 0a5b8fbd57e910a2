"""A mesh as glTF 2.0: one node, one primitive, a skin where it has joints and weights."""

from typing import Any

import numpy as np
from jaxtyping import Float

from monopart.geometry.errors import InputError

from .gltf_file import GltfBuilder
from .images import encoded
from .meshio import WEIGHTS_SUM, Mesh, Skeleton

_VERTEX_TARGET, _INDEX_TARGET = 34962, 34963
_LARGEST_INDEX = 1 << 24  # whole numbers that float32 holds


def packed_mesh(mesh: Mesh, source: str, binary: bool) -> bytes:
    """The bytes of a glb or gltf file.

    Vertices are split where a seam of the texture coordinates runs; the attribute `_VERTEX` says
    which vertex each came from.

    Args:
        mesh: what to write.
        source: what to call it in errors.
        binary: glb; gltf with its data in itself otherwise.

    Returns:
        The file's bytes.

    Raises:
        InputError: no vertex, numbers beyond float32, or weights that do not sum to 1.
    """
    _check(mesh, source)
    builder = GltfBuilder()
    origin, corners = _split(mesh)
    attributes = _attributes(builder, mesh, origin, corners)
    primitive: dict[str, Any] = {"attributes": attributes, "mode": 4 if mesh.num_faces else 0}
    if mesh.num_faces:
        small = len(origin) < 1 << 16
        index = corners.reshape(-1).astype("<u2" if small else "<u4")
        primitive["indices"] = builder.array(index, _INDEX_TARGET, bounds=True)
    node: dict[str, Any] = {"mesh": 0, "name": mesh.name}
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "monopart-mesh"},
        "scene": 0,
        "nodes": [node],
        "meshes": [{"name": mesh.name, "primitives": [primitive]}],
    }
    roots = [0]
    if mesh.skeleton is not None and mesh.skeleton.parents:
        roots += _add_joints(document, builder, mesh.skeleton)
        if mesh.weights is not None:
            node["skin"] = 0
    document["scenes"] = [{"nodes": roots}]
    if mesh.texture is not None and mesh.corner_uv is not None:
        _add_texture(document, builder, mesh.texture)
        primitive["material"] = 0
    return builder.packed(document, binary)


def _check(mesh: Mesh, source: str) -> None:
    if mesh.num_verts == 0:
        raise InputError(
            f"{source}: expected at least one vertex, found none; glTF holds no empty mesh, "
            "choose ply or npz"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        held = [
            np.isfinite(values.astype(np.float32)).all()
            for values in (mesh.verts, mesh.corner_uv, mesh.colors)
            if values is not None
        ]
    if not all(held):
        raise InputError(
            f"{source}: expected finite numbers within float32, found others; clean the mesh "
            "first, or choose ply or npz"
        )
    if mesh.weights is not None and mesh.skeleton is not None:
        wrong = np.abs(mesh.weights.sum(axis=1) - 1) > WEIGHTS_SUM
        wrong |= ~(mesh.weights >= 0).all(axis=1)
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            raise InputError(
                f"{source}: weights: expected rows of numbers from 0 that sum to 1, found row "
                f"{row} with sum {mesh.weights[row].sum():.6g}; normalise them first"
            )


def _split(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertex of the mesh of each vertex in the file, and the faces in the file's vertices."""
    if mesh.corner_uv is None:
        return np.arange(mesh.num_verts), mesh.faces
    keys = np.concatenate([mesh.faces.reshape(-1, 1), mesh.corner_uv.reshape(-1, 2)], axis=1)
    unique, inverse = np.unique(keys, axis=0, return_inverse=True)
    used = unique[:, 0].astype(np.int64)
    unused = np.setdiff1d(np.arange(mesh.num_verts), used)
    return np.concatenate([used, unused]), inverse.reshape(-1, 3)


def _attributes(
    builder: GltfBuilder, mesh: Mesh, origin: np.ndarray, corners: np.ndarray
) -> dict[str, int]:
    def add(values: np.ndarray, bounds: bool = False) -> int:
        return builder.array(values, _VERTEX_TARGET, bounds)

    found = {"POSITION": add(mesh.verts[origin].astype("<f4"), bounds=True)}
    if mesh.num_faces:
        found["NORMAL"] = add(vertex_normals(mesh)[origin].astype("<f4"))
    if mesh.corner_uv is not None:
        uv = np.zeros((len(origin), 2))
        uv[corners.reshape(-1)] = mesh.corner_uv.reshape(-1, 2)
        uv[:, 1] = 1 - uv[:, 1]  # v runs downwards in glTF
        found["TEXCOORD_0"] = add(uv.astype("<f4"))
    if mesh.colors is not None:
        found["COLOR_0"] = add(srgb_to_linear(mesh.colors[origin]).astype("<f4"))
    if mesh.weights is not None and mesh.skeleton is not None:
        for n, (joints, weights) in enumerate(weight_sets(mesh.weights)):
            found[f"JOINTS_{n}"] = add(joints[origin])
            found[f"WEIGHTS_{n}"] = add(weights[origin])
    if len(origin) < _LARGEST_INDEX:
        found["_VERTEX"] = add(origin.astype("<f4"))
    return found


def vertex_normals(mesh: Mesh) -> Float[np.ndarray, "V 3"]:
    """Unit normals of the vertices, faces weighing by their area; +y where there is none.

    Args:
        mesh: the mesh.

    Returns:
        Normals, (V, 3).
    """
    corners = mesh.verts[mesh.faces]
    scale = np.abs(corners).max() if corners.size else 1.0
    corners = corners / (scale or 1.0)
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros((mesh.num_verts, 3))
    for place in range(3):
        np.add.at(total, mesh.faces[:, place], area)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    some = length > 1e-300
    return np.where(some, total / np.where(some, length, 1), np.array([0.0, 1.0, 0.0]))


def weight_sets(weights: Float[np.ndarray, "V J"]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Skinning weights as sets of four joints and weights, largest first, none left out.

    Args:
        weights: rows that sum to 1, (V, J).

    Returns:
        Joints (V, 4) uint8 or uint16 and weights (V, 4) float32 of each set; joint 0 where the
        weight is 0.

    >>> [(j, w)] = weight_sets(np.array([[0.25, 0.75]]))
    >>> j.tolist(), w.tolist()
    ([[1, 0, 0, 0]], [[0.75, 0.25, 0.0, 0.0]])
    """
    scaled = (weights / weights.sum(axis=1, keepdims=True)).astype("<f4")
    most = int((scaled > 0).sum(axis=1).max(initial=1))
    width = -(-most // 4) * 4
    order = np.argsort(-scaled, axis=1, kind="stable")[:, :width]
    values = np.take_along_axis(scaled, order, axis=1)
    joints = np.where(values > 0, order, 0).astype("<u1" if weights.shape[1] <= 256 else "<u2")
    pad = ((0, 0), (0, width - values.shape[1]))
    values, joints = np.pad(values, pad), np.pad(joints, pad)
    return [(joints[:, n : n + 4], values[:, n : n + 4]) for n in range(0, width, 4)]


def _add_joints(document: dict[str, Any], builder: GltfBuilder, skeleton: Skeleton) -> list[int]:
    """Nodes of the joints and the skin; returns the nodes that the scene lists for them."""
    nodes = document["nodes"]
    first = len(nodes)
    for name, parent, joint in zip(skeleton.names, skeleton.parents, skeleton.joints, strict=True):
        offset = joint - skeleton.joints[parent] if parent >= 0 else joint
        nodes.append({"name": name, "translation": offset.tolist()})
        if parent >= 0:
            nodes[first + parent].setdefault("children", []).append(len(nodes) - 1)
    roots = [first + j for j, parent in enumerate(skeleton.parents) if parent < 0]
    if len(roots) > 1:  # the joints of a skin must share a root
        nodes.append({"name": "armature", "children": roots})
        roots = [len(nodes) - 1]
    matrices = np.tile(np.eye(4), (len(skeleton.parents), 1, 1))
    matrices[:, 3, :3] = -skeleton.joints  # columns first: the translation is the last row
    document["skins"] = [
        {
            "joints": list(range(first, first + len(skeleton.parents))),
            "skeleton": roots[0],
            "inverseBindMatrices": builder.array(matrices.astype("<f4")),
        }
    ]
    return roots


def _add_texture(document: dict[str, Any], builder: GltfBuilder, texture: np.ndarray) -> None:
    image = builder.view(encoded(texture))
    document["images"] = [{"bufferView": image, "mimeType": "image/png"}]
    document["textures"] = [{"source": 0}]
    surface = {"baseColorTexture": {"index": 0}, "metallicFactor": 0, "roughnessFactor": 1}
    document["materials"] = [{"pbrMetallicRoughness": surface, "doubleSided": True}]


def srgb_to_linear(color: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
    """Linear light of sRGB colours, which are clipped to [0, 1].

    Args:
        color: sRGB, (*b, 3).

    Returns:
        Linear, (*b, 3).

    >>> srgb_to_linear(np.ones((1, 3))).tolist()
    [[1.0, 1.0, 1.0]]
    """
    color = np.clip(color, 0, 1)
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(color: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
    """The inverse of `srgb_to_linear`.

    Args:
        color: linear, (*b, 3).

    Returns:
        sRGB, (*b, 3).

    >>> float(np.round(linear_to_srgb(srgb_to_linear(np.full((1, 3), 0.2)))[0, 0], 12))
    0.2
    """
    color = np.clip(color, 0, 1)
    return np.where(color <= 0.0031308, color * 12.92, 1.055 * color ** (1 / 2.4) - 0.055)
