"""The terms of the objective; a term of weight 0 is never computed (MonoPartNeRF, section 3.5)."""

import torch
from jaxtyping import Float
from torch import Tensor

from monopart.fields.residual import ResidualField
from monopart.geometry.norms import safe_norm
from monopart.geometry.parts import rows_of_parts
from monopart.geometry.posed_parts import PosedParts

from .model import AvatarModel, FrameInput, Rendered


def color_loss(color: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Mean squared colour error over rays."""
    return (color - target).square().mean()


def offset_loss(residual: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Mean length of the residuals, metres, smooth at zero."""
    return (residual.square().sum(-1) + 1e-6).sqrt().mean() if len(residual) else residual.sum()


def round_trip_distance(
    model: AvatarModel,
    bodies: PosedParts,
    canonical_parts: PosedParts,
    frames: FrameInput,
    out: Rendered,
    rows: Tensor,
) -> Float[Tensor, "m"]:
    """Distance between samples and their forward-deformed canonical points (eq. 3), metres.

    Skinning weights are looked up again at the canonical point: with the weights of the way back
    the two maps would cancel and the loss would be empty.

    Args:
        model: the avatar, with a forward residual.
        bodies: posed bodies of the batch.
        canonical_parts: the canonical body as the only body.
        frames: times of the bodies.
        out: a rendering of the batch.
        rows: pairs to use, ascending.
    """
    pairs = out.shaded.pairs
    sample, part = pairs.sample[rows], pairs.part[rows]
    owner = out.samples.body[sample].long()
    points = out.shaded.canonical[rows]
    hit = canonical_parts.on_part(points, part)
    posed_point = bodies.reskin(points, owner, hit, canonical_parts)
    forward: ResidualField | None = model.forward_residual
    if forward is not None:
        counts = rows_of_parts(part, model.num_parts)
        uvt = torch.cat([hit.uv, frames.time[owner, None]], -1)
        posed_point = posed_point + forward(uvt, part, counts)
    gap = safe_norm(out.samples.points[sample] - posed_point)
    return torch.where(hit.found, gap, 0.0)
