"""Stress of hash grids, encodings, networks, residuals and occupancy."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.func import functional_call

from monopart.fields.distance_prior import DistancePrior
from monopart.fields.frequency import FrequencyEncoding
from monopart.fields.hash_grid import PRIMES, GridSpec, HashGrid
from monopart.fields.irradiance import irradiance_basis
from monopart.fields.mlp import PartMLP
from monopart.fields.occupancy import PartOccupancy
from monopart.fields.residual import ResidualField

from .stability_cases import DOUBLE, HALVES, SINGLE, Backend, Family, Inputs, Stress, Way, kinds_of
from .stability_meshes import ball
from .stability_rotations import Make

# --- hash grids --------------------------------------------------------------------------------


def _grid(**changes: Any) -> HashGrid:
    given = {"levels": 6, "features": 2, "log2_size": 12, "base": 4, "growth": 1.8} | changes
    return HashGrid([GridSpec(**given)], torch.Generator().manual_seed(1))


def _in_cube(grid: HashGrid, kind: str) -> Make:
    """Points of the unit cube or next to it, and a table of numbers of size one."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        points = torch.rand(count, 3, generator=generator, dtype=DOUBLE)
        if kind == "borders":
            points = (points * 4).round() / 4
        elif kind == "corners":
            points = points.round()
        elif kind == "next to borders":
            points = (points * 4).round() / 4 + 1e-9 * (points - 0.5)
        elif kind == "outside":
            points = 20 * points - 10
        elif kind == "infinite":
            points = torch.where(points > 0.5, torch.inf, -torch.inf).double()
        elif kind == "1e-30":
            points = points * 1e-30
        table = torch.rand(grid.table.shape, generator=generator, dtype=DOUBLE) * 2 - 1
        return points, table

    return make


def exact_grid(grid: HashGrid, points: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Trilinear look-up by loops over levels and corners."""
    spec, out, first = grid.specs[0], [], 0
    points = np.clip(points, 0.0, 1.0)
    for resolution, size, dense in zip(spec.resolutions, spec.sizes, spec.dense, strict=True):
        place = points * resolution
        cell = np.minimum(np.floor(place).astype(np.int64), resolution - 1)
        part, total = place - cell, np.zeros((len(points), spec.features))
        for corner in np.ndindex(2, 2, 2):
            at = cell + np.array(corner)
            share = np.where(np.array(corner) == 1, part, 1 - part).prod(1)
            if dense:
                row = at[:, 0] + (resolution + 1) * (at[:, 1] + (resolution + 1) * at[:, 2])
            else:
                mixed = [at[:, a] * PRIMES[a] for a in range(3)]
                row = (mixed[0] ^ mixed[1] ^ mixed[2]) % size
            total += share[:, None] * table[first + row]
        out.append(total)
        first += size
    return np.concatenate(out, 1)


def _grid_way(backend: Backend) -> Way:
    def run(grid: HashGrid, points: Tensor, table: Tensor) -> Tensor:
        return functional_call(grid, {"table": table}, (points, None, backend))

    kinds = kinds_of(backend)
    return Way(f"monopart {backend}", run, True, kinds)


def _grids() -> Stress:
    usual = _grid()
    # weights of corners far from a point are small differences: their gradients lose digits
    families = [
        Family(k, _in_cube(usual, k), extra=usual, smooth=k == "inside", step=1e-9)
        for k in ("inside", "borders", "next to borders", "corners", "outside", "infinite", "1e-30")
    ]
    for name, grid in (
        ("tables of 8 rows", _grid(log2_size=3)),
        *(("one cell", _grid(levels=1, base=1)), ("one feature", _grid(features=1))),
        ("65536 cells", _grid(levels=3, base=64, growth=32.0)),
    ):
        # in float32 a place on 65536 cells has 8 bits of its cell left: the slope is a neighbour's
        smooth = name != "65536 cells"
        made = _in_cube(grid, "inside")
        families.append(Family(name, made, extra=grid, step=1e-10, smooth=smooth))
    return Stress(
        name="hash_grid",
        title="hash grid",
        domain="any finite or infinite point: outside [0, 1] it is clamped, with no gradient on "
        "that axis; the gradient in the points jumps at cell borders",
        error="largest feature times the cells of the finest level: the slope of the look-up",
        families=tuple(families),
        ways=(_grid_way("torch"), _grid_way("warp")),
        exact=exact_grid,
        scale=lambda grid, exact, points, table: float(max(grid.specs[0].resolutions)),
        wrt=(0, 1),
    )


# --- encodings and networks --------------------------------------------------------------------


def _normal(size: float, width: int) -> Make:
    return lambda g, n: (size * torch.randn(n, width, generator=g, dtype=DOUBLE),)


def exact_frequency(encoding: FrequencyEncoding, x: np.ndarray) -> np.ndarray:
    """Raw, sines, cosines."""
    angles = (x[..., None] * 2.0 ** np.arange(encoding.octaves)).reshape(len(x), -1)
    return np.concatenate((x, np.sin(angles), np.cos(angles)), 1)


def _frequency() -> Stress:
    families = [
        Family(
            f"|x| {size:g}, {octaves} octaves",
            _normal(size, 3),
            extra=FrequencyEncoding(3, octaves),
            step=step,
            halves=size < 1e3,
        )
        for size, octaves, step in ((0.0, 4, 1e-6), (1.0, 4, 1e-6), (1.0, 12, 1e-8), (1e4, 4, 1e-6))
    ]
    return Stress(
        name="frequency",
        title="frequency encoding",
        domain="inputs whose octaves stay finite (in float16 below 65504); octaves are exact, so "
        "that only sine and cosine round",
        error="1, and |x| where it is larger",
        families=tuple(families),
        ways=(Way("monopart", lambda e, x: e(x), True, (SINGLE, DOUBLE, *HALVES)),),
        exact=exact_frequency,
        scale=lambda e, exact, x: np.maximum(1.0, np.abs(x).max(1)),
    )


@dataclasses.dataclass(frozen=True)
class Nets:
    """One module in both precisions."""

    single: Any
    double: Any

    @classmethod
    def of(cls, make: Callable[[], torch.nn.Module]) -> "Nets":
        """A module with numbers of size one, in float32 and the same ones in float64."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(3)
            single, double = make(), make().double()
            for values in single.parameters():
                torch.nn.init.normal_(values, std=values.shape[-1] ** -0.5)
        double.load_state_dict(single.state_dict())
        return cls(single, double)

    def like(self, ref: Tensor) -> Any:
        """The module in the precision of a tensor."""
        return self.double if ref.dtype == DOUBLE else self.single


def exact_layers(mlp: Any, x: np.ndarray) -> np.ndarray:
    """Layers by matrix products in float64."""
    last = len(mlp.weights) - 1
    for i, (weight, bias) in enumerate(zip(mlp.weights, mlp.biases, strict=True)):
        x = x @ weight[0].detach().double().numpy().T + bias[0].detach().double().numpy()
        x = np.maximum(x, 0.0) if i < last else x
    return x


def _half_products(nets: Nets, x: Tensor) -> Tensor:
    """The products in float16, as a fast renderer takes them."""
    nets.single.compute = torch.float16
    try:
        return nets.single(x)
    finally:
        nets.single.compute = None


def _networks() -> Stress:
    nets = Nets.of(lambda: PartMLP(1, (32, 64, 64, 16)))
    families = [
        Family(f"|x| {s:g}", _normal(s, 32), extra=nets, step=1e-7 * max(s, 1e-3), smooth=s < 1e20)
        for s in (0.0, 1e-30, 1.0, 1e3, 1e30)
    ]
    half = Way(
        "monopart, float16",
        _half_products,
        True,
        (SINGLE,),
        serves=lambda family: family.name != "|x| 1e+30",
        limit=2e-3,
        differentiable=False,
    )
    return Stress(
        name="mlp",
        title="networks",
        domain="inputs below 1e30; with products in float16 below 1e4",
        error="largest entry of result and inputs, at least 1",
        families=tuple(families),
        ways=(Way("monopart", lambda nets, x: nets.like(x)(x), True), half),
        exact=lambda nets, x: exact_layers(nets.double, x),
        scale=lambda nets, exact, x: np.maximum(np.abs(exact).max(1), max(1.0, np.abs(x).max())),
    )


def _coordinates(kind: str) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        x = torch.rand(count, 3, generator=generator, dtype=DOUBLE)
        if kind == "0 and 1":
            x = x.round()
        elif kind == "outside":
            x = 6 * x - 3
        elif kind == "1e6":
            x = 1e6 * x
        return (x,)

    return make


def _residual() -> Stress:
    def run(nets: Nets, x: Tensor) -> Tensor:
        return nets.like(x)(x, torch.zeros(len(x), dtype=torch.long), (len(x),))

    def exact(nets: Nets, x: np.ndarray) -> np.ndarray:
        field = nets.double
        encoded = exact_grid(field.grid, x, field.grid.table.detach().numpy())
        return field.scale * np.tanh(exact_layers(field.mlp, np.concatenate((encoded, x), 1)))

    nets = Nets.of(lambda: ResidualField(1))
    families = [
        Family(k, _coordinates(k), extra=nets, smooth=k == "inside", step=1e-8)
        for k in ("inside", "0 and 1", "outside", "1e6")
    ]
    return Stress(
        name="residual",
        title="residual field",
        domain="any finite coordinates; each component stays within the scale",
        error="1 m; the largest offset is 5 cm",
        families=tuple(families),
        ways=(Way("monopart", run, True),),
        exact=exact,
    )


# --- occupancy and distance prior --------------------------------------------------------------


def _around_cube(kind: str) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        points = torch.rand(count, 3, generator=generator, dtype=DOUBLE)
        if kind == "borders":
            points = (points * 16).round() / 16
        elif kind == "outside":
            points = 20 * points - 10
        elif kind == "1e20 m off":
            points = 1e20 * (points - 0.5).sign()
        elif kind == "infinite":
            points = torch.where(points > 0.5, torch.inf, -torch.inf).double()
        return (points,)

    return make


def _occupancy() -> Stress:
    """How far a point, moved into the cube, is from the cell that is said to hold it."""
    cells = 16

    def run(extra: None, points: Tensor) -> Tensor:
        occupancy = PartOccupancy(torch.zeros(1, 3), torch.ones(1), cells)
        cell = occupancy.cells_of(points, torch.zeros(len(points), dtype=torch.long))
        x, y, z = cell % cells, cell // cells % cells, cell // cells**2
        return (torch.stack((x, y, z), 1).double() + 0.5) / cells

    def off(middle: np.ndarray, place: np.ndarray) -> np.ndarray:
        return np.maximum(np.abs(middle - place).max(1) - 0.5 / cells, 0.0)

    kinds = ("inside", "borders", "outside", "1e20 m off", "infinite")
    return Stress(
        name="occupancy",
        title="occupancy cells (distance to the cell named)",
        domain="any point that is not NaN; one outside belongs to the nearest cell",
        error="1, the edge of the cube",
        families=tuple(Family(k, _around_cube(k)) for k in kinds),
        ways=(Way("monopart", run, True, differentiable=False),),
        exact=lambda extra, points: np.clip(points, 0.0, 1.0),
        off=off,
        wrt=(),
    )


def exact_irradiance(extra: None, n: np.ndarray) -> np.ndarray:
    """The harmonics as quadratic forms."""
    forms = np.zeros((5, 3, 3))
    forms[0, 0, 1] = forms[1, 1, 2] = forms[2, 2, 0] = 1
    forms[3], forms[4] = np.diag((1, -1, 0)), np.diag((-1, -1, 2))
    return np.concatenate((n, np.einsum("ni,fij,nj->nf", n, forms, n)), 1)


def _irradiance() -> Stress:
    return Stress(
        name="irradiance_basis",
        title="harmonics of a normal",
        domain="any vector whose square is finite",
        error="1, and |n|² where it is larger",
        families=tuple(
            Family(f"|n| {size:g}", _normal(size, 3), step=1e-6 * max(size, 1.0))
            for size in (0.0, 1e-20, 1.0, 1e9)
        ),
        ways=(Way("monopart", lambda e, n: irradiance_basis(n), True, (SINGLE, DOUBLE)),),
        exact=exact_irradiance,
        scale=lambda e, exact, n: np.maximum(1.0, (n * n).sum(1)),
    )


def exact_prior(prior: DistancePrior, points: np.ndarray) -> np.ndarray:
    """Trilinear look-up of the nodes, clamped to the grid."""
    values = prior.values[0, 0].double().numpy()
    last = np.array(values.shape[::-1]) - 1
    place = (points - prior.lo.double().numpy()) / prior.extent.double().numpy() * last
    place = np.clip(place, 0, last)
    cell = np.minimum(np.floor(place).astype(np.int64), last - 1)
    part, out = place - cell, np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        x, y, z = (cell + np.array(corner)).T
        out += np.where(np.array(corner) == 1, part, 1 - part).prod(1) * values[z, y, x]
    return out


def _near_grid(prior: DistancePrior, kind: str) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        points = 1.2 * (torch.rand(count, 3, generator=generator, dtype=DOUBLE) - 0.5)
        if kind == "nodes":
            points = prior.lo.double() + 0.05 * ((points - prior.lo.double()) / 0.05).round()
        return (points * (1e6 if kind == "1e6 m off" else 1.0),)

    return make


def _prior() -> Stress:
    mesh = ball(0.5)
    prior = DistancePrior(mesh.verts.float(), mesh.faces, reach=0.1, cell=0.05)
    kinds = ("inside", "nodes", "1e6 m off")
    return Stress(
        name="distance_prior",
        title="distance prior",
        domain="any finite point; outside the grid the value of the border",
        error="1 m",
        families=tuple(Family(k, _near_grid(prior, k), extra=prior, smooth=False) for k in kinds),
        ways=(Way("monopart", lambda prior, p: prior(p), True, (SINGLE,)),),
        exact=exact_prior,
    )


def stresses() -> list[Stress]:
    """Operations on encodings, networks and grids."""
    from . import stability_fusion, stability_learned

    own = [_grids(), _frequency(), _irradiance(), _networks(), _residual(), _occupancy(), _prior()]
    return [*own, *stability_learned.stresses(), *stability_fusion.stresses()]
