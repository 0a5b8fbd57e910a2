"""Where to cut a surface: cost of each edge, mirror images, discs, slits and splits."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from .uv_energy import RestShape, flat_triangles
from .uv_mesh import CutMesh, MeshEdges

_VIEWS = 48
_CELLS = 4096
"""Of a depth map along the longest side, at most."""
_SHOWN = 3.0
"""How much dearer a seam is where the surface is seen from everywhere than where from nowhere."""
_LONE = 4.0
"""How much dearer a seam of a symmetric mesh is where its triangles have no mirror image."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh with what the choice of seams needs to know about it."""

    verts: Float[np.ndarray, "V 3"]
    edges: MeshEdges
    mirror: Int[np.ndarray, "V"] | None = None
    """The vertex at the mirror image of each vertex, for a symmetric surface."""
    side: Float[np.ndarray, "V"] | None = None
    """Signed distance of each vertex from the mirror plane."""

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        """Vertex indices."""
        return self.edges.faces

    @cached_property
    def flat(self) -> Float[np.ndarray, "F 2 2"]:
        """Every triangle laid into the plane."""
        return flat_triangles(self.verts, self.faces)

    @cached_property
    def rest(self) -> RestShape:
        """Rest shape of the triangles."""
        return RestShape.of_flat(self.flat)

    @cached_property
    def length(self) -> Float[np.ndarray, "E"]:
        """Length of each edge."""
        a, b = self.verts[self.edges.verts].transpose(1, 0, 2)
        return np.linalg.norm(a - b, axis=-1)

    @cached_property
    def cost(self) -> Float[np.ndarray, "E"]:
        """Price of a seam along each edge: its length, times more where it is seen."""
        seen = openness(self.verts, self.faces)
        if self.mirror is not None:
            seen = (seen + seen[self.mirror]) / 2
        floor = 1e-6 * max(float(self.length.max(initial=0.0)), 1e-30)
        cost = np.maximum(self.length, floor) * (1 + _SHOWN * seen[self.edges.verts].mean(1))
        if self.mirror is not None:
            # a seam that has a mirror image leaves two charts of which one tells the other
            lone = np.zeros(len(self.verts), bool)
            lone[self.faces[self.corner_image[:, 0] < 0]] = True
            cost = cost * np.where(lone[self.edges.verts].any(1), _LONE, 1.0)
        return cost

    @cached_property
    def face_image(self) -> Int[np.ndarray, "F"]:
        """The face nearest to the mirror image of each face, for a symmetric surface."""
        from scipy.spatial import KDTree

        mirror = np.arange(len(self.verts)) if self.mirror is None else self.mirror
        centre = self.verts[self.faces].mean(1)
        _, nearest = KDTree(centre).query(self.verts[mirror[self.faces]].mean(1))
        return np.asarray(nearest, np.int64)

    @cached_property
    def corner_image(self) -> Int[np.ndarray, "F 3"]:
        """The corner (3 · face + corner) at the mirror image of each, −1 where no face is it."""
        if self.mirror is None:
            return np.full(self.faces.shape, -1, np.int64)
        there = self.faces[self.face_image]
        match = self.mirror[self.faces][:, :, None] == there[:, None]
        found = 3 * self.face_image[:, None] + match.argmax(2)
        whole = match.any(1).all(1) & match.any(2).all(1)
        return np.where(whole[:, None], found, -1)

    @classmethod
    def of(
        cls, verts: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], symmetric: bool = True
    ) -> "Surface":
        """Prepare a mesh, with its mirror plane where it is asked for and there is one."""
        found = mirror_of(verts, faces) if symmetric else None
        mirror, side = (None, None) if found is None else found
        return cls(verts, MeshEdges.of(faces), mirror, side)

    @property
    def curvature(self) -> float:
        """Sum of the absolute angle defects of the inner vertices: 4π for a convex surface."""
        side = np.roll(self.verts[self.faces], -1, 1) - self.verts[self.faces]
        back = -np.roll(side, 1, 1)
        size = np.linalg.norm(side, axis=-1) * np.linalg.norm(back, axis=-1)
        cosine = (side * back).sum(-1) / np.maximum(size, 1e-300)
        angle = np.arccos(np.clip(cosine, -1.0, 1.0))
        total = np.bincount(self.faces.reshape(-1), angle.reshape(-1), minlength=len(self.verts))
        inner = np.bincount(self.faces.reshape(-1), minlength=len(self.verts)) > 0
        inner[self.edges.verts[~self.edges.joinable]] = False
        return float(np.abs(2 * np.pi - total[inner]).sum())

    def graph(self, cut: CutMesh, cost: Float[np.ndarray, "E"] | None = None) -> Any:
        """Vertices of a cut mesh joined by its uncut edges, weighted by cost."""
        from scipy.sparse import coo_matrix

        inner = np.flatnonzero(~cut.seams)
        half = self.edges.sides[inner, 0]
        a = cut.faces.reshape(-1)[half]
        b = cut.faces.reshape(-1)[half - half % 3 + (half + 1) % 3]
        weight = (self.cost if cost is None else cost)[inner]
        count = len(cut.origin)
        pairs = (np.concatenate([a, b]), np.concatenate([b, a]))
        graph = coo_matrix((np.concatenate([weight, weight]), pairs), (count, count)).tocsr()
        return graph


def mirror_of(
    verts: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> tuple[Int[np.ndarray, "V"], Float[np.ndarray, "V"]] | None:
    """The vertex nearest to the mirror image of each vertex, if the mesh has a mirror plane.

    The planes through the middle of the box across x, y and z are tried, in this order.

    Args:
        verts: vertices.
        faces: vertex indices.

    Returns:
        Vertex indices and the signed distance of each vertex from the plane, or None where no
        plane brings 95 % of the vertices onto others (to a tenth of the mean edge).
    """
    from scipy.spatial import KDTree

    if len(faces) == 0:
        return None
    used = np.unique(faces)
    points = verts[used]
    edge = np.linalg.norm(verts[faces[:, 0]] - verts[faces[:, 1]], axis=-1).mean()
    middle = (points.min(0) + points.max(0)) / 2
    tree = KDTree(points)
    for axis in range(3):
        flipped = points.copy()
        flipped[:, axis] = 2 * middle[axis] - flipped[:, axis]
        distance, nearest = tree.query(flipped)
        if np.quantile(distance, 0.95) <= 0.1 * edge:
            out = np.arange(len(verts))
            out[used] = used[nearest]
            return out, verts[:, axis] - middle[axis]
    return None


def openness(
    verts: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "V"]:
    """Share of directions from which each vertex is seen, among those in front of it.

    Depth maps from directions spread over the sphere, with cells of about an edge.

    Args:
        verts: vertices.
        faces: vertex indices.

    Returns:
        Shares in [0, 1].
    """
    corners = verts[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = np.zeros_like(verts)
    for k in range(3):
        for axis in range(3):
            normal[:, axis] += np.bincount(faces[:, k], cross[:, axis], minlength=len(verts))
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.divide(normal, size, out=np.zeros_like(normal), where=size > 0)
    points = np.concatenate([verts, corners.mean(1)])
    edge = np.sqrt(np.maximum(np.linalg.norm(cross, axis=1).mean(), 1e-60)) * 1.2
    edge = max(edge, float(np.ptp(points, axis=0).max()) / _CELLS)  # needles, or no area at all
    seen, front = np.zeros(len(verts)), np.zeros(len(verts))
    for view in _directions(_VIEWS):
        towards = normal @ view
        side = np.linalg.svd(view[None])[2][1:]
        cell = ((points @ side.T - (points @ side.T).min(0)) / edge).astype(np.int64)
        width = int(cell[:, 0].max()) + 1
        key = cell[:, 1] * width + cell[:, 0]
        depth = points @ view
        top = np.full(int(key.max()) + 1, -np.inf)
        np.maximum.at(top, key, depth)
        count = len(verts)
        slope = np.sqrt(np.maximum(1 - towards**2, 0)) / np.maximum(towards, 0.1)
        clear = depth[:count] >= top[key[:count]] - edge * (1.5 * slope + 0.5)
        weight = np.maximum(towards, 0.0)
        front += weight
        seen += weight * clear
    return np.divide(seen, front, out=np.zeros(len(verts)), where=front > 0)


def _directions(count: int) -> Float[np.ndarray, "n 3"]:
    """Directions spread evenly and mirror-symmetric in x, y and z."""
    k = np.arange(count // 8) + 0.5
    z = k / len(k)
    turn = np.pi / 2 * ((k * 0.6180339887498949) % 1)
    flat = np.sqrt(1 - z * z)
    octant = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], 1)
    signs = np.array([[a, b, c] for a in (1, -1) for b in (1, -1) for c in (1, -1)])
    return (octant[:, None] * signs).reshape(-1, 3)


def cut_to_discs(surface: Surface, seams: Bool[np.ndarray, "E"]) -> Bool[np.ndarray, "E"]:
    """Add the seams that make every chart a disc.

    Paths of least cost grow from the border of a chart (from one vertex where it has none); the
    edges that neither they nor a tree over the faces use close a loop each. The shortest of them
    are cut: they join the loops of the border and open the handles.

    Args:
        surface: the mesh.
        seams: edges that are cut already.

    Returns:
        Edges to cut; every chart has Euler characteristic 1.

    Reference:
        Erickson and Whittlesey 2005, greedy system of loops.
    """
    for _ in range(4):
        cut = CutMesh.of(surface.edges, seams)
        bad = cut.euler != 1
        if not bad.any():
            return seams
        seams = seams.copy()
        if (cut.euler == 2).any():
            seams[_sphere_slits(surface, cut)] = True
        if (bad & (cut.euler != 2)).any():
            seams[_handles(surface, cut, bad & (cut.euler != 2))] = True
    return seams


def _first_of(values: np.ndarray, count: int) -> np.ndarray:
    """First index of each value in 0..count − 1."""
    out = np.zeros(count, np.int64)
    out[values[::-1]] = np.arange(len(values))[::-1]
    return out


def _shortest(graph: Any, sources: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance to the nearest source and the next vertex on the way there (−1: none)."""
    from scipy.sparse.csgraph import dijkstra

    distance, before, _ = dijkstra(
        graph, directed=True, indices=sources, min_only=True, return_predecessors=True
    )
    return distance, np.where(before < 0, -1, before)


def _sphere_slits(surface: Surface, cut: CutMesh) -> np.ndarray:
    """For each closed sphere a path between two vertices far from each other."""
    graph = surface.graph(cut)
    spheres = np.flatnonzero(cut.euler == 2)
    start = _first_of(cut.vert_chart, cut.num_charts)[spheres]
    distance, _ = _shortest(graph, start)
    begin = _farthest(distance, cut.vert_chart, cut.num_charts)[spheres]
    distance, before = _shortest(graph, begin)
    end = _farthest(distance, cut.vert_chart, cut.num_charts)[spheres]
    return path_edges(surface, cut, before, end)


def _farthest(distance: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    order = np.argsort(np.where(np.isfinite(distance), distance, -1), kind="stable")
    out = np.zeros(count, np.int64)
    out[group[order]] = order
    return out


def path_edges(
    surface: Surface, cut: CutMesh, before: Int[np.ndarray, "W"], ends: Int[np.ndarray, "n"]
) -> Int[np.ndarray, "m"]:
    """Edges of the paths from some vertices back to the sources of a shortest-path tree.

    Args:
        surface: the mesh.
        cut: its cut, on whose vertices the tree grew.
        before: next vertex on the way to a source, −1 at a source.
        ends: vertices at which the paths begin.

    Returns:
        Edge indices, each once.
    """
    nexts, steps, seen = before.tolist(), [], set()
    for end in np.asarray(ends).tolist():
        at = end
        while nexts[at] >= 0 and at not in seen:
            seen.add(at)
            steps.append((at, nexts[at]))
            at = nexts[at]
    if not steps:
        return np.zeros(0, np.int64)
    pairs = np.sort(cut.origin[np.array(steps)], 1)
    return edge_index(surface.edges, pairs)


def edge_index(edges: MeshEdges, pairs: Int[np.ndarray, "n 2"]) -> Int[np.ndarray, "m"]:
    """Indices of edges given by their two vertices, the lower first; unknown ones are left out.

    Args:
        edges: of the mesh.
        pairs: vertices.

    Returns:
        Edge indices, each once.
    """
    base = int(edges.faces.max(initial=0)) + 1
    known = edges.verts[:, 0] * base + edges.verts[:, 1]
    key = np.unique(pairs[:, 0] * base + pairs[:, 1])
    at = np.minimum(np.searchsorted(known, key), len(known) - 1)
    return at[known[at] == key]


def _handles(surface: Surface, cut: CutMesh, bad: Bool[np.ndarray, "C"]) -> np.ndarray:
    """Edges of the loops that open the handles and join the borders of the bad charts."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import minimum_spanning_tree

    edges, graph = surface.edges, surface.graph(cut)
    closed = np.flatnonzero(
        bad & (np.bincount(cut.chart[_open_faces(cut)], minlength=len(bad)) == 0)
    )
    roots = np.concatenate(
        [np.unique(cut.border), _first_of(cut.vert_chart, cut.num_charts)[closed]]
    )
    distance, before = _shortest(graph, roots)
    inner = np.flatnonzero(~cut.seams)
    half = edges.sides[inner, 0]
    inside = bad[cut.chart[half // 3]]
    inner, half = inner[inside], half[inside]
    a = cut.faces.reshape(-1)[half]
    b = cut.faces.reshape(-1)[half - half % 3 + (half + 1) % 3]
    branch = (before[a] == b) | (before[b] == a)
    loop = distance[a] + distance[b] + surface.cost[inner]
    free = np.flatnonzero(~branch)
    # a tree over the faces that takes the longest loops first, so the shortest remain to be cut
    pairs = np.sort(edges.face_pairs[inner[free]], 1)
    order = np.lexsort((-loop[free], pairs[:, 1], pairs[:, 0]))
    lead = np.ones(len(order), bool)
    lead[1:] = (np.diff(pairs[order], axis=0) != 0).any(1)
    chosen = order[lead]
    count = len(edges.faces)
    weight = 2 * loop[free].max(initial=1.0) - loop[free][chosen]
    rows = (pairs[chosen, 0], pairs[chosen, 1])
    tree = minimum_spanning_tree(coo_matrix((weight, rows), (count, count)).tocsr()).tocoo()
    # the indices of a sparse matrix are of 32 bits: too few for the square of a large count
    kept = tree.row.astype(np.int64) * count + tree.col
    used = np.isin(pairs[chosen, 0].astype(np.int64) * count + pairs[chosen, 1], kept)
    rest = np.setdiff1d(free, free[chosen[used]])
    ends = np.concatenate([a[rest], b[rest]])
    return np.union1d(inner[rest], path_edges(surface, cut, before, ends))


def _open_faces(cut: CutMesh) -> np.ndarray:
    return np.flatnonzero(cut.seams[cut.edges.of_face].any(1))
