"""Stress of distances along surfaces, of weights and rows of meshes, and of their graphs."""

import heapq
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.bone_heat import heat_weights
from monopart.geometry.geodesics import part_bands, surface_distance
from monopart.geometry.mesh_graph import face_graph, vertex_graph
from monopart.geometry.part_cleaning import remove_islands, smooth_labels
from monopart.geometry.parts import PartMap
from monopart.geometry.weight_transfer import closest_faces, transfer_rows

from .stability_atlas import sheet
from .stability_cases import DOUBLE, Family, Inputs, Stress, Way
from .stability_meshes import Mesh, ball, exact_distance, near, scene, soup
from .stability_rotations import Make

# these operations take arrays: numbers of float32 reach them as such


def plain(run: Callable[..., np.ndarray], name: str = "monopart") -> Way:
    """A way of arrays; results are compared as they come."""

    def on_tensors(extra: Any, *inputs: Tensor) -> Tensor:
        return torch.from_numpy(np.asarray(run(extra, *(x.numpy() for x in inputs)), np.float64))

    return Way(name, on_tensors, True, differentiable=False)


def moved(mesh: Mesh, size: float = 1.0, away: float = 0.0) -> Make:
    """The vertices of a mesh in another size and place."""
    return lambda g, n: (size * mesh.verts + away,)


def _sizes(mesh: Mesh, extra: Any) -> list[Family]:
    shapes = (("1 m", 1.0, 0.0), ("1e-6 m", 1e-6, 0.0), ("1e6 m", 1e6, 0.0), ("1 km off", 1.0, 1e3))
    return [Family(n, moved(mesh, s, a), extra=extra) for n, s, a in shapes]


def _extent(extra: Any, exact: np.ndarray, verts: np.ndarray, *rest: np.ndarray) -> float:
    return max(float(np.abs(verts).max(initial=0)), 1e-300)


# --- along the surface -------------------------------------------------------------------------


def _geodesics() -> Stress:
    """From one side of a folded sheet: distances are those of the plane, whatever the fold."""
    flat, folded = sheet(), sheet(1.0, 0.3)
    doubled = Mesh(
        flat.verts[flat.faces].reshape(-1, 3), torch.arange(3 * len(flat.faces)).view(-1, 3)
    )

    def run(mesh: Mesh, verts: np.ndarray) -> np.ndarray:
        return surface_distance(verts, mesh.faces.numpy(), _first_row(mesh))

    def exact(mesh: Mesh, verts: np.ndarray) -> np.ndarray:
        return np.abs(verts[:, 1] - verts[:, 1].min())

    families = _sizes(flat, flat)
    families += [Family("folded", moved(folded), extra=folded)]
    families += [Family("every corner its own vertex", moved(doubled), extra=doubled)]
    return Stress(
        name="surface_distance",
        title="distances along a surface",
        domain="finite meshes of any size (others are an error); infinite where no way leads",
        error="largest coordinate",
        families=tuple(families),
        ways=(plain(run),),
        exact=exact,
        scale=_extent,
        wrt=(),
        cases=8,
    )


def _first_row(mesh: Mesh) -> np.ndarray:
    return np.flatnonzero(mesh.verts[:, 1].numpy() == 0)


def _bands() -> Stress:
    """Two halves of a sheet that reach over their border; shares by the stated formula."""
    mesh = sheet()
    labels = (mesh.verts[mesh.faces][..., 1].mean(1) > 0.5).long().numpy()

    def run(size: float, verts: np.ndarray) -> np.ndarray:
        return part_bands(labels, verts, mesh.faces.numpy(), 2, 0.6 * size).shares

    def exact(size: float, verts: np.ndarray) -> np.ndarray:
        y = mesh.verts[:, 1].numpy()
        pull = np.stack((1 - np.maximum(y - 0.5, 0) / 0.6, 1 - np.maximum(0.5 - y, 0) / 0.6), 1)
        return pull / pull.sum(1, keepdims=True)

    shapes = (("1 m", 1.0, 0.0), ("1e-6 m", 1e-6, 0.0), ("1e6 m", 1e6, 0.0), ("1 km off", 1.0, 1e3))
    return Stress(
        name="part_bands",
        title="bands where parts overlap (shares)",
        domain="finite meshes of any size; as good as the last place of a vertex over the width",
        error="1, and the place over the width",
        families=tuple(Family(n, moved(mesh, s, a), extra=s) for n, s, a in shapes),
        ways=(plain(run),),
        exact=exact,
        scale=lambda size, exact, verts: 4 * max(1.0, np.abs(verts).max() / size),
        wrt=(),
        cases=8,
    )


# --- graphs and labels -------------------------------------------------------------------------


def _exact_graphs(faces: np.ndarray, verts: np.ndarray) -> np.ndarray:
    """Total weight and mass of the graph of faces and of that of vertices, face by face."""
    border, wall, area = 0.0, 0.0, 0.0
    seen: dict[tuple[int, int], int] = {}
    for face in faces:
        corner = verts[face].astype(np.longdouble)
        area += float(np.sqrt((np.cross(corner[1] - corner[0], corner[2] - corner[0]) ** 2).sum()))
        for k in range(3):
            a, b = sorted((int(face[k]), int(face[(k + 1) % 3])))
            side = verts[[a, b]].astype(np.longdouble)
            wall += float(np.sqrt(((side.mean(0) - corner.mean(0)) ** 2).sum()))
            if seen.setdefault((a, b), 0):
                border += float(np.sqrt(((side[0] - side[1]) ** 2).sum()))
            seen[a, b] += 1
    return np.array([[border, area / 2], [wall, area / 2]])


def _graphs() -> Stress:
    mesh = ball()

    def run(faces: Tensor, verts: np.ndarray) -> np.ndarray:
        graphs = (made(verts, faces.numpy()) for made in (face_graph, vertex_graph))
        return np.array([[float(g.weights.sum()), float(g.mass.sum())] for g in graphs])

    def off(found: np.ndarray, exact: np.ndarray) -> np.ndarray:
        return np.abs(found / exact - 1).max(1)

    return Stress(
        name="mesh_graphs",
        title="graphs of faces and vertices (sums of weights and areas)",
        domain="finite meshes; as good as the last place of a vertex over the length of an edge",
        error="the sum, and the place over the length of an edge (0.1 of the size)",
        families=tuple(_sizes(mesh, mesh.faces)),
        ways=(plain(run),),
        exact=lambda faces, verts: _exact_graphs(faces.numpy(), verts),
        off=off,
        scale=lambda faces, exact, verts: 20 * np.abs(verts).max() / np.ptp(verts, axis=0).max(),
        wrt=(),
        cases=8,
    )


def _labels() -> Stress:
    """Two labels over a small sheet: the least energy of all labellings, and no islands."""
    mesh = sheet()
    graph = face_graph(mesh.verts.numpy(), mesh.faces.numpy())
    few = 10  # of these faces the cost decides; the others are told

    def energy(labels: np.ndarray, costs: np.ndarray) -> float:
        apart = labels[graph.edges[:, 0]] != labels[graph.edges[:, 1]]
        return float(costs[np.arange(len(labels)), labels].sum() + graph.weights[apart].sum())

    def run(extra: None, costs: np.ndarray) -> np.ndarray:
        labels = smooth_labels(costs.astype(np.float64), graph)
        whole = remove_islands(labels, graph)
        pieces = max(_pieces(whole == k, graph.edges) for k in (0, 1))
        return np.array([[energy(labels, costs.astype(np.float64)), max(pieces, 1)]])

    def exact(extra: None, costs: np.ndarray) -> np.ndarray:
        told = np.where(costs[:, 0] > costs[:, 1], 1, 0)
        best = np.inf
        for number in range(1 << few):
            told[:few] = [number >> k & 1 for k in range(few)]
            best = min(best, energy(told, costs))
        return np.array([[best, 1.0]])

    def costs(size: float) -> Make:
        def make(generator: torch.Generator, count: int) -> Inputs:
            told = 1e3 * torch.eye(2, dtype=DOUBLE)[torch.arange(len(mesh.faces)) % 2 * 0]
            told[len(mesh.faces) // 2 :] = told[len(mesh.faces) // 2 :].flip(1)
            told[:few] = size * torch.rand(few, 2, generator=generator, dtype=DOUBLE)
            return (told,)

        return make

    shapes = (("usual", 0.5), ("0", 0.0), ("1e-12", 1e-12), ("1e2", 1e2))
    return Stress(
        name="labels",
        title="cut of least energy, without islands (energy, pieces)",
        domain="finite costs ≥ 0 (others are an error); capacities are whole numbers, 2²⁸ of the "
        "largest cost",
        error="largest cost (1000 m) over 2²⁸",
        families=tuple(Family(n, costs(s)) for n, s in shapes),
        ways=(plain(run),),
        exact=exact,
        scale=lambda extra, exact, costs: 1e3,
        wrt=(),
        cases=8,
        double=1e-6,
    )


def _pieces(inside: np.ndarray, edges: np.ndarray) -> int:
    """Connected pieces of some nodes."""
    left, count = set(np.flatnonzero(inside).tolist()), 0
    while left:
        queue, count = [left.pop()], count + 1
        while queue:
            node = heapq.heappop(queue)
            for a, b in edges[(edges == node).any(1)].tolist():
                other = b if a == node else a
                if other in left:
                    left.discard(other)
                    heapq.heappush(queue, other)
    return count


def _joint_parts() -> Stress:
    """The part of the largest weight, by a loop; of equal weights the first."""
    table = PartMap.default()

    def run(faces: Tensor, weights: Tensor) -> Tensor:
        parts = table.vertex_parts(weights)
        return torch.cat((parts, table.face_parts(weights, faces)))[:, None].to(weights)

    def exact(faces: Tensor, weights: np.ndarray) -> np.ndarray:
        part = [table.joint_part[int(np.flatnonzero(w == w.max())[0])] for w in weights]
        out = list(part)
        for face in faces.tolist():
            votes = np.bincount([part[v] for v in face], minlength=table.num_parts)
            share = np.zeros(table.num_parts)
            for joint, own in enumerate(table.joint_part):
                share[own] += weights[face, joint].sum()
            most = votes == votes.max()
            out.append(int(np.where(most, share, -1).argmax()))
        return np.array(out, np.float64)[:, None]

    def rows(kind: str) -> Make:
        def make(generator: torch.Generator, count: int) -> Inputs:
            weights = torch.rand(60, 24, generator=generator, dtype=DOUBLE)
            if kind == "equal weights":
                weights = torch.ones_like(weights)
            elif kind == "one joint":
                at = torch.randint(0, 24, (60,), generator=generator)
                weights = torch.eye(24, dtype=DOUBLE)[at]
            return (weights * {"sum 1e-30": 1e-30, "sum 1e30": 1e30}.get(kind, 1.0),)

        return make

    faces = torch.arange(60).view(20, 3)
    kinds = ("usual", "equal weights", "one joint", "sum 1e-30", "sum 1e30")
    return Stress(
        name="part_map",
        title="parts of vertices and faces",
        domain="weights of any sum; of equal ones the first joint decides",
        error="right or wrong",
        families=tuple(Family(k, rows(k), extra=faces) for k in kinds),
        ways=(Way("monopart", run, True, differentiable=False),),
        exact=exact,
        wrt=(),
        cases=8,
    )


# --- weights and rows --------------------------------------------------------------------------


def _heat() -> Stress:
    """Rows of a body of one bone sum to 1; of two mirrored bones they mirror each other."""
    mesh = ball(0.5)
    joints, parents = np.array([[0.0, 0, 0], [-0.3, 0, 0], [0.3, 0, 0]]), (-1, 0, 0)

    def run(given: tuple[float, float], verts: np.ndarray) -> np.ndarray:
        size, away = given
        verts = verts.astype(np.float64)
        weights = heat_weights(verts, mesh.faces.numpy(), size * joints + away, parents)
        return np.stack((weights.sum(1) - 1, np.minimum(weights.min(1), 0)), 1)

    shapes = (
        *(("1 m", 1.0, 0.0), ("1e-3 m", 1e-3, 0.0), ("1e3 m", 1e3, 0.0), ("1e-6 m", 1e-6, 0.0)),
        ("1 km off", 1.0, 1e3),
    )
    return Stress(
        name="heat_weights",
        title="weights by heat (sum and sign)",
        domain="finite meshes of any size; a piece that sees no bone keeps to the nearest",
        error="1",
        families=tuple(Family(n, moved(mesh, s, a), extra=(s, a)) for n, s, a in shapes),
        ways=(plain(run),),
        exact=lambda given, verts: np.zeros((len(verts), 2)),
        wrt=(),
        cases=8,
        double=1e-12,
    )


def _rows() -> Stress:
    """Places of vertices as rows, carried to points of the same surface: each gets its own."""
    mesh = ball()

    def run(faces: Tensor, verts: np.ndarray) -> np.ndarray:
        corners = verts[faces.numpy()]
        middle = corners.mean(1)
        new = np.concatenate((verts, middle))
        count = len(verts)
        sides = [
            np.stack(
                (faces.numpy()[:, k], faces.numpy()[:, (k + 1) % 3], np.arange(len(faces)) + count),
                1,
            )
            for k in range(3)
        ]
        target = (new, np.concatenate(sides))
        rows, _ = transfer_rows(verts.astype(np.float64), (verts, faces.numpy()), target)
        return rows - new

    return Stress(
        name="transfer_rows",
        title="rows carried to another mesh",
        domain="finite meshes (others are an error); rows as good as the last place of a vertex",
        error="largest coordinate",
        families=tuple(_sizes(mesh, mesh.faces)),
        ways=(plain(run),),
        exact=lambda faces, verts: np.zeros((len(verts) + len(faces), 3)),
        scale=_extent,
        wrt=(),
        cases=8,
    )


def _closest() -> Stress:
    """Distances by libigl: as exact as it is, needles apart."""
    whole = ball()
    shapes = (
        *(("3 cm", near(whole, 0.03), whole), ("on faces", near(whole, 0.0), whole)),
        *(("on vertices", near(whole, 0.0, "vertex"), whole),),
        ("degenerate", near(soup("degenerate"), 0.03), soup("degenerate")),
        ("1e6 m off", near(whole, 1e6), whole),
        ("1e3 m", near(ball(1e3), 30.0), ball(1e3)),
    )

    def run(faces: Tensor, points: np.ndarray, verts: np.ndarray) -> np.ndarray:
        return closest_faces(points.astype(np.float64), verts.astype(np.float64), faces.numpy())[2]

    families = [Family(n, m, extra=mesh.faces) for n, m, mesh in shapes]
    thin = soup("1e-5")
    families.append(Family("needles 1e-5", near(thin, 0.01), extra=thin.faces, inside=False))
    return Stress(
        name="closest_faces",
        title="closest faces in numpy (distance)",
        domain="finite points and meshes (others are an error); on needles libigl loses digits",
        error="largest coordinate of mesh and point; 1e-8 on the surface, the root of a square",
        families=tuple(families),
        ways=(plain(run),),
        exact=exact_distance,
        scale=scene,
        wrt=(),
        cases=64,
        double=1e-7,
    )


def stresses() -> list[Stress]:
    """Operations on meshes as arrays."""
    from . import stability_alignment

    own = [_geodesics(), _bands(), _graphs(), _labels(), _joint_parts(), _heat(), _rows()]
    return [*own, _closest(), *stability_alignment.stresses()]
