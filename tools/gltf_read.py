"""The scene of a glTF file as one mesh: nodes placed, skins joined, seams closed."""

from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

import numpy as np

from .gltf_file import GltfFile
from .gltf_write import linear_to_srgb
from .images import decoded
from .meshio import Mesh, Skeleton

_STILL = 1e-6  # skinning matrices this near to identity are rounding, relative to the size
_POINTS, _TRIANGLES, _STRIP, _FAN = 0, 4, 5, 6


@dataclass
class _Piece:
    """One primitive in the scene."""

    verts: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None
    colors: np.ndarray | None
    weights: np.ndarray | None
    origin: np.ndarray | None
    material: int | None


class _Scene:
    """The nodes that the default scene shows, with their matrices."""

    def __init__(self, file: GltfFile) -> None:
        self.file = file
        self.world: dict[int, np.ndarray] = {}
        self.parent: dict[int, int] = {}
        self.order: list[int] = []
        scenes = file.json.get("scenes", [])
        nodes = range(len(file.json.get("nodes", [])))
        if scenes:
            roots = file.item("scenes", file.json.get("scene", 0)).get("nodes", [])
        else:
            inner = {c for n in nodes for c in file.item("nodes", n).get("children", [])}
            roots = [n for n in nodes if n not in inner]
        for root in roots:
            self._visit(root)

    def _visit(self, root: int) -> None:
        waiting = [(root, np.eye(4), -1)]
        while waiting:
            index, above, parent = waiting.pop()
            if index in self.world:
                raise self.file.error(f"nodes: expected a tree, found node {index} twice")
            node = self.file.item("nodes", index)
            self.world[index] = above @ _local(node)
            self.parent[index] = parent
            self.order.append(index)
            children = [(c, self.world[index], index) for c in node.get("children", [])]
            waiting += reversed(children)

    def shown(self) -> list[int]:
        return [n for n in self.order if "mesh" in self.file.item("nodes", n)]


def _local(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), dtype=np.float64)
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= np.array(node.get("scale", (1, 1, 1)), dtype=np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


class _Joints:
    """The joints of all skins, parents before children."""

    def __init__(self, scene: _Scene) -> None:
        self.scene = scene
        file = scene.file
        used = [file.item("nodes", n).get("skin") for n in scene.shown()]
        skins = [s for s in dict.fromkeys(used) if s is not None]
        if not skins and file.json.get("skins"):
            skins = [0]
        nodes = [n for s in skins for n in file.item("skins", s)["joints"] if n in scene.world]
        self.nodes = self._sorted(list(dict.fromkeys(nodes)))
        self.place = {node: column for column, node in enumerate(self.nodes)}

    def _sorted(self, nodes: list[int]) -> list[int]:
        among = set(nodes)
        done: dict[int, None] = {}
        for node in nodes:
            chain = []
            at = node
            while at >= 0:
                if at in among and at not in done:
                    chain.append(at)
                at = self.scene.parent[at]
            done |= dict.fromkeys(reversed(chain))
        return list(done)

    def above(self, node: int) -> int:
        """Column of the nearest joint above a node, -1 if there is none."""
        at = self.scene.parent[node]
        while at >= 0 and at not in self.place:
            at = self.scene.parent[at]
        return self.place.get(at, -1)

    def skeleton(self) -> Skeleton | None:
        if not self.nodes:
            return None
        names = (self.scene.file.item("nodes", n).get("name") for n in self.nodes)
        return Skeleton(
            names=tuple(str(name or f"joint_{j}") for j, name in enumerate(names)),
            parents=tuple(self.above(n) for n in self.nodes),
            joints=np.array([self.scene.world[n][:3, 3] for n in self.nodes]),
        )


def mesh_of(file: GltfFile) -> Mesh:
    """The default scene of a file as one mesh.

    Args:
        file: the file.

    Returns:
        The mesh as a viewer shows it; vertices that differ by texture coordinates alone are one.

    Raises:
        InputError: no triangles or points, or damaged content.
    """
    scene = _Scene(file)
    joints = _Joints(scene)
    notes: list[str] = []
    pieces = [p for n in scene.shown() for p in _pieces(scene, joints, n, notes)]
    if not pieces:
        raise file.error("expected a mesh in the scene, found none; export it with its mesh")
    merged = _joined(pieces)
    texture = _texture(file, pieces, notes)
    for kind in ("animations", "cameras"):
        if file.json.get(kind):
            notes.append(f"{kind}: not kept")
    names = [file.item("meshes", file.item("nodes", n)["mesh"]).get("name") for n in scene.shown()]
    closed = _closed(merged, notes)
    return Mesh(
        closed.verts,
        closed.faces,
        corner_uv=closed.uv,
        weights=closed.weights,
        skeleton=joints.skeleton(),
        colors=closed.colors,
        texture=texture,
        name=str(names[0] or PurePath(file.path).stem),
        notes=tuple(dict.fromkeys(notes)),
    )


def _pieces(scene: _Scene, joints: _Joints, node: int, notes: list[str]) -> list[_Piece]:
    file = scene.file
    entry = file.item("nodes", node)
    found = []
    for primitive in file.item("meshes", entry["mesh"])["primitives"]:
        mode = primitive.get("mode", _TRIANGLES)
        if mode not in (_POINTS, _TRIANGLES, _STRIP, _FAN):
            notes.append("lines: not kept")
            continue
        if primitive.get("targets"):
            notes.append("morph targets: not kept")
        found.append(_piece(scene, joints, node, primitive, mode))
    return found


def _piece(
    scene: _Scene, joints: _Joints, node: int, primitive: dict[str, Any], mode: int
) -> _Piece:
    file, attributes = scene.file, primitive["attributes"]
    if "POSITION" not in attributes:
        raise file.error("primitive: expected positions, found none; export it again")
    verts = file.array(attributes["POSITION"]).astype(np.float64)
    index = np.arange(len(verts))
    if "indices" in primitive:
        index = file.array(primitive["indices"]).astype(np.int64)
    if index.size and index.max() >= len(verts):
        raise file.error(f"indices: expected below {len(verts)}, found {index.max()}")
    texcoord = attributes.get(f"TEXCOORD_{_texcoord_set(file, primitive)}")
    uv = None if texcoord is None else file.array(texcoord).astype(np.float64)
    colors = None
    if "COLOR_0" in attributes:
        colors = linear_to_srgb(file.array(attributes["COLOR_0"]).astype(np.float64)[:, :3])
    skin = file.item("nodes", node).get("skin")
    if skin is not None and "JOINTS_0" in attributes:
        weights, verts = _skinned(scene, joints, file.item("skins", skin), attributes, verts)
    else:
        matrix = scene.world[node]
        if not np.array_equal(matrix, np.eye(4)):
            verts = verts @ matrix[:3, :3].T + matrix[:3, 3]
        weights = None
        if joints.nodes:
            weights = np.zeros((len(verts), len(joints.nodes)))
            weights[:, max(joints.above(node), 0)] = 1
    return _Piece(
        verts=verts,
        faces=_faces(index, mode),
        uv=None if uv is None else np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1),
        colors=colors,
        weights=weights,
        origin=file.array(attributes["_VERTEX"]) if "_VERTEX" in attributes else None,
        material=primitive.get("material"),
    )


def _faces(index: np.ndarray, mode: int) -> np.ndarray:
    if mode == _TRIANGLES:
        return index[: len(index) // 3 * 3].reshape(-1, 3)
    if mode == _POINTS or len(index) < 3:
        return np.zeros((0, 3), dtype=np.int64)
    if mode == _FAN:
        first = np.full(len(index) - 2, index[0])
        return np.stack([first, index[1:-1], index[2:]], axis=1)
    faces = np.stack([index[:-2], index[1:-1], index[2:]], axis=1)
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces


def _skinned(
    scene: _Scene,
    joints: _Joints,
    skin: dict[str, Any],
    attributes: dict[str, int],
    verts: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Weights over all joints, and the vertices where the skin shows them."""
    file, nodes = scene.file, skin["joints"]
    local = np.zeros((len(verts), len(nodes)))
    rows = np.arange(len(verts))[:, None]
    sets = sum(1 for name in attributes if name.startswith("JOINTS_"))
    for n in range(sets):
        chosen = file.array(attributes[f"JOINTS_{n}"]).astype(np.int64)
        values = file.array(attributes[f"WEIGHTS_{n}"]).astype(np.float64)
        if chosen.size and chosen.max() >= len(nodes):
            raise file.error(f"joints: expected below {len(nodes)}, found {chosen.max()}")
        np.add.at(local, (np.broadcast_to(rows, chosen.shape), chosen), values)
    sums = local.sum(axis=1, keepdims=True)
    local = np.divide(local, sums, out=local, where=sums > 0)
    bind = np.tile(np.eye(4), (len(nodes), 1, 1))
    if "inverseBindMatrices" in skin:
        bind = file.array(skin["inverseBindMatrices"]).astype(np.float64).transpose(0, 2, 1)
    world = np.array([scene.world.get(n, np.eye(4)) for n in nodes])
    matrices = world @ bind[: len(nodes)]
    size = max(1.0, float(np.abs(verts).max(initial=0.0)))
    if np.abs(matrices - np.eye(4)).max(initial=0.0) > _STILL * size:
        blended = np.einsum("vj,jab->vab", local, matrices)
        blended[sums[:, 0] <= 0] = np.eye(4)
        verts = np.einsum("vab,vb->va", blended[:, :3, :3], verts) + blended[:, :3, 3]
    weights = np.zeros((len(verts), len(joints.nodes)))
    for column, node in enumerate(nodes):
        if node in joints.place:
            weights[:, joints.place[node]] += local[:, column]
    return weights, verts


def _joined(pieces: list[_Piece]) -> _Piece:
    """All primitives as one; what only some have is filled with 0 (colours: with white)."""
    counts = [len(p.verts) for p in pieces]
    starts = np.cumsum([0, *counts[:-1]])

    def gathered(name: str, width: int, fill: float) -> np.ndarray | None:
        values = [getattr(p, name) for p in pieces]
        if all(value is None for value in values):
            return None
        return np.concatenate(
            [
                np.full((n, width), fill) if value is None else value
                for n, value in zip(counts, values, strict=True)
            ]
        )

    joints = max((p.weights.shape[1] for p in pieces if p.weights is not None), default=0)
    return _Piece(
        verts=np.concatenate([p.verts for p in pieces]),
        faces=np.concatenate([p.faces + s for p, s in zip(pieces, starts, strict=True)]),
        uv=gathered("uv", 2, 0.0),
        colors=gathered("colors", 3, 1.0),
        weights=gathered("weights", joints, 0.0),
        origin=pieces[0].origin if len(pieces) == 1 else None,
        material=None,
    )


def _closed(piece: _Piece, notes: list[str]) -> _Piece:
    """With one vertex where the file has several; `uv` becomes that of the corners."""
    place = _origins(piece)
    if place is None:
        keys = [piece.verts + 0.0]
        keys += [v for v in (piece.weights, piece.colors) if v is not None]
        _, first, inverse = np.unique(
            np.concatenate(keys, axis=1), axis=0, return_index=True, return_inverse=True
        )
        order = np.argsort(first)  # vertices keep the order of their first copies
        rank = np.zeros(len(order), dtype=np.int64)
        rank[order] = np.arange(len(order))
        place = rank[inverse.reshape(-1)]
        if len(order) < len(piece.verts):
            notes.append(f"vertices: {len(piece.verts) - len(order)} merged with equal ones")
    source = np.zeros(int(place.max(initial=-1)) + 1, dtype=np.int64)
    source[place[::-1]] = np.arange(len(place))[::-1]
    uv = None if piece.uv is None or not len(piece.faces) else piece.uv[piece.faces]
    return _Piece(
        verts=piece.verts[source],
        faces=place[piece.faces],
        uv=uv,
        colors=None if piece.colors is None else piece.colors[source],
        weights=None if piece.weights is None else piece.weights[source],
        origin=None,
        material=None,
    )


def _origins(piece: _Piece) -> np.ndarray | None:
    """The vertex numbers that our own writer left, if they make sense."""
    if piece.origin is None or piece.origin.shape != (len(piece.verts),):
        return None
    place = piece.origin.astype(np.int64)
    count = int(place.max(initial=-1)) + 1
    if place.min(initial=0) < 0 or count > len(place) or len(np.unique(place)) != count:
        return None
    source = np.zeros(count, dtype=np.int64)
    source[place] = np.arange(len(place))
    return place if np.array_equal(piece.verts[source][place], piece.verts) else None


def _texcoord_set(file: GltfFile, primitive: dict[str, Any]) -> int:
    return _base_color(file, primitive.get("material")).get("texCoord", 0)


def _base_color(file: GltfFile, material: int | None) -> dict[str, Any]:
    if material is None:
        return {}
    surface = file.item("materials", material).get("pbrMetallicRoughness", {})
    return surface.get("baseColorTexture", {})


def _texture(file: GltfFile, pieces: list[_Piece], notes: list[str]) -> np.ndarray | None:
    used = [_base_color(file, p.material) for p in pieces]
    sources = [file.item("textures", t["index"]).get("source") for t in used if "index" in t]
    images = [s for s in dict.fromkeys(sources) if s is not None]
    if len(images) != 1:
        if images:
            notes.append(f"textures: {len(images)} pictures, not kept")
        return None
    image = file.item("images", images[0])
    data = file.view(image["bufferView"])[0] if "bufferView" in image else file.linked(image["uri"])
    return decoded(data, f"{file.path}: picture {images[0]}")
