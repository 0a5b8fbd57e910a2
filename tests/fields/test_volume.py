"""Compositing: packed Warp and torch against loops and the dense reference."""

import math

import pytest
import torch

from monopart.fields.volume import Composite, composite, composite_dense
from monopart.geometry.errors import BackendError, InputError

BACKENDS = ["torch", "warp"]
FIELDS = ("color", "opacity", "depth", "weights")


def _scene(counts, seed=0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    m = sum(counts)
    sigma = torch.rand(m, generator=generator, dtype=dtype) * 8
    sigma[torch.rand(m, generator=generator) < 0.2] = 0
    color = torch.rand(m, 3, generator=generator, dtype=dtype)
    delta = torch.rand(m, generator=generator, dtype=dtype) * 0.2
    depth = torch.rand(m, generator=generator, dtype=dtype) + 2
    start = torch.tensor([0, *counts]).cumsum(0)
    return sigma, color, delta, start, depth


def _cotangents(result, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(getattr(result, f).shape, generator=generator) for f in FIELDS]


def _loss(result, cotangents):
    pairs = zip(FIELDS, cotangents, strict=True)
    return sum((getattr(result, f) * c.to(result.color.dtype)).sum() for f, c in pairs)


def _gradients(run, sigma, color, delta):
    leaves = [t.clone().requires_grad_() for t in (sigma, color, delta)]
    result = run(*leaves)
    _loss(result, _cotangents(result)).backward()
    return result, [leaf.grad for leaf in leaves]


def oracle(sigma, color, delta, start, depth):
    """Loops over rays and samples, float64 and differentiable."""
    sigma, color, delta, depth = (t.double() for t in (sigma, color, delta, depth))
    colors, opacities, depths, weights = [], [], [], []
    for a, b in zip(start[:-1].tolist(), start[1:].tolist(), strict=True):
        light = torch.ones((), dtype=torch.float64)
        c, o, d = torch.zeros(3).double(), torch.zeros(()).double(), torch.zeros(()).double()
        for i in range(a, b):
            alpha = 1 - torch.exp(-sigma[i] * delta[i])
            w = light * alpha
            light = light * (1 - alpha)
            c, o, d = c + w * color[i], o + w, d + w * depth[i]
            weights.append(w)
        colors.append(c)
        opacities.append(o)
        depths.append(d)
    return Composite(*(torch.stack(v) for v in (colors, opacities, depths, weights)))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("counts", [[1], [5], [3, 0, 7, 1, 0], [40, 2, 64]])
def test_oracle(counts, backend):
    sigma, color, delta, start, depth = _scene(counts)
    ours, grads = _gradients(
        lambda s, c, d: composite(s, c, d, start, depth, backend), sigma, color, delta
    )
    want, wanted = _gradients(lambda s, c, d: oracle(s, c, d, start, depth), sigma, color, delta)
    for field in FIELDS:
        error = getattr(ours, field).double() - getattr(want, field)
        assert error.abs().max() <= 2e-6
    for a, b in zip(grads, wanted, strict=True):
        assert (a - b).abs().max() <= 1e-5


@pytest.mark.parametrize("backend", BACKENDS)
def test_packed_equals_dense(backend):
    rays, samples = 1500, 24  # more rays than one launch takes on one thread
    sigma, color, delta, start, depth = _scene([samples] * rays)
    ours, grads = _gradients(
        lambda s, c, d: composite(s, c, d, start, depth, backend), sigma, color, delta
    )

    def dense(s, c, d):
        shape = (rays, samples)
        result = composite_dense(s.view(shape), c.view(*shape, 3), d.view(shape), depth.view(shape))
        flat = result.weights.flatten()
        return Composite(result.color, result.opacity, result.depth, flat)

    want, wanted = _gradients(dense, sigma, color, delta)
    for field in FIELDS:
        torch.testing.assert_close(getattr(ours, field), getattr(want, field), rtol=0, atol=1e-5)
    for a, b in zip(grads, wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("rays", [0, 3])
def test_no_samples(rays, backend):
    sigma, color, delta, start, depth = _scene([0] * rays)
    result, grads = _gradients(
        lambda s, c, d: composite(s, c, d, start, depth, backend), sigma, color, delta
    )
    assert result.color.shape == (rays, 3)
    assert result.color.abs().sum() + result.opacity.abs().sum() + result.depth.abs().sum() == 0
    assert result.weights.shape == (0,)
    assert [g.shape for g in grads] == [(0,), (0, 3), (0,)]


@pytest.mark.parametrize("backend", BACKENDS)
def test_saturated_and_zero_length(backend):
    inf = math.inf
    sigma = torch.tensor([0.0, inf, 5.0, 1e30, 1.0, inf, 2.0, 3e38, 0.0, 0.0])
    delta = torch.tensor([0.1, 0.1, 0.1, 0.1, 0.1, 0.0, 0.1, 1e30, 0.0, 1.0])
    color = torch.rand(10, 3)
    start = torch.tensor([0, 3, 5, 7, 10])
    result, grads = _gradients(
        lambda s, c, d: composite(s, c, d, start, torch.ones(10), backend), sigma, color, delta
    )
    thin = -math.expm1(-0.2)
    torch.testing.assert_close(result.opacity, torch.tensor([1.0, 1.0, thin, 1.0]))
    assert torch.equal(result.color[0], color[1])
    assert torch.equal(result.weights[:3], torch.tensor([0.0, 1.0, 0.0]))
    assert result.weights[5] == 0
    assert all(g.isfinite().all() for g in grads)
    assert grads[0][0] != 0  # the empty sample in front of the wall can still learn
    assert grads[0][1:3].abs().max() == 0  # the wall and what is behind it cannot


@pytest.mark.parametrize("backend", BACKENDS)
def test_thin_samples_are_exact(backend):
    """1 − exp(−x) in float32 would lose half its digits here."""
    sigma = torch.logspace(-12, 1, 200)
    start = torch.arange(201)
    one = torch.ones(200)
    found = composite(sigma, one[:, None].expand(200, 3), one, start, None, backend)
    wanted = -torch.expm1(-sigma.double())
    assert ((found.opacity - wanted) / wanted).abs().max() <= 1e-6
    assert found.depth is None


@pytest.mark.parametrize("backend", BACKENDS)
def test_nan_is_seen(backend):
    sigma, color, delta, start, _ = _scene([3])
    sigma[1] = math.nan
    assert composite(sigma, color, delta, start, None, backend).opacity.isnan().all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_stop_has_the_stated_error(backend):
    sigma, color, delta, start, depth = _scene([60, 0, 45, 3])
    exact = composite(sigma, color, delta, start, depth, backend)
    short = composite(sigma, color, delta, start, depth, backend, stop=1e-2)
    assert 0 < (exact.opacity - short.opacity).max() <= 1e-2
    assert (exact.color - short.color).abs().max() <= 1e-2
    assert (short.weights == 0).sum() > (exact.weights == 0).sum()


def test_stop_gradients_agree():
    sigma, color, delta, start, depth = _scene([60, 0, 45, 3])
    grads = [
        _gradients(
            lambda s, c, d, b=b: composite(s, c, d, start, depth, b, stop=1e-2),
            sigma,
            color,
            delta,
        )[1]
        for b in BACKENDS
    ]
    for a, b in zip(*grads, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)


def test_gradcheck_first_and_second_order():
    sigma, color, delta, start, depth = _scene([3, 0, 2], dtype=torch.float64)
    sigma = sigma + 0.1  # away from the kink at 0

    def run(s, c, d, z):
        result = composite(s, c, d, start, z, "torch")
        return tuple(getattr(result, field) for field in FIELDS)

    inputs = [t.requires_grad_() for t in (sigma, color, delta, depth)]
    assert torch.autograd.gradcheck(run, inputs)
    assert torch.autograd.gradgradcheck(run, inputs)


def test_gradients_are_bitwise_repeatable():
    sigma, color, delta, start, depth = _scene([20] * 2000)
    runs = [
        _gradients(lambda s, c, d: composite(s, c, d, start, depth, "warp"), sigma, color, delta)[1]
        for _ in range(2)
    ]
    assert all(torch.equal(a, b) for a, b in zip(*runs, strict=True))


def test_errors():
    sigma, color, delta, start, depth = _scene([3, 2])
    for bad in ([0, 3], [0, 6, 5], [1, 3, 5]):
        with pytest.raises(InputError, match="ray_start: expected ascending"):
            composite(sigma, color, delta, torch.tensor(bad), depth)
    with pytest.raises(InputError, match="found none"):
        composite(sigma, color, delta, torch.zeros(0, dtype=torch.long))
    with pytest.raises(InputError, match="one dtype"):
        composite(sigma, color.double(), delta, start)
    depth.requires_grad_()
    with pytest.raises(BackendError, match="no gradient in depth"):
        composite(sigma, color, delta, start, depth, "warp")
    composite(sigma, color, delta, start, depth).depth.sum().backward()
    assert depth.grad is not None
    result = composite(sigma.requires_grad_(), color, delta, start, None, "warp")
    with pytest.raises(BackendError, match="second derivative"):
        torch.autograd.grad(result.opacity.sum(), sigma, create_graph=True)
