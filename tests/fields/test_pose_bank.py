"""The pose bank against a plain float64 loop and its torch twin, in value and gradient."""

import numpy as np
import pytest
import torch
from torch import Tensor

from monopart.fields.pose_bank import PoseBank
from monopart.geometry.errors import BackendError, InputError

LO = torch.tensor([[-1.0, 0.0, 0.5], [0.0, -0.2, 0.0]])
HI = torch.tensor([[1.0, 0.5, 0.9], [0.4, 0.3, 2.0]])
BOTH = pytest.mark.parametrize("backend", ["torch", "warp"])


def make(poses: int = 4, knots: int = 7, channels: int = 5) -> PoseBank:
    generator = torch.Generator().manual_seed(0)
    bank = PoseBank(LO, HI, poses, knots, channels)
    with torch.no_grad():
        bank.lines.copy_(torch.randn(bank.lines.shape, generator=generator))
    return bank


def some(count: int = 60, bodies: int = 3, near: int = 3, poses: int = 4) -> tuple[Tensor, ...]:
    """Points inside, outside and on knots; key poses may repeat and weights may be 0."""
    g = torch.Generator().manual_seed(1)
    part = torch.randint(0, 2, (count,), generator=g).sort()[0]
    inside = torch.rand(count, 3, generator=g) * 1.4 - 0.2
    inside[: count // 4] = (inside[: count // 4] * 6).round() / 6
    points = LO[part] + inside * (HI - LO)[part]
    body = torch.randint(0, bodies, (count,), generator=g)
    rows = torch.randint(0, poses, (bodies, 2, near), generator=g)
    weights = torch.rand(bodies, 2, near, generator=g).softmax(-1)
    weights[0] = torch.tensor([1.0, 0.0, 0.0])[:near]
    return points, part, body, rows, weights


def oracle(bank: PoseBank, data: tuple[Tensor, ...], cotangent: Tensor) -> tuple[Tensor, Tensor]:
    """Value and gradient of the lines, look-up before blend, by loops in float64."""
    points, part, body, rows, weights = (x.numpy() for x in data)
    lines = bank.lines.detach().double().numpy()
    _, _, _, knots, channels = lines.shape
    value, grad = np.zeros((len(points), 3 * channels)), np.zeros_like(lines)
    for i, (point, k, b) in enumerate(zip(points.astype(float), part, body, strict=True)):
        lo, hi = LO[k].double().numpy(), HI[k].double().numpy()
        for axis in range(3):
            at = min(max((point[axis] - lo[axis]) / (hi[axis] - lo[axis]), 0.0), 1.0) * (knots - 1)
            cell = min(int(at), knots - 2)
            columns = slice(axis * channels, (axis + 1) * channels)
            for q, w in zip(rows[b, k], weights[b, k].astype(float), strict=True):
                for knot, share in ((cell, cell + 1 - at), (cell + 1, at - cell)):
                    value[i, columns] += w * share * lines[k, q, axis, knot]
                    grad[k, q, axis, knot] += w * share * cotangent[i, columns].double().numpy()
    return torch.from_numpy(value), torch.from_numpy(grad)


@BOTH
@pytest.mark.parametrize("channels", [1, 5, 20])
def test_oracle(backend, channels: int) -> None:
    bank, data = make(channels=channels), some()
    cotangent = torch.randn(60, 3 * channels)
    found = bank(*data, backend=backend)
    (grad,) = torch.autograd.grad(found, bank.lines, cotangent)
    value, slope = oracle(bank, data, cotangent)
    torch.testing.assert_close(found.double(), value, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(grad.double(), slope, atol=1e-5, rtol=1e-5)


@BOTH
def test_one_body_is_blended_first_with_the_same_result(backend) -> None:
    bank = make()
    points, part, _, rows, weights = some()
    body = torch.zeros_like(part)
    data = (points, part, body, rows[1:2], weights[1:2])
    cotangent = torch.randn(60, 15)
    value, slope = oracle(bank, data, cotangent)
    found = bank(points, part, None, *data[3:], backend=backend)
    (grad,) = torch.autograd.grad(found, bank.lines, cotangent)
    torch.testing.assert_close(found.double(), value, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(grad.double(), slope, atol=1e-5, rtol=1e-5)


def test_gradients_in_float64() -> None:
    bank = make(poses=3, knots=4, channels=2).double()
    points, part, body, rows, weights = some(6, 2, 2, 3)
    weights = weights.double().requires_grad_()

    def call(lines: Tensor, w: Tensor) -> Tensor:
        given = (points.double(), part, body, rows, w)
        return torch.func.functional_call(bank, {"lines": lines}, given)

    assert torch.autograd.gradcheck(call, (bank.lines, weights))


def test_the_points_are_detached() -> None:
    bank, (points, *rest) = make(), some()
    points.requires_grad_()
    (grad,) = torch.autograd.grad(bank(points, *rest).sum(), points, allow_unused=True)
    assert grad is None


def test_threads_do_not_change_the_sum() -> None:
    bank, data = make(poses=9), some(5000, 3, 3, 9)
    grads, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            grads += torch.autograd.grad(bank(*data, backend="warp").square().sum(), bank.lines)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(grads[0], grads[1]) and torch.equal(grads[0], grads[2])


def test_key_poses_start_equal_so_that_a_blend_starts_as_each() -> None:
    bank = PoseBank(LO, HI, 4)
    points, part, body, rows, weights = some()
    blended = bank(points, part, body, rows, weights)
    alone = bank(points, part, None, torch.zeros(1, 2, 1, dtype=torch.int64), torch.ones(1, 2, 1))
    torch.testing.assert_close(blended, alone)
    assert blended.std() > 0.01


@BOTH
def test_no_points_one_point_and_nan(backend) -> None:
    bank, (_, _, _, rows, weights) = make(), some()
    none = torch.zeros(0, dtype=torch.int64)
    empty = bank(torch.zeros(0, 3), none, none, rows, weights, backend=backend)
    assert empty.shape == (0, 15)
    empty.sum().backward()
    assert bank.lines.grad is not None and not bank.lines.grad.any()
    zero = torch.zeros(1, dtype=torch.int64)
    assert bank(LO[:1], zero, zero, rows, weights, backend=backend).shape == (1, 15)
    bad = bank(torch.full((1, 3), torch.nan), zero, zero, rows, weights, backend=backend)
    assert bool(bad.isnan().all())


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (
            {"rows": torch.zeros(3, 1, 3, dtype=torch.int64), "weights": torch.ones(3, 1, 3)},
            "rows, weights",
        ),
        ({"rows": torch.full((3, 2, 3), 4)}, "rows: expected indices in"),
        ({"part": torch.full((60,), 2)}, "part: expected indices in"),
    ],
)
def test_wrong_input_is_named(change: dict[str, Tensor], word: str) -> None:
    names = ("points", "part", "body", "rows", "weights")
    given = dict(zip(names, some(), strict=True)) | change
    with pytest.raises(InputError, match=word):
        make()(**given)


def test_sizes_that_make_no_bank() -> None:
    for sizes in ((0, 4, 4), (1, 1, 4), (1, 4, 0)):
        with pytest.raises(InputError, match="PoseBank"):
            PoseBank(LO, HI, *sizes)
    with pytest.raises(InputError, match="hi > lo"):
        PoseBank(LO, LO, 2)


def test_what_the_kernels_do_not_do_is_said() -> None:
    bank, (points, part, body, rows, weights) = make(), some()
    weights.requires_grad_()
    with pytest.raises(BackendError, match="weights"):
        bank(points, part, body, rows, weights, backend="warp")
    assert bank(points, part, body, rows, weights).requires_grad
    with pytest.raises(BackendError, match="second derivative"):
        out = bank(points, part, body, rows, weights.detach(), backend="warp")
        torch.autograd.grad(out.sum(), bank.lines, create_graph=True)
