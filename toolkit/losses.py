"""The terms of the objective; a term of weight 0 is never computed (MonoPartNeRF, section 3.5)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from monopart.fields.residual import ResidualField
from monopart.geometry.norms import safe_norm
from monopart.geometry.parts import rows_of_parts
from monopart.geometry.posed_parts import PosedParts

from .model import AvatarModel, FrameInput, Rendered

SMOOTH = 1e-6  # square metres added under the root of a length


def color_loss(color: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Mean squared colour error over rays; exactly 0 of none."""
    return (color - target).square().sum() / max(color.numel(), 1)


def absolute_loss(color: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Mean absolute colour error over rays; exactly 0 of none."""
    return (color - target).abs().sum() / max(color.numel(), 1)


def offset_loss(residual: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Mean length of the residuals, metres, smooth at zero; exactly 0 of none."""
    return smooth_norm(residual).sum() / max(len(residual), 1)


def elastic_loss(
    residual: Float[Tensor, "n 3"], neighbour: Float[Tensor, "n 3"]
) -> Float[Tensor, ""]:
    """Mean length of the difference of residuals at neighbouring places; exactly 0 of none.

    Args:
        residual: residuals, metres.
        neighbour: residuals beside them, at the same time.
    """
    return smooth_norm(residual - neighbour).sum() / max(len(residual), 1)


def smooth_norm(vectors: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Lengths sqrt(|r|^2 + 1e-6), whose gradient vanishes at zero in place of exploding."""
    return (vectors.square().sum(-1) + SMOOTH).sqrt()


def distortion_loss(
    weights: Float[Tensor, "m"],
    depth: Float[Tensor, "m"],
    ray_start: Int[Tensor, "r1"],
    step: float,
) -> Float[Tensor, ""]:
    """Spread of the weights along their rays, metres, averaged over rays; exactly 0 of none.

    The double sum over the samples of a ray takes one pass: with samples in order,
    sum_ij w_i w_j |s_i - s_j| = 2 sum_i w_i (s_i sum_{j<i} w_j - sum_{j<i} w_j s_j).

    Args:
        weights: w = T α of each sample.
        depth: place s of each sample along its ray, metres, ascending in a ray.
        ray_start: the samples of ray r are the rows ray_start[r] … ray_start[r + 1] − 1.
        step: length of a sample, metres.

    Reference: Barron et al., Mip-NeRF 360, 2022, eq. (15).
    """
    rays, start = len(ray_start) - 1, ray_start.long()
    ray = torch.repeat_interleave(
        torch.arange(rays, device=weights.device), start.diff(), output_size=len(weights)
    )
    wide = weights.double()  # sums over a whole batch, of which a ray's share is a difference
    place = depth.detach().double()
    in_front = _sums_in_front(torch.stack([wide, wide * place], -1), start[ray])
    pairs = 2.0 * (wide * (place * in_front[:, 0] - in_front[:, 1])).sum()
    own = wide.square().sum() * step / 3.0
    return ((pairs + own) / max(rays, 1)).to(weights.dtype)


def _sums_in_front(values: Tensor, first: Tensor) -> Tensor:
    """Sums of the rows from the first of the ray up to each row, which is left out."""
    before = values.cumsum(0) - values
    return before - before[first]


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
        place = model.residual_place(points, hit.uv, part, frames.time[owner])
        posed_point = posed_point + forward(place, part, counts)
    gap = safe_norm(out.samples.points[sample] - posed_point)
    return torch.where(hit.found, gap, 0.0)
