"""LPIPS-VGG: a perceptual distance of images, as a loss on patches and as a metric.

Value convention: images are in [0, 1]; `value_range="[-1,1]"` scales them to [-1, 1] before the
network, as its authors do (`strict`); `"[0,1]"` feeds them unscaled (`legacy`).

Reference: Zhang et al., The Unreasonable Effectiveness of Deep Features as a Perceptual Metric
(CVPR 2018), equation 1.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from monopart.geometry.errors import InputError

from .lpips_taps import PackedTaps, can_pack
from .lpips_weights import ENV_NAME, STAGE_WIDTHS, expected_shapes, find_lpips_weights

ValueRange = Literal["[-1,1]", "[0,1]"]
Box = tuple[int, int, int, int]
"""top, left, bottom, right; half open."""

MIN_SIZE = 16
"""Smallest height and width, pixels: four poolings must leave one pixel."""

_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_EPS = 1e-8
# Past 98 px from the border no output sees it: 224 px hold a border band on each side and a middle.
_BLACK_SIZE = 224
# Above this share of the image the copies cost more than the skipped pixels.
_MAX_SKIP_SHARE = 0.6

_loaded: dict[str, "LPIPS"] = {}


class LPIPS(torch.nn.Module):
    """Distance of two images in unit-normalised VGG16 features (relu1_2, 2_2, 3_3, 4_3, 5_3).

    The weights are constant buffers outside `state_dict()` and `parameters()`: they are neither
    trained nor saved with a model. The module follows its input's device.

    Args:
        weights: Tensors as in `lpips_weights.expected_shapes`.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, weights: Mapping[str, Float[Tensor, "..."]]) -> None:
        super().__init__()
        for name in expected_shapes():
            value = weights[name].detach().clone()
            if value.ndim == 4:  # twice as fast as the default layout on CPU
                value = value.contiguous(memory_format=torch.channels_last)
            self.register_buffer(name.replace(".", "_"), value, persistent=False)
        self.register_buffer("shift", torch.tensor(_SHIFT), persistent=False)
        self.register_buffer("scale", torch.tensor(_SCALE), persistent=False)
        self._black: dict[tuple[object, ...], list[Tensor]] = {}
        self._packed: PackedTaps | None = None

    def forward(
        self,
        pred: Float[Tensor, "*b h w 3"],
        target: Float[Tensor, "*b h w 3"] | None = None,
        *,
        value_range: ValueRange = "[-1,1]",
        target_features: Sequence[Float[Tensor, "..."]] | None = None,
        spatial: bool = False,
    ) -> Float[Tensor, "*out"]:
        """LPIPS of image pairs, differentiable in `pred` (and in `target` if it asks for it).

        Args:
            pred: Images in [0, 1], at least 16×16 pixels.
            target: Images in [0, 1]; None where `target_features` are given.
            value_range: What the network is fed, see the module.
            target_features: `features(target)`, computed before.
            spatial: Return a map, each layer upsampled bilinearly, instead of the mean.

        Returns:
            `*b` distances, or `*b h w` maps.

        Raises:
            InputError: too small an image, or not exactly one of target and target_features.
        """
        height, width = pred.shape[-3], pred.shape[-2]
        maps = self.layer_maps(
            pred, target, value_range=value_range, target_features=target_features
        )
        if spatial:
            return upsample_maps(maps, height, width).reshape(*pred.shape[:-3], height, width)
        return average_maps(maps).reshape(pred.shape[:-3])

    def features(
        self, images: Float[Tensor, "*b h w 3"], *, value_range: ValueRange = "[-1,1]"
    ) -> tuple[Float[Tensor, "..."], ...]:
        """Unit-normalised features of the five layers, to be kept for a target that is used often.

        Args:
            images: Images in [0, 1].
            value_range: What the network is fed, see the module.

        Returns:
            Five tensors n×C×h×w, n the product of the leading batch.
        """
        return tuple(_unit(tap) for tap in self._taps(self._prepared(images, value_range)))

    def layer_maps(
        self,
        pred: Float[Tensor, "*b h w 3"],
        target: Float[Tensor, "*b h w 3"] | None = None,
        *,
        value_range: ValueRange = "[-1,1]",
        target_features: Sequence[Float[Tensor, "..."]] | None = None,
        skip_black: bool = False,
    ) -> tuple[Float[Tensor, "..."], ...]:
        """Weighted squared feature differences of each layer, before any averaging.

        Args:
            pred: Images in [0, 1].
            target: Images in [0, 1]; None where `target_features` are given.
            value_range: What the network is fed, see the module.
            target_features: `features(target)`, computed before.
            skip_black: Skip, exactly, what lies outside the receptive field of the pixels that
                are not black in both images. Not differentiable.

        Returns:
            Five maps n×h×w, halved in size from layer to layer.

        Raises:
            InputError: too small an image, or not exactly one of target and target_features.
        """
        if (target is None) == (target_features is None):
            raise InputError(
                "LPIPS: expected one of target and target_features, found both or none"
            )
        if target is None:
            ours = self.features(pred, value_range=value_range)
            return self._differences(ours, target_features or ())
        if torch.is_grad_enabled() and pred.requires_grad and not target.requires_grad:
            with torch.no_grad():  # in one batch the backward pass would run for the target too
                theirs = self._training_features(target, value_range)
            return self._differences(self._training_features(pred, value_range), theirs)
        if skip_black:
            with torch.no_grad():
                box = _skippable_box(pred, target)
                if box is not None:
                    return self._maps_in_box(pred, target, box, value_range)
        pair = torch.stack([pred, target])
        taps = self._taps(self._prepared(pair, value_range))
        return tuple(self._difference(i, *_unit(tap).chunk(2)) for i, tap in enumerate(taps))

    def _training_features(self, images: Tensor, value_range: ValueRange) -> tuple[Tensor, ...]:
        """`features` for patches of one size again and again; differentiable once."""
        x = self._prepared(images, value_range)
        if not can_pack(self.shift):
            return tuple(_unit(tap) for tap in self._taps(x))
        size = (x.shape[0], x.shape[2], x.shape[3])
        if self._packed is None or self._packed.size != size:
            names = [f"conv_{i}" for i in range(sum(map(len, STAGE_WIDTHS)))]
            pairs = [(self.get_buffer(f"{n}_weight"), self.get_buffer(f"{n}_bias")) for n in names]
            self._packed = PackedTaps(pairs, [len(widths) for widths in STAGE_WIDTHS], size)
        return tuple(_unit(tap) for tap in self._packed(x))

    def _prepared(self, images: Tensor, value_range: ValueRange) -> Tensor:
        """Images *b H W 3 in [0, 1] to the network's input n 3 H W, channels last."""
        if value_range not in ("[-1,1]", "[0,1]"):
            raise InputError(f"LPIPS value_range: expected [-1,1] or [0,1], found {value_range!r}")
        height, width = images.shape[-3:-1]
        if min(height, width) < MIN_SIZE:
            raise InputError(
                f"LPIPS: expected images of {MIN_SIZE}×{MIN_SIZE} pixels or more, "
                f"found {height}×{width}; use larger patches"
            )
        return self._scaled(images, value_range)

    def _scaled(self, images: Tensor, value_range: ValueRange) -> Tensor:
        """`_prepared` without its checks, for windows of any size."""
        if images.device != self.shift.device:
            self.to(images.device)
        height, width = images.shape[-3:-1]
        x = images.to(self.shift.dtype).reshape(-1, height, width, 3)
        x = x * 2 - 1 if value_range == "[-1,1]" else x
        return ((x - self.shift) / self.scale).permute(0, 3, 1, 2)

    def _conv(self, i: int, x: Tensor, padding: int) -> Tensor:
        weight, bias = self.get_buffer(f"conv_{i}_weight"), self.get_buffer(f"conv_{i}_bias")
        return F.relu_(F.conv2d(x, weight, bias, padding=padding))

    def _taps(self, x: Tensor) -> Iterator[Tensor]:
        """The activations at the five taps, one at a time."""
        conv = 0
        for stage, widths in enumerate(STAGE_WIDTHS):
            x = F.max_pool2d(x, 2) if stage else x
            for _ in widths:
                x = self._conv(conv, x, padding=1)
                conv += 1
            yield x

    def _differences(self, ours: Sequence[Tensor], theirs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        return tuple(
            self._difference(i, a, b) for i, (a, b) in enumerate(zip(ours, theirs, strict=True))
        )

    def _difference(self, layer: int, a: Tensor, b: Tensor) -> Tensor:
        """One layer's map n h w of two unit feature maps n C h w."""
        return (a - b).square().permute(0, 2, 3, 1) @ self.get_buffer(f"head_{layer}_weight")

    def _black_inputs(self, value_range: ValueRange) -> list[Tensor]:
        """Inputs of every convolution and pooling for a small black image, in order, cached."""
        key = (value_range, self.shift.device, self.shift.dtype)
        if key not in self._black:
            images = torch.zeros(_BLACK_SIZE, _BLACK_SIZE, 3).to(self.shift)
            x, conv, inputs = self._prepared(images, value_range), 0, []
            for stage, widths in enumerate(STAGE_WIDTHS):
                if stage:
                    inputs.append(x)
                    x = F.max_pool2d(x, 2)
                for _ in widths:
                    inputs.append(x)
                    x = self._conv(conv, x, padding=1)
                    conv += 1
            self._black[key] = inputs
        return self._black[key]

    def _maps_in_box(
        self, pred: Tensor, target: Tensor, box: Box, value_range: ValueRange
    ) -> tuple[Tensor, ...]:
        """Layer maps from a window that grows with the receptive field; black features around it.

        Outside the window both images have the features of a black image, so the difference is 0;
        the features that the window's border needs come from a small black image.
        """
        size = (pred.shape[-3], pred.shape[-2])
        top, left, bottom, right = box
        pair = torch.stack([pred, target])[..., top:bottom, left:right, :].flatten(0, -4)
        black = iter(self._black_inputs(value_range))
        x, maps, conv = self._scaled(pair, value_range), [], 0
        for stage, widths in enumerate(STAGE_WIDTHS):
            if stage:
                even = (box[0] // 2 * 2, box[1] // 2 * 2, -(-box[2] // 2) * 2, -(-box[3] // 2) * 2)
                x = F.max_pool2d(_on_black(x, box, even, next(black), size), 2)
                box = (even[0] // 2, even[1] // 2, even[2] // 2, even[3] // 2)
                size = (size[0] // 2, size[1] // 2)
            for _ in widths:
                seen = _grown(box, 2, (-1, -1, size[0] + 1, size[1] + 1))
                x = self._conv(conv, _on_black(x, box, seen, next(black), size), padding=0)
                box = _grown(box, 1, (0, 0, *size))
                conv += 1
            inside = self._difference(stage, *_unit(x).chunk(2))
            whole = inside.new_zeros(inside.shape[0], *size)
            whole[:, box[0] : box[2], box[1] : box[3]] = inside
            maps.append(whole)
        return tuple(maps)


def average_maps(maps: Sequence[Float[Tensor, "..."]]) -> Float[Tensor, " n"]:
    """LPIPS of layer maps: the sum of their spatial means.

    Args:
        maps: Maps n×h×w of `LPIPS.layer_maps`.

    Returns:
        n distances.

    >>> average_maps([torch.ones(2, 4, 4), torch.ones(2, 2, 2)])
    tensor([2., 2.])
    """
    return torch.stack([layer.mean((-2, -1)) for layer in maps]).sum(0)


def upsample_maps(
    maps: Sequence[Float[Tensor, "..."]], height: int, width: int
) -> Float[Tensor, "n height width"]:
    """LPIPS per pixel: the sum of the layer maps, each upsampled bilinearly.

    Args:
        maps: Maps n×h×w of `LPIPS.layer_maps`.
        height: Rows of the result.
        width: Columns of the result.

    Returns:
        n maps.
    """
    size = (height, width)
    layers = [F.interpolate(layer[:, None], size, mode="bilinear") for layer in maps]
    return torch.stack(layers).sum(0)[:, 0]


def load_lpips(*, required: bool = False) -> LPIPS | None:
    """LPIPS-VGG with the weights found on this machine, loaded once per process.

    Args:
        required: Raise where there are no weights, instead of returning None.

    Returns:
        The module, on the CPU until it sees an input elsewhere; None without weights.

    Raises:
        InputError: no weights and `required`, or a broken weights file.
    """
    key = os.environ.get(ENV_NAME, "")
    if key not in _loaded:
        weights = find_lpips_weights(required=required)
        if weights is None:
            return None
        _loaded[key] = LPIPS(weights)
    return _loaded[key]


def _unit(x: Tensor) -> Tensor:
    """Features n C h w of unit length; the root's argument stays positive, its slope finite."""
    return x / (x.square().sum(1, keepdim=True) + _EPS**2).sqrt()


def _grown(box: Box, by: int, limits: Box) -> Box:
    """The box grown by some pixels, kept within the limits."""
    return (
        max(box[0] - by, limits[0]),
        max(box[1] - by, limits[1]),
        min(box[2] + by, limits[2]),
        min(box[3] + by, limits[3]),
    )


def _skippable_box(pred: Tensor, target: Tensor) -> Box | None:
    """Box of the pixels that are not black in both images; None where skipping does not pay."""
    height, width = pred.shape[-3:-1]
    # Windows are placed on the pooling grid, and borders look up a 224-pixel black image.
    if height % 16 or width % 16 or min(height, width) < _BLACK_SIZE:
        return None
    lit = ((pred != 0) | (target != 0)).any(-1).reshape(-1, height, width).any(0)
    rows, columns = lit.any(1).nonzero(), lit.any(0).nonzero()
    if len(rows) == 0:
        return None
    top, bottom = int(rows[0]), int(rows[-1]) + 1
    left, right = int(columns[0]), int(columns[-1]) + 1
    if (bottom - top) * (right - left) > _MAX_SKIP_SHARE * height * width:
        return None
    return top, left, bottom, right


def _on_black(x: Tensor, box: Box, around: Box, black: Tensor, size: tuple[int, int]) -> Tensor:
    """Window `around` of activations: `x` in `box`, a black image's around it, 0 off the image."""
    inside = _grown(around, 0, (0, 0, *size))
    rows = _black_index(inside[0], inside[2], size[0], black)
    columns = _black_index(inside[1], inside[3], size[1], black)
    canvas = black.index_select(2, rows).index_select(3, columns)
    canvas = canvas.repeat(x.shape[0], 1, 1, 1).contiguous(memory_format=torch.channels_last)
    top, left = box[0] - inside[0], box[1] - inside[1]
    canvas[:, :, top : top + x.shape[2], left : left + x.shape[3]] = x
    pad = (
        inside[1] - around[1],
        around[3] - inside[3],
        inside[0] - around[0],
        around[2] - inside[2],
    )
    return F.pad(canvas, pad) if any(pad) else canvas


def _black_index(start: int, stop: int, size: int, black: Tensor) -> Tensor:
    """Rows of the small black image that equal rows start..stop of a black image of `size` rows."""
    small = black.shape[-1]
    i = torch.arange(start, stop, device=black.device)
    return torch.where(i < small // 2, i, (small - size + i).clamp(min=small // 2))
