"""The gridded signed distance against spheres and the exact surface."""

import oracles
import pytest
import torch

from monopart.fields.distance_prior import DistancePrior
from monopart.geometry.body import BodyModel
from monopart.geometry.errors import InputError
from monopart.geometry.surface import SurfaceIndex, signed_distance, vertex_normals

CELL = 0.02


def sphere(radius: float) -> tuple[torch.Tensor, torch.Tensor]:
    verts, faces = oracles.sphere(radius, 24, 48)
    return torch.from_numpy(verts).float(), torch.from_numpy(faces)


def shell_points(count: int, low: float, high: float) -> torch.Tensor:
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    return directions * (low + (high - low) * torch.rand(count, 1))


def test_a_sphere_within_a_cell() -> None:
    prior = DistancePrior(*sphere(0.3), reach=0.12, cell=CELL)
    points = shell_points(2000, 0.2, 0.4)
    exact = points.norm(dim=-1) - 0.3
    found = prior(points)
    assert (found - exact).abs().max() < CELL / 4
    assert bool(((found < 0) == (exact < 0))[exact.abs() > CELL / 4].all())


@pytest.mark.parametrize("radius", [0.1, 0.3])  # 0.3: the middle is deeper than the reach
def test_distances_are_clamped_with_the_right_sign(radius: float) -> None:
    prior = DistancePrior(*sphere(radius), reach=0.06, cell=CELL)
    deep = shell_points(300, 0.0, radius - 0.06 - 2 * CELL)
    torch.testing.assert_close(prior(deep), torch.full((300,), -0.06))
    far = shell_points(300, radius + 0.06 + 2 * CELL, 10.0)
    torch.testing.assert_close(prior(far), torch.full((300,), 0.06))


def test_the_gradient_points_away_from_the_surface() -> None:
    prior = DistancePrior(*sphere(0.3), reach=0.12, cell=CELL)
    points = shell_points(500, 0.25, 0.35).requires_grad_()
    (gradient,) = torch.autograd.grad(prior(points).sum(), points)
    radial = torch.nn.functional.normalize(points.detach(), dim=-1)
    assert (gradient - radial).norm(dim=-1).max() < 0.15


def test_the_body_at_the_nodes() -> None:
    """At its own nodes the grid holds the signed distance, clamped."""
    body = BodyModel.default()
    prior = DistancePrior(body.v_template, body.faces, reach=0.05, cell=0.05)
    shape = prior.values.shape[2:]
    index = torch.stack([torch.randint(n, (400,)) for n in shape], -1)
    nodes = prior.lo + 0.05 * index.flip(-1)
    expected = SurfaceIndex(body.v_template, body.faces).query(nodes)
    normals = vertex_normals(body.v_template, body.faces)
    signed = signed_distance(nodes, expected, normals, body.faces).clamp(-0.05, 0.05)
    torch.testing.assert_close(prior(nodes), signed, atol=1e-5, rtol=0)
    assert int((signed < 0).sum()) > 5


def test_the_grid_moves_with_the_module_but_is_not_saved() -> None:
    prior = DistancePrior(*sphere(0.2), reach=0.1, cell=0.05)
    assert not prior.state_dict() and not list(prior.parameters())
    assert prior(torch.zeros(0, 3)).shape == (0,)
    assert prior.double()(torch.zeros(1, 3, dtype=torch.float64)).item() == pytest.approx(-0.1)


@pytest.mark.parametrize(
    ("reach", "cell"), [(0.0, 0.1), (0.1, 0.0), (-1.0, 0.1), (float("nan"), 0.1), (0.1, 0.2)]
)
def test_bad_input(reach: float, cell: float) -> None:
    with pytest.raises(InputError, match="reach, cell"):
        DistancePrior(*sphere(0.2), reach=reach, cell=cell)


def test_kept_values_give_the_same_prior() -> None:
    verts, faces = sphere(0.2)
    built = DistancePrior(verts, faces, 0.1, 0.05)
    again = DistancePrior(verts, faces, 0.1, 0.05, built.values[0, 0])
    points = torch.randn(200, 3) * 0.3
    assert torch.equal(built(points), again(points))
    for wrong in (built.values[0, 0, 1:], built.values[0, 0].double()):
        with pytest.raises(InputError, match="values"):
            DistancePrior(verts, faces, 0.1, 0.05, wrong)
