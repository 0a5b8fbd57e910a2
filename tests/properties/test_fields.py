"""Compositing, hash grids, unions and memories follow relabellings, splits and sums."""

import oracles
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from motions import close, generator, normal, seeds, shuffled
from torch import Tensor

from monopart.fields.distance_prior import DistancePrior
from monopart.fields.hash_grid import GridSpec, HashGrid
from monopart.fields.mlp import PartMLP
from monopart.fields.occupancy import PartOccupancy, visible_samples
from monopart.fields.part_union import union_by_density
from monopart.fields.residual import ResidualField
from monopart.fields.row_adam import AdamRule, RowMoments, row_adam
from monopart.fields.volume import Composite, composite
from monopart.geometry.surface import SurfaceIndex, signed_distance, vertex_normals

FEW = settings(max_examples=20)
BACKENDS = [("torch", torch.float64, 1e-13), ("warp", torch.float32, 2e-6)]
backends = st.sampled_from(BACKENDS)


# --- compositing ----------------------------------------------------------------------------------


class Packed:
    """Random rays: counts, densities, colours, lengths, depths."""

    def __init__(self, seed: int, dtype: torch.dtype, counts: list[int] | None = None) -> None:
        g = generator(seed)
        counts = torch.randint(0, 9, (7,), generator=g).tolist() if counts is None else counts
        self.counts = torch.tensor(counts)
        n = int(self.counts.sum())
        self.sigma = torch.rand(n, generator=g).mul(40).to(dtype)
        self.color = torch.rand(n, 3, generator=g).to(dtype)
        self.delta = torch.rand(n, generator=g).mul(0.1).to(dtype)
        self.depth = torch.rand(n, generator=g).mul(5).to(dtype)

    def take(self, rows: Tensor, counts: Tensor) -> "Packed":
        other = Packed.__new__(Packed)
        other.counts = counts
        for name in ("sigma", "color", "delta", "depth"):
            setattr(other, name, getattr(self, name)[rows])
        return other

    def starts(self) -> Tensor:
        return torch.cat([self.counts.new_zeros(1), self.counts.cumsum(0)])

    def rows_of(self, rays: list[int]) -> Tensor:
        start = self.starts()
        pieces = [torch.arange(int(start[r]), int(start[r + 1])) for r in rays]
        return torch.cat(pieces) if pieces else torch.zeros(0, dtype=torch.long)

    def composite(self, backend: str) -> Composite:
        values = (self.sigma, self.color, self.delta, self.starts())
        return composite(*values, depth=self.depth, backend=backend)


def seen(out: Composite) -> Tensor:
    return torch.cat([out.color, out.opacity[:, None], out.depth[:, None]], -1)


@FEW
@given(seeds, backends)
def test_the_order_of_rays_does_not_matter(seed: int, backend: tuple) -> None:
    name, dtype, _ = backend
    rays = Packed(seed, dtype)
    order = shuffled(seed, len(rays.counts))
    mixed = rays.take(rays.rows_of(order.tolist()), rays.counts[order])
    close(seen(mixed.composite(name)), seen(rays.composite(name))[order], 0)


@FEW
@given(seeds, st.floats(0.0, 1.0), backends)
def test_a_sample_cut_in_two_is_the_same_sample(seed: int, cut: float, backend: tuple) -> None:
    name, dtype, bound = backend
    rays = Packed(seed, dtype)
    rows = torch.arange(len(rays.sigma)).repeat_interleave(2)
    halves = rays.take(rows, 2 * rays.counts)
    share = torch.tensor([cut, 1 - cut], dtype=dtype).repeat(len(rays.sigma))
    halves.delta = halves.delta * share
    close(seen(halves.composite(name)), seen(rays.composite(name)), 30 * bound)


@FEW
@given(seeds, backends)
def test_a_ray_is_its_front_and_then_its_back(seed: int, backend: tuple) -> None:
    name, dtype, bound = backend
    rays = Packed(seed, dtype, [8, 8, 8])
    start = rays.starts()[:-1, None]
    front = rays.take((start + torch.arange(3)).flatten(), torch.full((3,), 3)).composite(name)
    back = rays.take((start + torch.arange(3, 8)).flatten(), torch.full((3,), 5)).composite(name)
    left = (1 - front.opacity)[:, None]
    close(seen(rays.composite(name)), seen(front) + left * seen(back), 30 * bound)


@FEW
@given(seeds, backends)
def test_opacity_grows_with_density_and_length(seed: int, backend: tuple) -> None:
    name, dtype, bound = backend
    rays = Packed(seed, dtype)
    before = rays.composite(name)
    optical = rays.sigma * rays.delta
    ray = torch.repeat_interleave(torch.arange(len(rays.counts)), rays.counts)
    total = torch.zeros(len(rays.counts), dtype=dtype).index_add(0, ray, optical)
    close(before.opacity, -torch.expm1(-total), 5 * bound)
    close(torch.zeros_like(total).index_add(0, ray, before.weights), before.opacity, 5 * bound)
    for field, change in (("sigma", 5.0), ("delta", 0.05)):
        other = rays.take(torch.arange(len(ray)), rays.counts)
        grown = getattr(other, field) + change * torch.rand(len(ray), generator=generator(seed))
        setattr(other, field, grown.to(dtype))
        assert bool((other.composite(name).opacity >= before.opacity - bound).all())


@FEW
@given(seeds, backends)
def test_colours_are_mixed_linearly(seed: int, backend: tuple) -> None:
    name, dtype, bound = backend
    rays = Packed(seed, dtype)
    before = rays.composite(name)
    rays.color = torch.full_like(rays.color, 0.3)
    close(rays.composite(name).color, (0.3 * before.opacity)[:, None].expand(-1, 3), 5 * bound)


@FEW
@given(seeds, backends)
def test_empty_space_and_what_is_hidden_do_not_count(seed: int, backend: tuple) -> None:
    name, dtype, bound = backend
    rays = Packed(seed, dtype, [6, 6])
    before = seen(rays.composite(name))
    wide = rays.take(torch.arange(12).repeat_interleave(2), torch.full((2,), 12))
    wide.sigma[1::2] = 0
    close(seen(wide.composite(name)), before, bound)
    walled = rays.take(torch.arange(12), rays.counts)
    walled.sigma[[2, 8]] = torch.inf
    shown = walled.composite(name)
    walled.color[[3, 4, 5, 9, 10, 11]] = 0.9
    walled.sigma[[3, 4, 5, 9, 10, 11]] = 7.0
    walled.delta[[2, 8]] = 0.05
    close(seen(walled.composite(name)), seen(shown), bound)
    close(shown.opacity, torch.ones_like(shown.opacity), bound)


# --- hash grids -----------------------------------------------------------------------------------

SPECS = (
    GridSpec(levels=4, features=2, log2_size=8, base=3, growth=1.7),
    GridSpec(levels=4, features=2, log2_size=6, base=2, growth=1.9),
    GridSpec(levels=4, features=2, log2_size=12, base=5, growth=1.3),
)


def grid_of(order: list[int], dtype: torch.dtype = torch.float32) -> HashGrid:
    """Parts in an order; each part's own table does not depend on it."""
    grid = HashGrid([SPECS[k] for k in order])
    tables = [normal(k, sum(SPECS[k].sizes), 2) for k in order]
    with torch.no_grad():
        grid.table.copy_(torch.cat(tables))
    return grid.to(dtype)


def cube(seed: int, count: int, dtype: torch.dtype) -> Tensor:
    return torch.rand(count, 3, generator=generator(seed), dtype=torch.float64).to(dtype)


@FEW
@given(seeds, st.permutations([0, 1, 2]), backends)
def test_the_order_of_parts_and_points_does_not_matter(
    seed: int, order: list[int], backend: tuple
) -> None:
    name, dtype, _ = backend
    points = cube(seed, 50, dtype)
    part = torch.randint(0, 3, (50,), generator=generator(seed))
    before = grid_of([0, 1, 2], dtype)(points, part, name)
    place = torch.tensor(order).argsort()
    rows = shuffled(seed, 50)
    close(grid_of(order, dtype)(points[rows], place[part][rows], name), before[rows], 0)


@FEW
@given(seeds, st.integers(0, 2), st.integers(0, 3), st.integers(0, 2), backends)
def test_features_are_continuous_across_cells(
    seed: int, part: int, level: int, axis: int, backend: tuple
) -> None:
    name, dtype, _ = backend
    grid, spec = grid_of([0, 1, 2], dtype), SPECS[part]
    cells = spec.resolutions[level]
    points = cube(seed, 30, dtype)
    border = torch.randint(1, max(cells, 2), (30,), generator=generator(seed)).to(dtype) / cells
    step = 1e-6 if dtype == torch.float64 else 1e-5
    sides = []
    for shift in (-step, step):
        beside = points.clone()
        beside[:, axis] = border + shift
        sides.append(grid(beside, torch.full((30,), part), name).detach())
    slope = 2 * float(grid.table.detach().abs().max()) * max(spec.resolutions)
    assert float((sides[0] - sides[1]).abs().max()) <= 2 * step * slope + 1e-6


@FEW
@given(seeds, backends)
def test_features_at_vertices_are_rows_of_the_table(seed: int, backend: tuple) -> None:
    """And weights sum to one: a table of ones gives ones everywhere."""
    name, dtype, bound = backend
    grid = grid_of([0, 1, 2], dtype)
    for part, spec in enumerate(SPECS):
        cells = spec.resolutions[0]
        vertex = torch.randint(0, cells + 1, (20, 3), generator=generator(seed + part))
        found = grid(vertex.to(dtype) / cells, torch.full((20,), part), name)[:, :2]
        x, y, z = vertex.unbind(-1)
        row = grid.offsets[part, 0].long() + x + (cells + 1) * (y + (cells + 1) * z)
        assert spec.dense[0]
        close(found, grid.table[row].detach(), 2e-6)
    with torch.no_grad():
        grid.table.fill_(1.0)
    part = torch.randint(0, 3, (40,), generator=generator(seed))
    ones = grid(3 * cube(seed, 40, dtype) - 1, part, name)
    close(ones, torch.ones_like(ones), 3 * bound)


@FEW
@given(seeds, backends)
def test_features_are_linear_in_the_table_and_parts_are_apart(seed: int, backend: tuple) -> None:
    name, dtype, bound = backend
    grid, points = grid_of([0, 1, 2], dtype), cube(seed, 40, dtype)
    part = torch.randint(0, 3, (40,), generator=generator(seed))
    before = grid(points, part, name).detach()
    with torch.no_grad():
        grid.table.mul_(-2.5)
        close(grid(points, part, name), -2.5 * before, 20 * bound)
        first = int(grid.offsets[1, 0])
        grid.table[:first] = torch.nan  # part 0
        others = part > 0
        close(grid(points[others], part[others], name), -2.5 * before[others], 20 * bound)


@FEW
@given(seeds, backends)
def test_points_outside_see_the_border(seed: int, backend: tuple) -> None:
    name, dtype, _ = backend
    grid, points = grid_of([0, 1, 2], dtype), 3 * cube(seed, 40, dtype) - 1
    part = torch.randint(0, 3, (40,), generator=generator(seed))
    close(grid(points, part, name), grid(points.clamp(0, 1), part, name), 0)


# --- networks, unions, memories -------------------------------------------------------------------


@FEW
@given(seeds, st.permutations([0, 1, 2]))
def test_networks_of_parts_are_apart(seed: int, order: list[int]) -> None:
    counts = torch.randint(0, 6, (3,), generator=generator(seed)).tolist()
    one, other = PartMLP(3, (5, 8, 2)).double(), PartMLP(3, (5, 8, 2)).double()
    with torch.no_grad():
        for own, theirs in zip(one.parameters(), other.parameters(), strict=True):
            theirs.copy_(own[order])
    rows = torch.randn(sum(counts), 5, generator=generator(seed), dtype=torch.float64)
    pieces = rows.split(counts)
    outs = one(rows, counts).split(counts)
    mixed = other(torch.cat([pieces[k] for k in order]), [counts[k] for k in order])
    close(mixed, torch.cat([outs[k] for k in order]), 1e-12)
    turned = [piece.flip(0) for piece in pieces]
    close(one(torch.cat(turned), counts), torch.cat([out.flip(0) for out in outs]), 1e-12)


@FEW
@given(seeds, st.permutations([0, 1, 2]))
def test_the_union_is_the_densest_whatever_its_order(seed: int, order: list[int]) -> None:
    g = generator(seed)
    here = torch.rand(3, 12, generator=g) < 0.6
    part, sample = here.nonzero().unbind(1)
    sigma = torch.rand(len(part), generator=g)
    out = union_by_density(sigma, sample, part, 12, 3)
    table = torch.zeros(3, 12).index_put((part, sample), sigma)
    close(out.sigma, table.amax(0), 0)
    # parts renamed, samples renamed
    place, names = torch.tensor(order).argsort(), shuffled(seed, 12)
    rows = place[part].argsort(stable=True)
    other = union_by_density(sigma[rows], names[sample][rows], place[part][rows], 12, 3)
    close(other.sigma[names], out.sigma, 0)
    assert set(rows[other.winner].tolist()) == set(out.winner.tolist())
    # a pair that loses to all changes nothing
    spare = sample.new_tensor([int(s) for s in range(12) if bool(here[:, s].any())])[:1]
    free = [k for k in range(3) if len(spare) and not bool(here[k, spare[0]])][-1:]
    if free and free[0] == 2:
        longer = union_by_density(
            torch.cat([sigma, sigma.new_zeros(1)]),
            torch.cat([sample, spare]),
            torch.cat([part, part.new_tensor(free)]),
            12,
            3,
        )
        close(longer.sigma, out.sigma, 0)
        assert torch.equal(longer.winner, out.winner)


@FEW
@given(seeds)
def test_memories_do_not_depend_on_the_order_of_points(seed: int) -> None:
    points, part = cube(seed, 60, torch.float32), torch.randint(0, 2, (60,), generator=generator(1))
    sigma = torch.rand(60, generator=generator(seed)) * 50
    memories = [PartOccupancy(torch.zeros(2, 3), torch.ones(2), cells=3) for _ in range(2)]
    for memory, order in zip(memories, (torch.arange(60), shuffled(seed, 60)), strict=True):
        cell = memory.cells_of(points, part)[order]
        memory.see(cell, sigma[order])
        memory.see(cell, 0.5 * sigma[order])
    assert torch.equal(memories[0].peak, memories[1].peak)
    assert torch.equal(memories[0].floor, memories[1].floor)


@FEW
@given(seeds)
def test_what_is_visible_depends_on_the_own_ray_alone(seed: int) -> None:
    rays = Packed(seed, torch.float64)
    wall = rays.sigma
    ray = torch.repeat_interleave(torch.arange(len(rays.counts)), rays.counts)
    whole = visible_samples(wall, rays.starts(), ray, 30.0)
    for r in range(len(rays.counts)):
        own = wall[ray == r]
        start = torch.tensor([0, len(own)])
        alone = visible_samples(own, start, torch.zeros(len(own), dtype=torch.long), 30.0)
        assert torch.equal(alone, whole[ray == r])
        before = own.cumsum(0) - own
        assert torch.equal(alone, before < 30.0)


@FEW
@given(seeds, st.sampled_from([0.01, 0.05]))
def test_residuals_are_bounded_and_parts_are_apart(seed: int, scale: float) -> None:
    field = ResidualField(2, scale, GridSpec(3, 2, 8, 2, 1.5), 8)
    with torch.no_grad():
        for p in field.parameters():
            p.copy_(3 * torch.randn(p.shape, generator=generator(seed)))
    uvt, part = cube(seed, 20, torch.float32), torch.tensor([0] * 8 + [1] * 12)
    out = field(uvt, part, (8, 12))
    assert float(out.detach().abs().max()) <= scale * (1 + 1e-6)
    alone = field(uvt[8:], part[8:], (0, 12))
    close(alone, out[8:], 1e-7)


@FEW
@given(seeds, st.sampled_from(["torch", "warp"]))
def test_rows_of_a_table_are_optimised_apart(seed: int, backend: str) -> None:
    order, g = shuffled(seed, 24), generator(seed)
    start = torch.randn(24, 2, generator=g)
    found = []
    for rows in (torch.arange(24), order):
        table = start[rows].clone()
        moments = RowMoments(torch.zeros(24, 2), torch.zeros(24, 2), torch.zeros(24).int())
        grads = generator(seed + 1)
        for now in range(1, 5):
            grad = torch.randn(24, 2, generator=grads) * (torch.rand(24, 1, generator=grads) < 0.5)
            grad = grad[rows].contiguous()
            row_adam(table, grad, moments, now, 0.1, AdamRule(), backend)
        found.append(table)
    close(found[1], found[0][order], 1e-6)


@settings(max_examples=5)
@given(seeds)
def test_the_distance_prior_moves_with_its_body(seed: int) -> None:
    ball, triangles = oracles.sphere(0.3, 12, 16)
    verts, faces = torch.from_numpy(ball).float(), torch.from_numpy(triangles)
    shift = 2 * normal(seed, 3).float()
    points = 0.8 * cube(seed, 200, torch.float32) - 0.4
    here = DistancePrior(verts, faces, 0.1, 0.02)
    there = DistancePrior(verts + shift, faces, 0.1, 0.02)
    close(there(points + shift), here(points), 1e-3)  # a twentieth of a cell
    hit = SurfaceIndex(verts, faces).query(points)
    exact = signed_distance(points, hit, vertex_normals(verts, faces), faces).clamp(-0.1, 0.1)
    assert float((here(points) - exact).abs().mean()) <= 2e-3
    assert float((here(points) - exact).mean().abs()) <= 1e-3, "a grid off by half a cell"
