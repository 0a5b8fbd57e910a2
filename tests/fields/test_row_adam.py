"""Adam over touched rows against torch's own Adam, its torch twin, and itself on more threads."""

import pytest
import torch

from monopart.fields.hash_grid import GridSpec, HashGrid
from monopart.fields.row_adam import AdamRule, RowAdam, RowMoments, row_adam
from monopart.geometry.errors import InputError

RULE = AdamRule(eps=1e-15)


def _start(rows, features, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(rows, features, generator=generator), generator


def _moments(table):
    return RowMoments(
        torch.zeros_like(table), torch.zeros_like(table), torch.zeros(len(table)).int()
    )


def _run(backend, rows=200, features=2, share=0.3, steps=12, threads=2):
    """Steps with random gradients on a random share of the rows."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        table, generator = _start(rows, features)
        moments = _moments(table)
        for now in range(1, steps + 1):
            grad = torch.randn(rows, features, generator=generator)
            grad[torch.rand(rows, generator=generator) >= share] = 0.0
            row_adam(table, grad, moments, now, 0.1 / now, RULE, backend)
            assert not grad.any(), "the step consumes the gradient"
    finally:
        torch.set_num_threads(before)
    return table, moments.mean, moments.square, moments.seen


@pytest.mark.parametrize("backend", ["torch", "warp"])
@pytest.mark.parametrize("features", [1, 2, 3, 4])
def test_equals_adam_where_every_row_is_touched(backend, features):
    table, generator = _start(130, features)
    theirs = torch.nn.Parameter(table.clone())
    adam = torch.optim.Adam([theirs], lr=0.05, betas=RULE.betas, eps=RULE.eps)
    moments = _moments(table)
    for now in range(1, 20):
        grad = torch.randn(130, features, generator=generator)
        theirs.grad = grad.clone()
        adam.step()
        row_adam(table, grad, moments, now, 0.05, RULE, backend)
    torch.testing.assert_close(table, theirs.detach(), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(moments.mean, adam.state[theirs]["exp_avg"])
    torch.testing.assert_close(moments.square, adam.state[theirs]["exp_avg_sq"])


@pytest.mark.parametrize("rows", [0, 1, 64, 5000])
@pytest.mark.parametrize("features", [1, 2, 4])
def test_warp_equals_torch(rows, features):
    for ours, twin in zip(_run("warp", rows, features), _run("torch", rows, features), strict=True):
        torch.testing.assert_close(ours, twin, rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize("backend", ["torch", "warp"])
def test_untouched_rows_stay(backend):
    table, _ = _start(300, 2)
    before, moments = table.clone(), _moments(table)
    grad = torch.zeros(300, 2)
    grad[7, 1] = -2.0
    row_adam(table, grad, moments, 1, 0.1, RULE, backend)
    others = torch.arange(300) != 7
    assert torch.equal(table[others], before[others])
    assert table[7, 0] == before[7, 0]
    assert moments.seen.nonzero().tolist() == [[7]]
    torch.testing.assert_close(table[7, 1], before[7, 1] + 0.1)
    row_adam(table, torch.zeros(300, 2), moments, 2, 0.1, RULE, backend)
    assert torch.equal(table[others], before[others])


@pytest.mark.parametrize("backend", ["torch", "warp"])
def test_a_row_catches_up_with_adam_after_a_rest(backend):
    """After many steps the bias corrections are 1, and the missed movement is that of Adam."""
    table, generator = _start(1, 2)
    theirs = torch.nn.Parameter(table.clone())
    adam = torch.optim.Adam([theirs], lr=0.01, betas=RULE.betas, eps=RULE.eps)
    moments = _moments(table)
    for now in range(1, 1500):
        grad = torch.randn(1, 2, generator=generator)
        if 1400 <= now < 1440:
            grad.zero_()
        theirs.grad = grad.clone()
        adam.step()
        row_adam(table, grad, moments, now, 0.01, RULE, backend)
    torch.testing.assert_close(table, theirs.detach(), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(moments.square, adam.state[theirs]["exp_avg_sq"])


def test_a_rest_without_end_leaves_no_nan():
    table, _ = _start(1, 2)
    moments = _moments(table)
    for now in (1, 2, 1_000_000):
        row_adam(table, torch.ones(1, 2), moments, now, 0.01, RULE, "warp")
    assert bool(table.isfinite().all())


def test_the_same_bits_on_any_number_of_threads():
    one, four = _run("warp", 5000, threads=1), _run("warp", 5000, threads=4)
    assert all(torch.equal(a, b) for a, b in zip(one, four, strict=True))


@pytest.mark.parametrize("backend", ["auto", "torch"])
def test_a_hash_grid_learns_without_a_new_gradient_per_step(backend):
    """Accumulated gradients equal autograd's, and the buffer is kept."""
    spec = GridSpec(levels=3, features=2, log2_size=9, base=4, growth=1.7)
    grids = [HashGrid([spec], torch.Generator().manual_seed(1)) for _ in range(2)]
    grids[0].accumulate = True
    points = torch.rand(40, 3)
    for _ in range(2):  # two backward passes add up
        for grid in grids:
            grid(points, None, backend).square().sum().backward()
    torch.testing.assert_close(grids[0].table.grad, grids[1].table.grad)
    optimizer, place = RowAdam([grids[0].table], lr=0.01), grids[0].table.grad.data_ptr()
    losses = []
    for _ in range(20):
        optimizer.zero_grad()
        loss = (grids[0](points, None, backend) - 1.0).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
        assert grids[0].table.grad.data_ptr() == place
        assert not grids[0].table.grad.any()
    assert losses[-1] < 0.9 * losses[0]


def test_state_is_put_back_bit_for_bit():
    runs = []
    for broken in (False, True):
        table = torch.nn.Parameter(_start(50, 2)[0])
        optimizer = RowAdam([table], lr=0.1)
        generator = torch.Generator().manual_seed(3)
        for step in range(8):
            if broken and step == 5:
                state = optimizer.state_dict()
                optimizer = RowAdam([table], lr=0.1)
                optimizer.load_state_dict(state)
                assert optimizer.state[table]["seen"].dtype == torch.int32
            grad = torch.randn(50, 2, generator=generator)
            grad[torch.rand(50, generator=generator) < 0.6] = 0.0
            table.grad = grad
            optimizer.step()
        runs.append(table.detach())
    assert torch.equal(*runs)


@pytest.mark.parametrize("betas", [(0.9, 0.5), (1.0, 0.99), (0.9, 1.0), (-0.1, 0.9), (0.9, 0.0)])
def test_a_rule_whose_missed_movements_grow_is_refused(betas: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="betas"):
        AdamRule(betas)


@pytest.mark.parametrize("second", [0.81, 0.81 + 1e-12])
def test_missed_movements_next_to_a_ratio_of_one(second: float) -> None:
    rule, start = AdamRule((0.9, second)), torch.ones(1, 1, dtype=torch.float64)
    table, grad = start.clone(), start.clone()
    moments = RowMoments(start * 0, start * 0, torch.zeros(1, dtype=torch.int32))
    row_adam(table, grad, moments, 1, 0.1, rule, "torch")
    before, mean, square = float(table), float(moments.mean), float(moments.square)
    row_adam(table, start.clone(), moments, 5, 0.1, rule, "torch")
    rate, root, eps = 0.1 / (1 - 0.9**5), 1 / (1 - second**5) ** 0.5, rule.eps
    missed = sum((0.9 / second**0.5) ** k for k in (1, 2, 3))
    wanted = before - rate * missed * mean / (square**0.5 * root + eps)
    mean, square = 0.9**4 * mean + 0.1, second**4 * square + 1 - second
    wanted -= rate * mean / (square**0.5 * root + eps)
    assert float(table) == pytest.approx(wanted, rel=1e-14)
