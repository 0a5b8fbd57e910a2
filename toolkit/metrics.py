"""Image metrics and the protocols under which they are reported (PSNR, SSIM, LPIPS-VGG).

`strict`: target = image × hard mask over black; data range 1; LPIPS fed [-1, 1]; three regions.
`legacy`: what the published tables of this line of work show: the full image only, SSIM with
data range 2 and a uniform 7×7 window, LPIPS fed [0, 1].
`boxed`: its older habit, since NeuralBody: `legacy`, but PSNR over the pixels whose ray meets the
box around the posed body, SSIM and LPIPS over the rectangle around these pixels.

Reference: Wang et al., Image Quality Assessment: From Error Visibility to Structural Similarity
(IEEE TIP 2004), equation 13.
"""

import math
from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from monopart.geometry.errors import InputError

from .lpips import LPIPS, MIN_SIZE, ValueRange, average_maps, upsample_maps

Protocol = Literal["strict", "legacy", "boxed"]
Window = Literal["gaussian", "uniform"]
Scores = dict[str, dict[str, float | None]]
"""Region → metric → value; None where a metric is not defined (no weights, region too small)."""

REGIONS = ("full", "box", "silhouette")
PROTOCOLS: tuple[Protocol, ...] = ("strict", "legacy", "boxed")
SHAPE = "shape"
"""Where scores of silhouette and depth stand among the protocols."""
METRICS = ("psnr", "ssim", "lpips")

_SIGMA = 1.5
_RADIUS = {"gaussian": 5, "uniform": 3}


def psnr(
    pred: Float[Tensor, "*s c"],
    target: Float[Tensor, "*s c"],
    mask: Bool[Tensor, "*s"] | None = None,
) -> float:
    """Peak signal-to-noise ratio for a data range of 1.

    Args:
        pred: Colours in [0, 1].
        target: Colours in [0, 1].
        mask: Pixels that count; None counts all.

    Returns:
        Decibels; infinite where the two are equal.

    Raises:
        InputError: a mask without pixels.

    >>> round(psnr(torch.zeros(4, 4, 3), torch.full((4, 4, 3), 0.1)), 4)
    20.0
    """
    error = (pred.double() - target.double()).square()
    if mask is not None:
        if not bool(mask.any()):
            raise InputError("mask: expected at least one pixel, found none; skip this frame")
        error = error[mask]
    mse = error.mean().item()
    return math.inf if mse == 0 else -10 * math.log10(mse)


def ssim(
    pred: Float[Tensor, "h w c"],
    target: Float[Tensor, "h w c"],
    *,
    data_range: float = 1.0,
    window: Window = "gaussian",
) -> float:
    """Mean structural similarity over the pixels whose window lies inside the image.

    Args:
        pred: Image.
        target: Image.
        data_range: Largest minus smallest possible value.
        window: `gaussian`: 11×11, σ = 1.5 (the paper's); `uniform`: 7×7 with sample covariance
            (scikit-image's default, used by the published tables).

    Returns:
        SSIM, 1 for equal images.

    Raises:
        InputError: an image smaller than the window.

    >>> ssim(torch.zeros(16, 16, 3), torch.zeros(16, 16, 3))
    1.0
    """
    values = ssim_map(pred, target, data_range=data_range, window=window)
    return _inner_mean(values, window)


def ssim_map(
    pred: Float[Tensor, "h w c"],
    target: Float[Tensor, "h w c"],
    *,
    data_range: float = 1.0,
    window: Window = "gaussian",
) -> Float[Tensor, "h w"]:
    """Structural similarity of each pixel, mean over the channels, in float64.

    Args:
        pred: Image; continued by reflection over its border.
        target: Image.
        data_range: Largest minus smallest possible value.
        window: See `ssim`.

    Returns:
        Map of SSIM values.

    Raises:
        InputError: an image smaller than the window.
    """
    size = 2 * _RADIUS[window] + 1
    if min(pred.shape[:2]) < size:
        raise InputError(
            f"SSIM: expected images of {size}×{size} pixels or more, "
            f"found {pred.shape[0]}×{pred.shape[1]}; use a larger region"
        )
    x, y = (image.double().permute(2, 0, 1).contiguous() for image in (pred, target))
    mean_x, mean_y, xx, yy, xy = _smoothed(torch.stack([x, y, x * x, y * y, x * y]), window)
    unbias = size**2 / (size**2 - 1) if window == "uniform" else 1.0
    var_x, var_y = unbias * (xx - mean_x**2), unbias * (yy - mean_y**2)
    cov = unbias * (xy - mean_x * mean_y)
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    return (luminance * (2 * cov + c2) / (var_x + var_y + c2)).mean(0)


@torch.no_grad()
def score_image(
    pred: Float[Tensor, "h w 3"],
    target: Float[Tensor, "h w 3"],
    mask: Bool[Tensor, "h w"],
    protocol: Protocol = "strict",
    lpips: LPIPS | None = None,
    box: Bool[Tensor, "h w"] | None = None,
) -> Scores:
    """Score one rendered image against its ground truth.

    Args:
        pred: Rendered image over black, in [0, 1].
        target: Photograph in [0, 1]; its background is set to black here.
        mask: The true silhouette.
        protocol: `strict`: regions full, box (both images cropped to the mask's bounding box, no
            margin) and silhouette (inside the mask: PSNR of its pixels, means of the SSIM and
            LPIPS maps over it). `legacy`: region full. `boxed`: region box.
        lpips: From `load_lpips`; None leaves LPIPS undefined.
        box: For `boxed`: pixels whose ray meets the box of the body, from `body_box_mask`.

    Returns:
        Region → metric → value; None for a metric that is not defined there: LPIPS without
        weights or below 16 pixels, SSIM below its window.

    Raises:
        InputError: an empty mask, a value that is not finite, an unknown protocol, no box.
    """
    if protocol not in PROTOCOLS:
        known = ", ".join(PROTOCOLS)
        raise InputError(f"protocol: expected one of {known}, found {protocol!r}; choose one")
    if not bool(mask.any()):
        raise InputError("mask: expected a silhouette, found no pixel; leave this frame out")
    if not bool(pred.isfinite().all()):
        raise InputError("rendered image: expected finite colours, found NaN or infinity")
    target = target * mask[..., None]
    if protocol == "legacy":
        return {"full": _score_whole(pred, target, "legacy", lpips)}
    if protocol == "boxed":
        return {"box": _score_boxed(pred, target, box, lpips)}
    scores, inside = _score_full_and_silhouette(pred, target, mask, lpips)
    top, left, bottom, right = mask_box(mask)
    crop = (slice(top, bottom), slice(left, right))
    cropped = _score_whole(pred[crop], target[crop], "strict", lpips)
    return {"full": scores, "box": cropped, "silhouette": inside}


def mask_box(mask: Bool[Tensor, "h w"]) -> tuple[int, int, int, int]:
    """Smallest box that holds a mask.

    Args:
        mask: At least one pixel.

    Returns:
        top, left, bottom, right; bottom and right are one past the last pixel.

    Raises:
        InputError: an empty mask.

    >>> mask_box(torch.eye(4, dtype=torch.bool)[:3])
    (0, 0, 3, 3)
    """
    rows, columns = mask.any(1).nonzero(), mask.any(0).nonzero()
    if len(rows) == 0:
        raise InputError("mask: expected at least one pixel, found none; skip this frame")
    return int(rows[0]), int(columns[0]), int(rows[-1]) + 1, int(columns[-1]) + 1


def aggregate(scores: Sequence[Scores]) -> Scores:
    """Mean of each metric in each region, every image weighing the same.

    Args:
        scores: Results of `score_image`, one per image (frames × cameras).

    Returns:
        Region → metric → mean over the images where the metric is defined; None if nowhere.

    Raises:
        InputError: no image, or images with different regions.

    >>> aggregate([{"full": {"psnr": 30.0}}, {"full": {"psnr": 32.0}}])
    {'full': {'psnr': 31.0}}
    """
    if not scores:
        raise InputError("scores: expected at least one image, found none; check the split")
    if any(score.keys() != scores[0].keys() for score in scores):
        raise InputError("scores: expected the same regions everywhere; score with one protocol")
    return {
        region: {name: _mean([score[region][name] for score in scores]) for name in metrics}
        for region, metrics in scores[0].items()
    }


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None


def _score_whole(
    pred: Tensor, target: Tensor, protocol: Protocol, lpips: LPIPS | None
) -> dict[str, float | None]:
    """All metrics of two images as they are."""
    window: Window = "gaussian" if protocol == "strict" else "uniform"
    value_range: ValueRange = "[-1,1]" if protocol == "strict" else "[0,1]"
    data_range = 1.0 if protocol == "strict" else 2.0
    similarity = distance = None
    if min(pred.shape[:2]) > 2 * _RADIUS[window]:
        similarity = ssim(pred, target, data_range=data_range, window=window)
    if lpips is not None and min(pred.shape[:2]) >= MIN_SIZE:
        maps = lpips.layer_maps(pred, target, value_range=value_range, skip_black=True)
        distance = average_maps(maps).item()
    return {"psnr": psnr(pred, target), "ssim": similarity, "lpips": distance}


def _score_boxed(
    pred: Tensor, target: Tensor, box: Tensor | None, lpips: LPIPS | None
) -> dict[str, float | None]:
    """PSNR over the box of the body, the other metrics over the rectangle around it."""
    if box is None or not bool(box.any()):
        found = "none" if box is None else "no pixel"
        raise InputError(
            f"box: expected the pixels of the body's box, found {found}; take body_box_mask of a "
            "camera that sees the body"
        )
    top, left, bottom, right = mask_box(box)
    crop = (slice(top, bottom), slice(left, right))
    scores = _score_whole(pred[crop], target[crop], "legacy", lpips)
    return scores | {"psnr": psnr(pred, target, box)}


def _score_full_and_silhouette(
    pred: Tensor, target: Tensor, mask: Tensor, lpips: LPIPS | None
) -> tuple[dict[str, float | None], dict[str, float | None]]:
    """The two strict regions that share one SSIM map and one LPIPS pass."""
    full: dict[str, float | None] = {"psnr": psnr(pred, target), "ssim": None, "lpips": None}
    inside: dict[str, float | None] = {**full, "psnr": psnr(pred, target, mask)}
    height, width = mask.shape
    if min(height, width) > 2 * _RADIUS["gaussian"]:
        similarity = ssim_map(pred, target)
        full["ssim"] = _inner_mean(similarity, "gaussian")
        inside["ssim"] = similarity[mask].mean().item()
    if lpips is not None and min(height, width) >= MIN_SIZE:
        maps = lpips.layer_maps(pred, target, skip_black=True)
        full["lpips"] = average_maps(maps).item()
        inside["lpips"] = upsample_maps(maps, height, width)[0][mask].double().mean().item()
    return full, inside


def _inner_mean(values: Tensor, window: Window) -> float:
    """Mean of a map without the band where the window leaves the image."""
    r = _RADIUS[window]
    return values[r : values.shape[0] - r, r : values.shape[1] - r].mean().item()


def _smoothed(images: Tensor, window: Window) -> Tensor:
    """Window means of images n c H W; pixels beyond the border repeat d c b a | a b c d."""
    r = _RADIUS[window]
    offsets = torch.arange(-r, r + 1, dtype=images.dtype)
    taps = torch.exp(-0.5 * (offsets / _SIGMA) ** 2) if window == "gaussian" else offsets * 0 + 1
    taps = taps / taps.sum()
    return _filtered(_filtered(images, taps, -1), taps, -2)


def _filtered(x: Tensor, taps: Tensor, dim: int) -> Tensor:
    """Weighted sums along one dimension; ten times faster in float64 than a convolution."""
    r, size = len(taps) // 2, x.shape[dim]
    before, after = x.narrow(dim, 0, r).flip(dim), x.narrow(dim, size - r, r).flip(dim)
    padded = torch.cat([before, x, after], dim)
    total = torch.zeros_like(x)
    for k, weight in enumerate(taps.tolist()):
        total.add_(padded.narrow(dim, k, size), alpha=weight)
    return total
