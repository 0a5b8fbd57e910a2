"""Networks per part against torch.nn.Linear, and the frequency encoding."""

import math

import pytest
import torch

from monopart.fields.frequency import FrequencyEncoding
from monopart.fields.mlp import PartMLP
from monopart.geometry.errors import InputError


def _reference(mlp, part):
    layers = []
    for weight, bias in zip(mlp.weights, mlp.biases, strict=True):
        linear = torch.nn.Linear(weight.shape[2], weight.shape[1])
        with torch.no_grad():
            linear.weight.copy_(weight[part])
            linear.bias.copy_(bias[part])
        layers += [linear, torch.nn.ReLU()]
    return torch.nn.Sequential(*layers[:-1])


@pytest.mark.parametrize("counts", [(7, 0, 12), (1, 0, 0), (0, 0, 4), (2, 3, 4)])
def test_equals_linear_layers_in_value_and_gradient(counts):
    mlp = PartMLP(3, (5, 16, 8, 4))
    x = torch.randn(sum(counts), 5, requires_grad=True)
    out = mlp(x, counts)
    cotangent = torch.randn_like(out)
    (grad,) = torch.autograd.grad(out, x, cotangent, retain_graph=True)
    out.backward(cotangent)
    start = 0
    for part, count in enumerate(counts):
        rows = slice(start, start + count)
        reference = _reference(mlp, part)
        own = x[rows].detach().requires_grad_()
        expected = reference(own)
        torch.testing.assert_close(out[rows], expected)
        expected.backward(cotangent[rows])
        torch.testing.assert_close(grad[rows], own.grad)
        for layer, linear in enumerate(reference[::2]):
            torch.testing.assert_close(mlp.weights[layer].grad[part], linear.weight.grad)
            torch.testing.assert_close(mlp.biases[layer].grad[part], linear.bias.grad)
            if count == 0:
                assert mlp.weights[layer].grad[part].abs().max() == 0
        start += count


def test_no_rows_give_zero_gradients():
    mlp = PartMLP(3, (5, 8, 4))
    out = mlp(torch.zeros(0, 5), [0, 0, 0])
    assert out.shape == (0, 4)
    out.sum().backward()
    assert all(p.grad is not None and p.grad.abs().max() == 0 for p in mlp.parameters())


def test_one_part_needs_no_counts():
    mlp = PartMLP(1, (5, 8, 4))
    x = torch.randn(6, 5)
    torch.testing.assert_close(mlp(x), _reference(mlp, 0)(x))
    assert torch.equal(mlp(x), mlp(x, [6]))


def test_initial_values():
    mlp = PartMLP(2, (64, 32, 3), generator=torch.Generator().manual_seed(1))
    again = PartMLP(2, (64, 32, 3), generator=torch.Generator().manual_seed(1))
    pairs = zip(mlp.parameters(), again.parameters(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)
    for store in (mlp.weights, mlp.biases):
        assert 0.9 / 8 < store[0].abs().max() <= 1 / 8  # 1/sqrt(fan_in), as torch.nn.Linear
        assert not torch.equal(store[0][0], store[0][1])
    zero = PartMLP(2, (4, 8, 3), zero_last=True)
    assert zero(torch.randn(5, 4), (2, 3)).abs().max() == 0
    zero(torch.randn(5, 4), (2, 3)).sum().backward()
    assert zero.weights[-1].grad.abs().max() > 0


def test_gradcheck():
    mlp = PartMLP(2, (2, 3, 2)).double()
    x = torch.randn(3, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: mlp(x, (1, 2)), (x,))


def test_errors():
    mlp = PartMLP(2, (3, 4, 2))
    for counts in ((3, 3), (5,), (6, -1)):
        with pytest.raises(InputError, match="add up to 5"):
            mlp(torch.zeros(5, 3), counts)
    with pytest.raises(InputError, match="found None"):
        mlp(torch.zeros(5, 3))
    with pytest.raises(InputError, match="3 columns"):
        mlp(torch.zeros(5, 4), (2, 3))
    with pytest.raises(InputError, match="widths"):
        PartMLP(2, (3,))


def test_frequency_encoding():
    encode = FrequencyEncoding(3, octaves=2)
    x = torch.tensor([[0.1, -0.7, 0.5]], dtype=torch.float64)
    wanted = [0.1, -0.7, 0.5]
    for function in (math.sin, math.cos):
        wanted += [function(v * octave) for v in (0.1, -0.7, 0.5) for octave in (1, 2)]
    torch.testing.assert_close(encode(x)[0], torch.tensor(wanted, dtype=torch.float64))
    assert encode.out_features == 15
    assert FrequencyEncoding(3, 2, include_raw=False)(x).shape == (1, 12)
    assert torch.equal(FrequencyEncoding(3, 0)(x), x)
    assert encode(torch.zeros(0, 4, 3)).shape == (0, 4, 15)
    with pytest.raises(InputError, match="3 columns"):
        encode(torch.zeros(1, 2))
    with pytest.raises(InputError, match="one column"):
        FrequencyEncoding(3, 0, include_raw=False)


def test_products_in_half_precision_are_near_and_keep_the_type():
    mlp = PartMLP(2, (8, 16, 3))
    x = torch.rand(9, 8)
    exact = mlp(x, (4, 5))
    mlp.compute = torch.float16
    found = mlp(x, (4, 5))
    assert found.dtype == torch.float32
    assert 0 < float((found - exact).detach().abs().max()) < 5e-3
    assert mlp(x[:0], (0, 0)).dtype == torch.float32
