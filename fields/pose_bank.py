"""Pose features of canonical points: blended line banks of key poses (MonoPartNeRF, eq. 5)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from monopart.geometry.errors import InputError

_INIT = 0.1


class PoseBank(torch.nn.Module):
    """Learnable lines of features, one per part, key pose and canonical axis.

    A point is looked up on the three lines of its part, linearly between the knots, and the lines
    are those of the pose of its body: a weighted mean of the lines of some key poses. Key poses
    start equal, so that a blend of them starts as each of them.

    Attributes:
        lines: [K, Q, 3, R, C] features of K parts, Q key poses, 3 axes and R knots.

    Reference: MonoPartNeRF, section 3.3, P_k.

    >>> bank = PoseBank(torch.zeros(2, 3), torch.ones(2, 3), poses=4, knots=8, channels=5)
    >>> rows, weights = torch.tensor([[[0, 3], [1, 2]]]), torch.full((1, 2, 2), 0.5)
    >>> bank(torch.rand(6, 3), torch.tensor([0, 0, 1, 1, 1, 1]), None, rows, weights).shape
    torch.Size([6, 15])
    """

    lo: Tensor
    extent: Tensor

    def __init__(
        self,
        lo: Float[Tensor, "k 3"],
        hi: Float[Tensor, "k 3"],
        poses: int,
        knots: int = 128,
        channels: int = 20,
        generator: torch.Generator | None = None,
    ) -> None:
        """Make the lines.

        Args:
            lo: lower corners of the parts' canonical boxes, metres.
            hi: upper corners, beyond the lower ones.
            poses: number of key poses.
            knots: values along an axis.
            channels: features of a line.
            generator: source of the initial values; the global one if None.

        Raises:
            InputError: no key pose, fewer than two knots, no channel or a box without extent.
        """
        super().__init__()
        if poses < 1 or knots < 2 or channels < 1:
            raise InputError(
                f"PoseBank: expected poses ≥ 1, knots ≥ 2 and channels ≥ 1, found {poses}, {knots} "
                f"and {channels}"
            )
        if not bool((hi > lo).all()):
            raise InputError("PoseBank lo, hi: expected hi > lo on every axis; check the boxes")
        self.register_buffer("lo", lo.clone(), persistent=False)
        self.register_buffer("extent", hi - lo, persistent=False)
        start = _INIT * torch.randn(len(lo), 1, 3, knots, channels, generator=generator)
        self.lines = torch.nn.Parameter(start.to(lo.dtype).repeat(1, poses, 1, 1, 1))

    @property
    def out_features(self) -> int:
        """Columns of the result, 3·C."""
        return 3 * self.lines.shape[-1]

    def extra_repr(self) -> str:
        """Sizes for ``print(module)``."""
        parts, poses, _, knots, channels = self.lines.shape
        return f"{parts=}, {poses=}, {knots=}, {channels=}"

    def blend(
        self, rows: Int[Tensor, "b k n"], weights: Float[Tensor, "b k n"]
    ) -> Float[Tensor, "k b 3 r c"]:
        """Lines of bodies: weighted means of those of key poses.

        Args:
            rows: key poses of each body and part.
            weights: their weights.

        Returns:
            One line per part, body and axis; differentiable in the lines and the weights.
        """
        parts, poses = self.lines.shape[:2]
        mix = weights.new_zeros(parts, len(rows), poses)
        mix = mix.scatter_add(2, rows.transpose(0, 1).long(), weights.transpose(0, 1))
        return (mix @ self.lines.flatten(2)).unflatten(2, self.lines.shape[2:])

    def forward(
        self,
        points: Float[Tensor, "n 3"],
        part: Int[Tensor, "n"],
        body: Int[Tensor, "n"] | None,
        rows: Int[Tensor, "b k m"],
        weights: Float[Tensor, "b k m"],
    ) -> Float[Tensor, "n f"]:
        """Pose features of canonical points.

        Args:
            points: canonical points, metres; outside the box of their part the ends of the lines
                go on. Not differentiated.
            part: part of each point.
            body: body of each point; None is body 0.
            rows: key poses of each body and part.
            weights: their weights.

        Returns:
            [N, 3·C] features, x before y before z; differentiable in the lines and the weights.

        Raises:
            InputError: rows and weights that do not fit the parts or each other.
        """
        if rows.shape != weights.shape or rows.shape[1] != len(self.lo):
            raise InputError(
                f"PoseBank rows, weights: expected equal shapes [bodies, {len(self.lo)}, count], "
                f"found {tuple(rows.shape)} and {tuple(weights.shape)}"
            )
        cell, inside = self._cells(points, part)
        lines = self.blend(rows, weights)
        knots, channels = lines.shape[-2:]
        owner = torch.zeros_like(part) if body is None else body
        line = (part.long() * lines.shape[1] + owner.long())[:, None] * 3
        at = (line + torch.arange(3, device=line.device)) * knots + cell
        table = lines.reshape(-1, channels)
        # index_select: the gradient of [] adds up in an order that changes with two threads
        near = table.index_select(0, at.flatten()).view(-1, 3, channels)
        far = table.index_select(0, at.flatten() + 1).view(-1, 3, channels)
        return torch.lerp(near, far, inside[..., None]).flatten(1)

    def _cells(self, points: Tensor, part: Tensor) -> tuple[Tensor, Tensor]:
        """Knot below the coordinate of each axis, [N, 3], and the way to the next in [0, 1]."""
        last = self.lines.shape[3] - 1
        place = ((points.detach() - self.lo[part]) / self.extent[part]).clamp(0, 1) * last
        cell = place.long().clamp(0, last - 1)
        return cell, place - cell
