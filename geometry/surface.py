"""Closest point on a triangle mesh: a plain torch reference and a Warp search, both differentiable.

The search itself is piecewise constant. Once the face is known, barycentrics, point and distance
are evaluated by ordinary torch operations, so their gradients in the points and in the vertices are
exact (envelope theorem for the distance). Reference: C. Ericson, Real-Time Collision Detection,
2005, ch. 5.1.5 (regions of a triangle).
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .backend import choose_backend
from .errors import BackendError, InputError
from .face_tree import LIMIT, FaceTrees
from .norms import safe_norm

_CHUNK = 1 << 22  # (point, face) pairs of one step of the reference


@dataclass(frozen=True)
class SurfaceHit:
    """Closest surface points.

    Attributes:
        face: [N] int64 face index, 0 where nothing was found.
        bary: [N, 3] barycentric coordinates on that face.
        point: [N, 3] closest surface point, same frame and unit as the query.
        distance: [N] distance to it, unsigned; infinite where nothing was found.
        found: [N] False where the surface is farther than ``max_distance``.
    """

    face: Int[Tensor, "n"]
    bary: Float[Tensor, "n 3"]
    point: Float[Tensor, "n 3"]
    distance: Float[Tensor, "n"]
    found: Bool[Tensor, "n"]


def _ratio(numerator: Tensor, denominator: Tensor) -> Tensor:
    """Quotient clamped to [0, 1], 0 where the denominator vanishes, with finite gradients."""
    safe = denominator.abs() > torch.finfo(denominator.dtype).tiny
    ratio = torch.where(safe, numerator, 0.0) / torch.where(safe, denominator, 1.0)
    return ratio.clamp(0.0, 1.0)


def closest_on_triangle(
    points: Float[Tensor, "*n 3"], triangles: Float[Tensor, "*n 3 3"]
) -> Float[Tensor, "*n 3"]:
    """Barycentric coordinates of the point of a triangle nearest to a point.

    Degenerate triangles (a segment or a point) are handled: the nearest of the three edges wins.

    Args:
        points: query points.
        triangles: corner positions, the corner index second to last.

    Returns:
        Barycentrics that sum to 1, each in [0, 1]; differentiable in points and triangles.

    >>> triangle = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    >>> closest_on_triangle(torch.tensor([[0.25, 0.25, 1.0]]), triangle)
    tensor([[0.5000, 0.2500, 0.2500]])
    """
    a, b, c = triangles.unbind(-2)
    ab, ac, ap = b - a, c - a, points - a
    bc, bp = c - b, points - b
    # An orthogonal basis of the plane: determinants of a needle would cancel to nothing.
    d00, d11 = (ab * ab).sum(-1), (ac * ac).sum(-1)
    long = d00 > torch.finfo(d00.dtype).tiny
    over = torch.where(long, 1.0, 0.0) / torch.where(long, d00, 1.0)
    lean, along = (ab * ac).sum(-1) * over, (ab * ap).sum(-1) * over
    height = ac - lean[..., None] * ab
    square = (height * height).sum(-1)
    flat = ~(square > (8 * torch.finfo(d11.dtype).eps) ** 2 * d11) | ~long
    across = (height * (ap - along[..., None] * ab)).sum(-1)
    w = across / torch.where(flat, torch.ones_like(square), square)
    v = along - w * lean
    inside = (v >= 0) & (w >= 0) & (v + w <= 1) & ~flat
    face_bary = torch.stack([1 - v - w, v, w], -1)
    # Nearest point of each edge.
    s_ab, s_ac = _ratio((ab * ap).sum(-1), d00), _ratio((ac * ap).sum(-1), d11)
    s_bc = _ratio((bp * bc).sum(-1), (bc * bc).sum(-1))
    zero = torch.zeros_like(v)
    edges = torch.stack(
        [
            torch.stack([1 - s_ab, s_ab, zero], -1),
            torch.stack([1 - s_ac, zero, s_ac], -1),
            torch.stack([zero, 1 - s_bc, s_bc], -1),
        ],
        -2,
    )  # *n edge 3
    gaps = (points[..., None, :] - edges @ triangles).square().sum(-1)
    best = gaps.argmin(-1)[..., None, None].expand(*gaps.shape[:-1], 1, 3)
    edge_bary = edges.gather(-2, best).squeeze(-2)
    return torch.where(inside[..., None], face_bary, edge_bary)


def _check_faces(verts: Tensor, faces: Tensor) -> None:
    if faces.shape[0] == 0:
        raise InputError("faces: expected at least one triangle, found 0; pass a mesh with faces")
    if int(faces.min()) < 0 or int(faces.max()) >= verts.shape[0]:
        raise InputError(
            f"faces: expected indices in 0..{verts.shape[0] - 1}, found {int(faces.min())}.."
            f"{int(faces.max())}; use the faces that belong to these vertices"
        )


def _check_like(points: Tensor, verts: Tensor) -> None:
    if points.dtype != verts.dtype or points.device != verts.device:
        raise InputError(
            f"points: expected dtype and device of verts ({verts.dtype}, {verts.device}), found "
            f"{points.dtype}, {points.device}; convert one of them"
        )


def _hit(points: Tensor, verts: Tensor, faces: Tensor, face: Tensor, limit: float) -> SurfaceHit:
    """Evaluate barycentrics, point and distance on known faces (-1: none), differentiably."""
    found = (face >= 0) & points.isfinite().all(-1)
    face = face.clamp(min=0).long()
    triangles = verts[faces[face]]
    # a point that is not finite would turn the gradients of all vertices into NaN
    points = torch.where(found[:, None], points, triangles.detach()[:, 0])
    bary = closest_on_triangle(points, triangles)
    point = (bary[..., None] * triangles).sum(-2)
    distance = safe_norm(points - point)
    found = found & (distance <= limit)
    distance = torch.where(found, distance, math.inf)
    return SurfaceHit(face * found, bary, point, distance, found)


def _search_torch(points: Tensor, verts: Tensor, faces: Tensor) -> Tensor:
    """Brute force over all faces: the reference."""
    triangles = verts[faces]
    step = max(1, _CHUNK // max(1, faces.shape[0]))
    best = []
    for chunk in points.split(step):
        pairs = chunk[:, None].expand(-1, faces.shape[0], -1)
        tris = triangles.expand(chunk.shape[0], -1, -1, -1)
        point = (closest_on_triangle(pairs, tris)[..., None] * tris).sum(-2)
        best.append((chunk[:, None] - point).square().sum(-1).argmin(1))
    return torch.cat(best) if best else torch.zeros(0, dtype=torch.long, device=points.device)


def _reach(max_distance: float) -> float:
    """Radius of the search: the exact limit is applied to the evaluated distance."""
    return min(max_distance * (1 + 1e-5) + 1e-7, LIMIT)


class SurfaceIndex:
    """A search structure over one triangle mesh, refit when only the vertices move.

    >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> index = SurfaceIndex(verts, torch.tensor([[0, 1, 2]]))
    >>> index.query(torch.tensor([[0.25, 0.25, 2.0]])).distance
    tensor([2.])
    """

    def __init__(
        self, verts: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], backend: str = "auto"
    ) -> None:
        """Build the structure.

        Args:
            verts: vertices, metres.
            faces: vertex indices.
            backend: "warp" (a tree of 8-wide nodes), "torch" (brute force) or "auto" (warp where it
                is installed). The warp search runs in float32; barycentrics, points and distances
                are evaluated in the dtype of the input.

        Raises:
            InputError: faces are empty or out of range, or the backend is unknown.
            BackendError: Warp was asked for by name and is not installed.
        """
        # of a float32 tensor: whatever the vertices are, the search converts them
        self.backend = choose_backend(backend, verts.detach().float())
        _check_faces(verts, faces)
        self.faces = faces.long()
        self.verts = verts
        self._tree: FaceTrees | None = None
        if self.backend == "warp":
            self._tree = FaceTrees(verts.detach().float()[None], self.faces)

    @property
    def tree(self) -> FaceTrees:
        """The search tree of the warp back end.

        Raises:
            BackendError: the back end is torch.
        """
        if self._tree is None:
            raise BackendError("SurfaceIndex.tree: expected backend 'warp', found 'torch'")
        return self._tree

    def refit(self, verts: Float[Tensor, "v 3"]) -> None:
        """Move the vertices and keep the topology; far cheaper than building anew.

        Args:
            verts: new vertices, metres; the same count, dtype and device as before.

        Raises:
            InputError: another number of vertices.
        """
        if verts.shape != self.verts.shape:
            raise InputError(
                f"verts: expected {tuple(self.verts.shape)} as built, found {tuple(verts.shape)}; "
                "build a new SurfaceIndex for another mesh"
            )
        self.verts = verts
        if self._tree is not None:
            self._tree.refit(verts.detach().float()[None])

    def query(self, points: Float[Tensor, "n 3"], max_distance: float = math.inf) -> SurfaceHit:
        """Closest surface point of each query point.

        Args:
            points: query points in the frame of the vertices, metres.
            max_distance: farther surfaces are not found; a small value makes the search faster.

        Returns:
            The hits, differentiable in the points and in the vertices.

        Raises:
            InputError: dtype or device differ from the vertices'.
        """
        _check_like(points, self.verts)
        if self._tree is None:
            with torch.no_grad():
                face = _search_torch(points, self.verts, self.faces)
            return _hit(points, self.verts, self.faces, face, max_distance)
        wanted = torch.is_grad_enabled() and (points.requires_grad or self.verts.requires_grad)
        if wanted or points.dtype != torch.float32:
            face = self._faces_of(self._tree, points, max_distance)
            return _hit(points, self.verts, self.faces, face, max_distance)
        return self._hits_of(self._tree, points, max_distance)

    def _faces_of(self, tree: FaceTrees, points: Tensor, max_distance: float) -> Tensor:
        """Closest faces (-1: none), for an evaluation in torch."""
        from .kernels.face_tree import closest_faces
        from .kernels.launch import launch, view

        queries = points.detach().float().contiguous()
        face = torch.empty(len(queries), dtype=torch.int32, device=points.device)
        args = [view(queries, 3), *tree.args(), _reach(max_distance), view(face)]
        launch(closest_faces, len(queries), args, queries)
        return face

    def _hits_of(self, tree: FaceTrees, points: Tensor, max_distance: float) -> SurfaceHit:
        """Search and evaluation in one kernel, without gradients."""
        from .kernels.face_tree import closest_hits
        from .kernels.launch import launch, view

        count, device = len(points), points.device
        queries, verts = points.detach().contiguous(), self.verts.detach().contiguous()
        face = torch.empty(count, dtype=torch.int64, device=device)
        bary, point = torch.empty(2, count, 3, device=device).unbind(0)
        distance = torch.empty(count, device=device)
        found = torch.empty(count, dtype=torch.bool, device=device)
        args = [view(queries, 3), view(verts, 3), view(tree.corners), *tree.args()]
        args += [_reach(max_distance), min(max_distance, LIMIT), view(face), view(bary, 3)]
        args += [view(point, 3)]
        launch(closest_hits, count, [*args, view(distance), view(found)], queries)
        return SurfaceHit(face, bary, point, distance, found)


def closest_point(
    points: Float[Tensor, "n 3"],
    verts: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    max_distance: float = math.inf,
    backend: str = "auto",
) -> SurfaceHit:
    """Closest surface point of each query point; to ask more than once, use `SurfaceIndex`.

    Args:
        points: query points, metres.
        verts: vertices in the same frame.
        faces: vertex indices.
        max_distance: farther surfaces are not found.
        backend: "auto", "warp" or "torch".

    Returns:
        The hits, differentiable in points and verts.

    Raises:
        InputError: empty or out-of-range faces, mixed dtypes or devices, unknown backend.

    >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> closest_point(torch.tensor([[0.0, 0.0, 3.0]]), verts, torch.tensor([[0, 1, 2]])).distance
    tensor([3.])
    """
    return SurfaceIndex(verts, faces, backend).query(points, max_distance)


def vertex_normals(
    verts: Float[Tensor, "*b v 3"], faces: Int[Tensor, "f 3"]
) -> Float[Tensor, "*b v 3"]:
    """Area-weighted unit normals of the vertices; zero for a vertex without area.

    Args:
        verts: vertices, metres.
        faces: counter-clockwise seen from outside.

    Returns:
        Unit normals that point outside; differentiable in verts.

    >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> vertex_normals(verts, torch.tensor([[0, 1, 2]]))[0]
    tensor([0., 0., 1.])
    """
    corners = verts[..., faces, :]
    cross = torch.linalg.cross(
        corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :], dim=-1
    )
    total = torch.zeros_like(verts)
    for corner in range(3):
        total = total.index_add(-2, faces[:, corner], cross)
    length = safe_norm(total)[..., None]
    # what is left of faces without area, or of faces that cancel, is rounding: it has no direction
    with torch.no_grad():
        sides = corners[..., 1:, :] - corners[..., :1, :]
        bound = sides.norm(dim=-1).prod(-1)[..., None]
        noise = torch.zeros_like(total[..., :1])
        for corner in range(3):
            noise = noise.index_add(-2, faces[:, corner], bound)
        sound = length > 4 * torch.finfo(total.dtype).eps * noise
    return torch.where(sound, total / torch.where(sound, length, 1.0), 0.0)


def signed_distance(
    points: Float[Tensor, "n 3"],
    hit: SurfaceHit,
    normals: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
) -> Float[Tensor, "n"]:
    """Distance with a sign: negative behind the interpolated vertex normal of the hit.

    Args:
        points: query points.
        hit: their closest surface points.
        normals: unit vertex normals.
        faces: vertex indices of the mesh of the hit.

    Returns:
        Signed distance, metres; +inf where nothing was found.
    """
    normal = (hit.bary[..., None] * normals[faces[hit.face]]).sum(-2)
    side = ((points - hit.point) * normal).sum(-1)
    return torch.where((side < 0) & hit.found, -hit.distance, hit.distance)
