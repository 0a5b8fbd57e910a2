"""Trees over the faces of moving meshes: 8 children a node, 8 faces a leaf, refit as bodies move.

One topology serves any number of bodies (the frames of a capture), and a mesh may be cut into
groups (the parts of a body) with a tree each. The shape of a tree is fixed by cuts of one posture;
only boxes and corners follow the vertices. Node ``n`` has the children 8n + 1 … 8n + 8.
Reference for the width: I. Wald et al., Getting Rid of Packets, 2008 (one vector per node).
"""

import functools

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from .errors import InputError

LIMIT = 1e9  # metres: the largest distance that is searched


class FaceTrees:
    """Search trees of the face groups of bodies that share their topology.

    Attributes:
        layout: [K, 6] int64, per group: first row and rows per body in `boxes`, the same in
            `tris`, number of the first leaf (-1: no faces) and first entry in `slots`.
        slots: [S] int32 face of each place in a leaf, -1 where there is none.
        boxes: [R, 8] float32, six rows a node: lower x y z and upper x y z of its children.
        tris: [T, 8] float32, 14 rows a leaf: first corner of its faces, unit vectors along the
            first edge and across it, first edge and second corner in these, inverse squared
            lengths of the other edges.
        corners: [F, 3] int32 vertex indices of the faces, for kernels.

    >>> verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> tree = FaceTrees(verts[None], torch.tensor([[0, 1, 2]]))
    >>> tree.slots.tolist()
    [0, -1, -1, -1, -1, -1, -1, -1]
    """

    def __init__(
        self,
        verts: Float[Tensor, "b v 3"],
        faces: Int[Tensor, "f 3"],
        group: Int[Tensor, "f"] | None = None,
        num_groups: int = 1,
        layout_verts: Float[Tensor, "v 3"] | None = None,
    ) -> None:
        """Split the faces and fit the boxes.

        Args:
            verts: vertices of each body, metres.
            faces: vertex indices.
            group: group of each face; None is one group.
            num_groups: number of groups; one without faces is never hit.
            layout_verts: posture by which faces are split; None is that of the first body.

        Raises:
            InputError: no body.
        """
        if len(verts) == 0:
            raise InputError("verts: expected at least one body, found none; pass a pose")
        self.device, self.bodies = verts.device, len(verts)
        posture = verts[0] if layout_verts is None else layout_verts
        centres = posture.detach()[faces].double().mean(1).cpu().numpy()
        owner = np.zeros(len(faces), int) if group is None else group.cpu().numpy()
        rows = [np.flatnonzero(owner == k) for k in range(num_groups)]
        trees = [_split(centres, r) for r in rows]
        self.leaves = [len(t) for t in trees]
        self.corners = faces.int().contiguous()
        self._lay_out(trees)
        self.refit(verts)

    def _lay_out(self, trees: list[np.ndarray]) -> None:
        from .kernels.face_tree import BOX_ROWS, FACE_ROWS, FAR, LANES

        layout, box, tri, slot = [], 0, 0, 0
        self.levels = [_levels(count) for count in self.leaves]
        for count, levels in zip(self.leaves, self.levels, strict=True):
            first_leaf = sum(LANES**level for level in range(levels)) if count else -1
            inner = BOX_ROWS * max(first_leaf, 0)
            layout.append((box, inner, tri, FACE_ROWS * count, first_leaf, slot))
            box += inner * self.bodies
            tri += FACE_ROWS * count * self.bodies
            slot += LANES * count
        self.layout = torch.tensor(layout, dtype=torch.int64, device=self.device)
        flat = np.concatenate([t.reshape(-1) for t in trees])
        self.slots = torch.from_numpy(flat.astype(np.int32)).to(self.device)
        # a child that is not there: a box that is far from everything and changes no union
        empty = torch.tensor([FAR, -FAR], device=self.device).repeat_interleave(BOX_ROWS // 2)
        nodes = max(box, BOX_ROWS) // BOX_ROWS
        self.boxes = empty.repeat(nodes)[:, None].expand(-1, LANES).contiguous()
        self.tris = torch.zeros(max(tri, 1), LANES, device=self.device)

    def refit(self, verts: Float[Tensor, "b v 3"]) -> None:
        """Follow moved vertices; the shape of the trees stays.

        Args:
            verts: vertices of each body, metres; as many as before.
        """
        from .kernels.face_tree import LANES, refit_leaves, refit_nodes
        from .kernels.launch import launch, view

        verts = verts.detach().float().contiguous()
        shared = [view(self.layout)]
        for group, leaves in enumerate(self.leaves):
            if leaves == 0:
                continue
            args = [view(verts, 3), view(self.corners), view(self.slots), *shared, group, leaves]
            args += [view(self.boxes), view(self.tris)]
            launch(refit_leaves, leaves * self.bodies, args, verts)
            nodes = leaves
            for level in range(self.levels[group] - 1, 0, -1):
                nodes = -(-nodes // LANES)
                first = sum(LANES**n for n in range(level))
                args = [*shared, group, first, nodes, view(self.boxes)]
                launch(refit_nodes, nodes * self.bodies, args, verts)

    @functools.cached_property
    def places(self) -> Int[Tensor, "f"]:
        """Place of each face in `slots`, int32, for one group."""
        rows = torch.nonzero(self.slots >= 0).squeeze(-1)
        places = torch.zeros(len(self.corners), dtype=torch.int32, device=self.device)
        places[self.slots[rows].long()] = rows.int()
        return places

    def args(self) -> list:
        """Launch arguments: layout, boxes, tris, slots."""
        from .kernels.launch import view

        return [view(self.layout), view(self.boxes), view(self.tris), view(self.slots)]


def _levels(leaves: int) -> int:
    """Inner levels above a number of leaves."""
    levels = 0
    while 8**levels < leaves:
        levels += 1
    return levels


def _split(centres: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Leaves [L, 8] of some faces, -1 where the last one is not full, in the order of the tree.

    All pieces of a level are cut at once, each along its longest axis, where a child is full: so
    the leaves are full, and only the last subtree of a level is smaller than its siblings.
    """
    if len(rows) == 0:
        return np.zeros((0, 8), int)
    order, first = rows, np.zeros(1, int)
    capacity = 8 ** (_levels(-(-len(rows) // 8)) + 1)  # faces below one node of the level
    while capacity > 8:
        capacity //= 8
        sizes = np.diff(first, append=len(rows))
        children = -(-sizes // capacity)
        for _ in range(3):  # up to eight children by three halvings
            order = _sort_pieces(centres, order, first, children > 1)
            left = (children + 1) // 2
            cut = children > 1
            starts = np.concatenate([first, (first + left * capacity)[cut]])
            counts = np.concatenate([np.where(cut, left, children), (children - left)[cut]])
            place = starts.argsort(kind="stable")
            first, children = starts[place], counts[place]
    leaf = np.repeat(np.arange(len(first)), np.diff(first, append=len(rows)))
    leaves = np.full((len(first), 8), -1)
    leaves[leaf, np.arange(len(rows)) - first[leaf]] = order
    return leaves


def _sort_pieces(
    centres: np.ndarray, order: np.ndarray, first: np.ndarray, wanted: np.ndarray
) -> np.ndarray:
    """Sort the wanted pieces along their longest axes; the others stay as they are."""
    own = centres[order]
    extent = np.maximum.reduceat(own, first) - np.minimum.reduceat(own, first)
    piece = np.repeat(np.arange(len(first)), np.diff(first, append=len(order)))
    along = own[np.arange(len(order)), extent.argmax(1)[piece]]
    key = np.where(wanted[piece], along, np.arange(len(order)))
    return order[np.lexsort((key, piece))]
