"""From texture coordinates back to the surface, from mesh to mesh, and textures on it."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .errors import InputError
from .surface import SurfaceIndex
from .uv import UVMap

_CHUNK = 125_000
_INWARDS = 1e-3
"""Share of the way from a corner to the middle of its face."""


@dataclass(frozen=True, eq=False)
class UVHit:
    """Where points of the texture lie on the surface; what `UVMap.at` asks for."""

    face: Int[Tensor, "n"]
    """Face index; −1 between the charts."""
    bary: Float[Tensor, "n 3"]
    """Barycentric coordinates; differentiable in (u, v) and in the map."""
    found: Bool[Tensor, "n"]
    """Whether the point lies in a chart."""

    def point(self, verts: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "n 3"]:
        """Points on a mesh, metres; zero where nothing was found; differentiable."""
        corners = verts[faces[self.face.clamp(min=0)]]
        return torch.where(self.found[:, None], (self.bary[..., None] * corners).sum(-2), 0.0)


class UVIndex:
    """Faces of a layout in a grid over the unit square, to find the face of a point of it."""

    def __init__(self, uv: UVMap, cells: int | None = None) -> None:
        """Sort the faces into cells.

        Args:
            uv: the map, without overlaps (of faces that overlap the lowest index is found).
            cells: cells along a side; None: about one a face.

        Raises:
            InputError: coordinates that are not finite, a grid without cells.
        """
        self.corner_uv = uv.corner_uv
        corner = uv.corner_uv.detach().double()
        if not corner.isfinite().all():
            raise InputError(
                "uv: expected finite coordinates, found NaN or infinity; unwrap the mesh anew"
            )
        if cells is not None and cells < 1:
            raise InputError(f"cells: expected at least one, found {cells}")
        count = len(corner)
        self.cells = cells or max(1, min(2048, int(count**0.5)))
        low = (corner.amin(1) * self.cells - 1e-6).floor().long().clamp(0, self.cells - 1)
        high = (corner.amax(1) * self.cells + 1e-6).floor().long().clamp(0, self.cells - 1)
        wide = high - low + 1
        number = wide.prod(1)
        face = torch.repeat_interleave(torch.arange(count, device=corner.device), number)
        start = number.cumsum(0) - number
        rank = torch.arange(len(face), device=corner.device) - start[face]
        column = low[face, 0] + rank % wide[face, 0]
        row = low[face, 1] + rank // wide[face, 0]
        cell = row * self.cells + column
        order = cell.argsort(stable=True)
        self._face = face[order]
        bins = torch.arange(self.cells**2 + 1, device=cell.device)
        self._start = torch.searchsorted(cell[order], bins)

    def locate(self, points: Float[Tensor, "n 2"], slack: float = 1e-9) -> UVHit:
        """Faces and barycentric coordinates of points of the texture.

        Args:
            points: (u, v); outside of the unit square, and NaN, nothing is found.
            slack: how far outside of a face, in barycentric coordinates, still counts as in it.

        Returns:
            The hits; barycentric coordinates are differentiable in the points and in the map.

        >>> face = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]])
        >>> UVIndex(UVMap(face)).locate(torch.tensor([[0.25, 0.5], [0.9, 0.9]])).face.tolist()
        [0, -1]
        """
        if len(self.corner_uv) == 0:
            none = torch.full((len(points),), -1, dtype=torch.int64, device=points.device)
            return UVHit(none, points.new_zeros(len(points), 3), none >= 0)
        with torch.no_grad():
            face = torch.cat([self._search(p, slack) for p in points.detach().split(_CHUNK)])
        corner = self.corner_uv[face.clamp(min=0)].to(points.dtype)
        found = face >= 0
        safe = torch.where(found[:, None], points, corner[:, 0].detach())
        bary = torch.where(found[:, None], _bary(safe, corner), 0.0)
        return UVHit(face, bary, found)

    def _search(self, points: Tensor, slack: float) -> Tensor:
        inside = ((points >= 0) & (points <= 1)).all(-1)
        place = (points.double().nan_to_num() * self.cells).floor().long().clamp(0, self.cells - 1)
        cell = place[:, 1] * self.cells + place[:, 0]
        first, number = self._start[cell], self._start[cell + 1] - self._start[cell]
        number = torch.where(inside, number, 0)
        owner = torch.repeat_interleave(torch.arange(len(points), device=points.device), number)
        rank = torch.arange(len(owner), device=points.device)
        rank = rank - (number.cumsum(0) - number)[owner]
        face = self._face[first[owner] + rank]
        corner = self.corner_uv.detach()[face].double()
        good = _bary(points[owner].double(), corner).amin(-1) >= -slack
        count = len(self.corner_uv)
        out = torch.full((len(points),), count, dtype=torch.int64, device=points.device)
        out.scatter_reduce_(0, owner[good], face[good], "amin")
        return torch.where(out == count, -1, out)


def _bary(points: Tensor, corner: Tensor) -> Tensor:
    """Barycentric coordinates in the plane; zero for a triangle without area."""
    a, b, c = corner.unbind(-2)
    side1, side2, to = b - a, c - a, points - a
    det = side1[..., 0] * side2[..., 1] - side1[..., 1] * side2[..., 0]
    flat = det == 0
    det = torch.where(flat, 1.0, det)
    v = (to[..., 0] * side2[..., 1] - to[..., 1] * side2[..., 0]) / det
    w = (side1[..., 0] * to[..., 1] - side1[..., 1] * to[..., 0]) / det
    out = torch.stack([1 - v - w, v, w], -1)
    return torch.where(flat[..., None], -1.0, out)


def transfer_uv(
    verts: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    uv: UVMap,
    new_verts: Float[Tensor, "W 3"],
    new_faces: Int[Tensor, "G 3"],
) -> UVMap:
    """The map of one mesh brought to another mesh of the same surface.

    Each new face asks at points just inside its corners, in the chart of the surface next to its
    middle. Where the corners still come from both sides of a seam (of a chart that meets itself)
    the plane of the face next to the middle goes on to them: no face is stretched over a seam.

    Args:
        verts: vertices of the mesh that has the map, metres.
        faces: its faces.
        uv: the map.
        new_verts: vertices of the other mesh, in the same pose and shape.
        new_faces: its faces.

    Returns:
        Coordinates per corner of the new faces, in the dtype of the map. Faces that lie across a
        seam reach beyond the border of their chart, into its margin.

    Raises:
        InputError: a mesh without faces, maps and faces of different number.

    >>> verts, faces = torch.eye(3), torch.tensor([[0, 1, 2]])
    >>> uv = UVMap(torch.tensor([[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]]))
    >>> turned = transfer_uv(verts, faces, uv, verts, faces.roll(1, 1)).corner_uv
    >>> (turned - uv.corner_uv.roll(1, 1)).abs().max().item() < 1e-6
    True
    """
    from .uv_measure import seams_of_layout
    from .uv_mesh import MeshEdges, components

    if len(faces) == 0:
        raise InputError("faces: expected a mesh with faces to take the map from, found none")
    if len(uv.corner_uv) != len(faces):
        raise InputError(
            f"uv: expected coordinates of {len(faces)} faces, found {len(uv.corner_uv)}"
        )
    edges = MeshEdges.of(faces.cpu().numpy())
    open_edges = seams_of_layout(edges, uv.corner_uv.detach().double().cpu().numpy())
    pairs = edges.face_pairs[~open_edges]
    chart = torch.from_numpy(components(len(faces), pairs[:, 0], pairs[:, 1])).to(faces.device)
    corners = new_verts[new_faces]
    middle = corners.mean(1)
    near = SurfaceIndex(verts, faces).query(middle)
    own, side = chart[near.face], near.face[:, None].expand(-1, 3)
    out = uv.at_faces(side, _beyond(verts, faces, side, corners).to(uv.corner_uv))
    for number in own.unique().tolist():
        some = torch.nonzero(chart == number)[:, 0]
        mine = torch.nonzero(own == number)[:, 0]
        inner = corners[mine] + _INWARDS * (middle[mine, None] - corners[mine])
        hit = SurfaceIndex(verts, faces[some]).query(inner.reshape(-1, 3))
        face = some[hit.face].reshape(-1, 3)
        found = uv.at_faces(face, _beyond(verts, faces, face, corners[mine]).to(uv.corner_uv))
        size = (out[mine].roll(1, 1) - out[mine]).norm(dim=-1).amax(1)
        torn = (found - out[mine]).norm(dim=-1).amax(1) > size
        out = out.index_copy(0, mine, torch.where(torn[:, None, None], out[mine], found))
    return UVMap(out)


def _beyond(verts: Tensor, faces: Tensor, face: Tensor, points: Tensor) -> Tensor:
    """Barycentric coordinates of points in the planes of faces; outside of them, too."""
    a, b, c = verts[faces[face]].double().unbind(-2)
    side1, side2, to = b - a, c - a, points.double() - a
    d11, d12, d22 = (side1**2).sum(-1), (side1 * side2).sum(-1), (side2**2).sum(-1)
    e1, e2 = (to * side1).sum(-1), (to * side2).sum(-1)
    det = d11 * d22 - d12 * d12
    # a face without area has no plane: its first corner stands for it
    flat = det <= 1e-12 * d11 * d22
    det = torch.where(flat, torch.inf, det)
    v, w = (d22 * e1 - d12 * e2) / det, (d11 * e2 - d12 * e1) / det
    return torch.stack([1 - v - w, v, w], -1)
