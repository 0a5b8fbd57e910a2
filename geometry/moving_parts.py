"""The parts of bodies whose poses are being learned: canonical points with gradients in the pose.

Which face of a part is closest is held; the place on that face, and the skinning weights there,
follow the vertices. So the gradient is exact wherever the closest face does not change.
"""

import copy

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .body import BodyModel, PosedBody
from .culling import BodyShell, ShellSamples
from .errors import InputError
from .posed_parts import PartHit, PartPairs, PosedParts, RestPoints, full_bary
from .rigid import append_last_row, apply_linear, transform_points
from .skinning import blend_transforms, unskin

_EDGE = 1e-6  # a barycentric below this is zero: the closest point lies on an edge or a corner
_NEEDLE = 1e-6  # squared sine of a corner below which barycentrics are held


def closest_bary(
    points: Float[Tensor, "m 3"], corners: Float[Tensor, "m 3 3"], bary: Float[Tensor, "m 3"]
) -> Float[Tensor, "m 3"]:
    """Barycentrics of the closest points of triangles again, as functions of points and corners.

    Args:
        points: queries, metres.
        corners: the three corners of each query's triangle, metres.
        bary: barycentrics of the closest points, zeros on edges and corners.

    Returns:
        The same barycentrics; differentiable in points and corners, with the edge or corner on
        which a point lies held. Constant in corners and on needles.

    >>> triangle = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    >>> closest_bary(torch.tensor([[0.25, 0.5, 1.0]]), triangle, torch.full((1, 3), 1 / 3)).tolist()
    [[0.25, 0.25, 0.5]]
    """
    zeros = bary <= _EDGE
    # turned so that corner 0 is the one that an edge lies opposite to
    turn = zeros.int().argmax(-1)
    order = (turn[:, None] + torch.arange(3, device=bary.device)) % 3
    a, b, c = corners.gather(1, order[..., None].expand(-1, -1, 3)).unbind(1)
    ab, ac, bc = b - a, c - a, c - b
    ab2, ac2 = (ab * ab).sum(-1), (ac * ac).sum(-1)
    dot = (ab * ac).sum(-1)
    area = ab2 * ac2 - dot * dot
    good = area > _NEEDLE * ab2 * ac2
    to_b, to_c = (ab * (points - a)).sum(-1), (ac * (points - a)).sum(-1)
    area = torch.where(good, area, 1.0)
    v, w = (ac2 * to_b - dot * to_c) / area, (ab2 * to_c - dot * to_b) / area
    inside = torch.stack([1.0 - v - w, v, w], -1)
    length = (bc * bc).sum(-1)
    t = (bc * (points - b)).sum(-1) / torch.where(length > 0, length, 1.0)
    edge = torch.stack([torch.zeros_like(t), 1.0 - t, t], -1)
    count = zeros.sum(-1)
    free = (count == 0) & good | (count == 1) & (length > 0)
    moved = torch.where((count == 0)[:, None], inside, edge)
    back = (torch.arange(3, device=bary.device) - turn[:, None]) % 3
    return torch.where(free[:, None], moved.gather(1, back), bary)


class MovingParts(PosedParts):
    """:class:`PosedParts` of bodies that carry gradients; the pairs are found as before.

    Attributes:
        live: [B V, 3] vertices of all bodies with their gradients, metres.
        turn: [B, 3, 3] and
        shift: [B, 3] what a change of the placement does to the local coordinates of a point that
            stands still in the world: identity and zero, with gradients.
    """

    live: Float[Tensor, "n 3"]
    turn: Float[Tensor, "b 3 3"]
    shift: Float[Tensor, "b 3"]

    @classmethod
    def like(
        cls, parts: PosedParts, body: BodyModel, posed: PosedBody, shell: BodyShell
    ) -> "MovingParts":
        """The parts of other poses of the same body, without the work that poses do not change.

        Args:
            parts: structures of as many bodies as `posed` has; their trees are refit and so no
                longer fit `parts`.
            body: the body model.
            posed: the bodies, batched; vertices, transforms and placement may carry gradients.
            shell: a shell that holds these bodies.

        Returns:
            The parts; :meth:`follow` is differentiable in what made `posed`.

        Raises:
            InputError: `parts` or the shell are of another number of bodies.
        """
        count = len(posed.verts)
        if not count == len(parts.verts) == len(shell.lo):
            raise InputError(
                f"posed: expected as many bodies as parts and shell have, found {count}, "
                f"{len(parts.verts)} and {len(shell.lo)}; build them for the same frames"
            )
        moving = cls.__new__(cls)
        moving.__dict__.update(parts.__dict__)
        moving.live = posed.verts.reshape(-1, 3)
        moving.verts = posed.verts.detach().float().contiguous()
        maps = blend_transforms(posed.transforms, body.weights.to(posed.transforms))
        moving.posed_maps = maps[..., :3, :].reshape(-1, 3, 4)
        rotation, translation = posed.rotation, posed.translation
        moving.rotation = rotation.detach().to(moving.verts)
        moving.translation = translation.detach().to(moving.verts)
        moving.turn = rotation.mT @ rotation.detach()
        moved = (translation.detach() - translation)[..., None]
        moving.shift = (rotation.mT @ moved).squeeze(-1)
        moving.shell = shell
        moving.trees.refit(moving.verts)
        return moving

    def _still(self) -> PosedParts:
        """These bodies as constants."""
        still = copy.copy(self)
        still.posed_maps = self.posed_maps.detach().contiguous()
        return still

    def unskin(self, samples: ShellSamples, pairs: PartPairs) -> RestPoints:
        """As in :class:`PosedParts`, without gradients: :meth:`follow` gives them to some pairs."""
        return PosedParts.unskin(self._still(), samples, pairs)

    def reskin(
        self,
        points: Float[Tensor, "m 3"],
        body: Int[Tensor, "m"],
        hit: PartHit,
        canonical: PosedParts,
    ) -> Float[Tensor, "m 3"]:
        """As in :class:`PosedParts`: differentiable in points, the poses are constants."""
        return PosedParts.reskin(self._still(), points, body, hit, canonical)

    def follow(self, samples: ShellSamples, pairs: PartPairs) -> RestPoints:
        """Canonical points and UVs of pairs, with gradients in poses and placements.

        Args:
            samples: the samples that the pairs index; they stand still in the world.
            pairs: from :meth:`pairs`, or some of them.

        Returns:
            What :meth:`unskin` gives, up to rounding.
        """
        owner = samples.body[pairs.sample].long()
        # index_select: the gradient of [] adds up in an order that changes with two threads
        turn, shift = self.turn.index_select(0, owner), self.shift.index_select(0, owner)
        points = apply_linear(turn, samples.points[pairs.sample].to(turn)) + shift
        face = self.faces[pairs.face]
        rows = (face + owner[:, None] * self.verts.shape[1]).reshape(-1)
        held = full_bary(pairs.bary)
        corners = self.live.index_select(0, rows).unflatten(0, (-1, 3))
        bary = closest_bary(points, corners, held.to(points))
        away = _mixed(self.posed_maps, rows, bary)
        there = _mixed(self.canonical_maps.to(points), face.reshape(-1), bary)
        local, valid = unskin(points, away)
        uv = (bary[..., None] * self.corner_uv[pairs.face].to(points)).sum(-2)
        return RestPoints(transform_points(there, local), uv, valid)


def _mixed(maps: Tensor, rows: Tensor, bary: Tensor) -> Tensor:
    """Maps of three vertices each, mixed: [M, 4, 4]."""
    three = maps.index_select(0, rows).unflatten(0, (-1, 3))
    return append_last_row((three * bary[..., None, None]).sum(1))
