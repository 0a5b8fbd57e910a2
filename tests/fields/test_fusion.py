"""The attention over codes against plain loops, its twin and torch's own; state and gradients."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from monopart.fields.fusion import CodeFusion, attend
from monopart.geometry.errors import BackendError, InputError

COUNTS = (9, 0, 6)
BOTH = pytest.mark.parametrize("backend", ["torch", "warp"])


def make(**sizes: int) -> CodeFusion:
    torch.manual_seed(0)
    given = {"parts": 3, "inputs": 6, "codes": 11, "length": 3, "heads": 2, "width": 8}
    return CodeFusion(**(given | sizes))


def slow(fusion: CodeFusion, pose: Tensor, counts: tuple[int, ...]) -> np.ndarray:
    """One sample, one head, one code at a time, in float64."""
    state = {k: v.detach().double().numpy() for k, v in fusion.state_dict().items()}
    rows = pose.detach().double().numpy()
    part = [k for k, count in enumerate(counts) for _ in range(count)]
    width = state["to_keys"].shape[-1]
    size = width // fusion.heads
    out = []
    for row, k in zip(rows, part, strict=True):
        query = state["query.weights.0"][k] @ row + state["query.biases.0"][k]
        found = np.zeros(width)
        for h in range(fusion.heads):
            own = slice(h * size, (h + 1) * size)
            scores = []
            for code in state["codes"][k]:
                key = (code @ state["to_keys"][k])[own]
                scores.append(math.exp(sum(query[own] * key) / math.sqrt(size)))
            for score, code in zip(scores, state["codes"][k], strict=True):
                found[own] += score / sum(scores) * (code @ state["to_values"][k])[own]
        out.append(state["out.weights.0"][k] @ found + state["out.biases.0"][k])
    return np.array(out)


def test_the_module_is_the_slow_attention() -> None:
    fusion = make()
    pose = torch.randn(15, 6)
    expected = torch.from_numpy(slow(fusion, pose, COUNTS)).float()
    torch.testing.assert_close(fusion(pose, COUNTS), expected, atol=1e-5, rtol=1e-5)


def test_the_module_is_the_attention_of_torch() -> None:
    fusion = make(parts=1)
    theirs = torch.nn.MultiheadAttention(8, 2, kdim=3, vdim=3, batch_first=True)
    state = {k: v.detach() for k, v in fusion.state_dict().items()}
    pose = torch.randn(15, 6)
    with torch.no_grad():
        theirs.q_proj_weight.copy_(torch.eye(8))
        theirs.k_proj_weight.copy_(state["to_keys"][0].T)
        theirs.v_proj_weight.copy_(state["to_values"][0].T)
        theirs.in_proj_bias.zero_()
        theirs.out_proj.weight.copy_(torch.eye(8))
        theirs.out_proj.bias.zero_()
        query = fusion.query(pose, (15,))[None]
        found = theirs(query, state["codes"], state["codes"], need_weights=False)[0][0]
        expected = fusion.out(found, (15,))
        torch.testing.assert_close(fusion(pose, (15,)), expected, atol=1e-5, rtol=1e-5)


def inputs(codes: int, dim: int, scale: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(codes)
    query = scale * torch.randn(15, 2, dim, generator=generator)
    keys, values = torch.randn(2, 3, codes, 2, dim, generator=generator).unbind(0)
    return query.requires_grad_(), keys.requires_grad_(), values.requires_grad_()


@pytest.mark.parametrize(("codes", "dim"), [(1, 8), (16, 8), (100, 8), (37, 3)])
@pytest.mark.parametrize("scale", [1.0, 200.0])
def test_the_kernels_are_their_twin(codes: int, dim: int, scale: float) -> None:
    """Scores of hundreds too: a softmax without care would overflow."""
    data = inputs(codes, dim, scale)
    cotangent = torch.randn(15, 2, dim)
    query, keys, values = exact = [x.detach().double().requires_grad_() for x in data]
    expected = attend(query, keys, values, COUNTS, "torch")
    slopes = torch.autograd.grad(expected, exact, cotangent.double())
    found = attend(*data, COUNTS, "warp")
    bound = 1e-5 * max(1.0, scale / 10)  # rounding of a score of hundreds
    torch.testing.assert_close(found.double(), expected, atol=bound, rtol=1e-5)
    for a, b in zip(torch.autograd.grad(found, data, cotangent), slopes, strict=True):
        torch.testing.assert_close(a.double(), b, atol=bound * max(1.0, scale), rtol=1e-4)


def test_gradients_in_float64() -> None:
    fusion = make(codes=4).double()
    pose = torch.randn(15, 6, dtype=torch.float64, requires_grad=True)
    names = [n for n, _ in fusion.named_parameters()]

    def call(x: Tensor, *values: Tensor) -> Tensor:
        given = dict(zip(names, values, strict=True))
        return torch.func.functional_call(fusion, given, (x, COUNTS))

    assert torch.autograd.gradcheck(call, (pose, *fusion.parameters()), fast_mode=True)


def test_everything_is_registered_and_learns() -> None:
    fusion = make()
    assert {n.split(".")[0] for n in fusion.state_dict()} == {
        "codes",
        "to_keys",
        "to_values",
        "query",
        "out",
    }
    before = {id(m) for m in fusion.modules()}
    fusion(torch.randn(15, 6), COUNTS).square().sum().backward()
    assert {id(m) for m in fusion.modules()} == before, "no module is made in forward"
    for name, parameter in fusion.named_parameters():
        assert parameter.grad is not None and bool(parameter.grad.isfinite().all()), name
        assert bool(parameter.grad[0].any()) and bool(parameter.grad[2].any()), name
        assert not bool(parameter.grad[1].any()), f"{name}: no samples, no gradient"


def test_parts_do_not_share() -> None:
    fusion, pose = make(), torch.randn(15, 6)
    before = fusion(pose, COUNTS)
    with torch.no_grad():
        fusion.codes[2] += 1.0
    after = fusion(pose, COUNTS)
    assert torch.equal(before[:9], after[:9]) and not torch.allclose(before[9:], after[9:])


def test_the_codes_are_a_set() -> None:
    fusion, pose = make(), torch.randn(15, 6)
    before = fusion(pose, COUNTS)
    with torch.no_grad():
        fusion.codes.copy_(fusion.codes.flip(1))
    torch.testing.assert_close(fusion(pose, COUNTS), before)


def test_threads_do_not_change_the_sum() -> None:
    generator = torch.Generator().manual_seed(0)
    query = torch.randn(5000, 4, 8, generator=generator).requires_grad_()
    keys = torch.randn(2, 20, 4, 8, generator=generator).requires_grad_()
    grads, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            out = attend(query, keys, keys * 2, (3000, 2000), "warp")
            grads += torch.autograd.grad(out.square().sum(), keys)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(grads[0], grads[1]) and torch.equal(grads[0], grads[2])


@BOTH
def test_no_samples(backend) -> None:
    query, keys, values = (x.detach().requires_grad_() for x in inputs(5, 8))
    found = attend(query[:0], keys, values, (0, 0, 0), backend)
    assert found.shape == (0, 2, 8)
    for grad in torch.autograd.grad(found.sum(), (keys, values), allow_unused=True):
        assert grad is None or not grad.any()
    assert make()(torch.zeros(0, 6), (0, 0, 0)).shape == (0, 16)


def test_wrong_input_is_named() -> None:
    for sizes in ({"parts": 0}, {"heads": 3}, {"codes": 0}, {"length": 0}):
        with pytest.raises(InputError, match="CodeFusion"):
            make(**sizes)
    with pytest.raises(InputError, match="counts"):
        make()(torch.zeros(4, 6), (1, 1, 1))
    for backend in ("torch", "warp"):
        with pytest.raises(InputError, match="attend counts"):
            attend(*inputs(5, 8), (15, 1, 0), backend)


def test_a_second_derivative_of_the_kernels_is_refused() -> None:
    query, keys, values = inputs(5, 8)
    out = attend(query, keys, values, COUNTS, "warp")
    with pytest.raises(BackendError, match="second derivative"):
        torch.autograd.grad(out.sum(), query, create_graph=True)
