"""The network of LPIPS for training on the CPU: weights laid out once, a hand-written backward.

oneDNN brings plain weights into its own layout at every call, which takes a fifth of the time of a
64-pixel patch: 59 MB of weights serve few pixels. Here they are laid out once per patch size, also
for the backward pass, in which the gradient of a 3×3 convolution is one with turned weights.
"""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from monopart.geometry.errors import BackendError

_ONES = (1, 1)
_CORE: Any = torch._C


def can_pack(like: Tensor) -> bool:
    """Whether this build of torch has the convolutions, for tensors of that device and type.

    Args:
        like: a tensor of the network's weights.
    """
    return (
        like.device.type == "cpu"
        and like.dtype == torch.float32
        and torch.backends.mkldnn.is_available()
        and hasattr(torch.ops.mkldnn, "_convolution_pointwise")
        and hasattr(_CORE._nn, "mkldnn_reorder_conv2d_weight")
    )


class PackedTaps:
    """Activations of a chain of 3×3 convolutions with ReLU and 2×2 poolings, for one image size."""

    def __init__(
        self,
        convolutions: Sequence[tuple[Float[Tensor, "_ _ 3 3"], Float[Tensor, "_"]]],
        stages: Sequence[int],
        size: tuple[int, int, int],
    ) -> None:
        """Lay out the weights.

        Args:
            convolutions: weight and bias of each, in order; constants.
            stages: convolutions of each stage; a pooling stands between two stages.
            size: number, height and width of the images.
        """
        self.size, self.stages = size, tuple(stages)
        self.biases = [bias for _, bias in convolutions]
        self.weights: list[Tensor] = []
        self.turned: list[Tensor] = []
        count, height, width = size
        at = iter(convolutions)
        for stage in self.stages:
            for _ in range(stage):
                weight, _bias = next(at)
                turned = weight.flip(2, 3).transpose(0, 1).contiguous()
                self.weights.append(_packed(weight, count, height, width))
                self.turned.append(_packed(turned, count, height, width))
            height, width = height // 2, width // 2

    def __call__(self, x: Float[Tensor, "n 3 h w"]) -> tuple[Float[Tensor, "..."], ...]:
        """The activations at the end of each stage, differentiable once in the images.

        Args:
            x: prepared images of the size given before.
        """
        return _Taps.apply(x, self)


class _Taps(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, net: PackedTaps) -> tuple[Tensor, ...]:
        kept, chosen, taps, conv = [], [], [], 0
        x = x.contiguous(memory_format=torch.channels_last)
        for stage, count in enumerate(net.stages):
            if stage:
                x, index = F.max_pool2d(x, 2, return_indices=True)
                chosen.append(index)
            for _ in range(count):
                x = _convolve(x, net.weights[conv], net.biases[conv], "relu")
                kept.append(x)
                conv += 1
            taps.append(x)
        ctx.net, ctx.chosen = net, chosen
        ctx.save_for_backward(*kept)
        return tuple(taps)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, None]:
        if torch.is_grad_enabled():
            raise BackendError(
                "LPIPS: the packed network has no second derivative (create_graph=True); pass "
                "target_features, which takes the plain one"
            )
        net, kept = ctx.net, ctx.saved_tensors
        conv = len(kept) - 1
        grad = torch.zeros_like(kept[-1])
        for stage in reversed(range(len(net.stages))):
            grad = grad + cotangents[stage]
            for _ in range(net.stages[stage]):
                grad = torch.ops.aten.threshold_backward(grad, kept[conv], 0)
                grad = _convolve(grad, net.turned[conv], None, "none")
                conv -= 1
            if stage:
                grad = torch.ops.aten.max_pool2d_with_indices_backward(
                    grad, kept[conv], [2, 2], [2, 2], [0, 0], [1, 1], False, ctx.chosen[stage - 1]
                )
        return grad, None


def _packed(weight: Tensor, count: int, height: int, width: int) -> Tensor:
    size = [count, weight.shape[1], height, width]
    plain = weight.contiguous().to_mkldnn()
    return _CORE._nn.mkldnn_reorder_conv2d_weight(plain, _ONES, _ONES, _ONES, 1, size)


def _convolve(x: Tensor, weight: Tensor, bias: Tensor | None, after: str) -> Tensor:
    x = x.contiguous(memory_format=torch.channels_last)
    return torch.ops.mkldnn._convolution_pointwise(
        x, weight, bias, _ONES, _ONES, _ONES, 1, after, [], ""
    )
