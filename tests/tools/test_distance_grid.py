"""Grids of distances: the bounds hold everywhere, and are worth having."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sample_meshes import changed, cube, joined, sample_meshes, shifted, sphere

from monopart.geometry.errors import InputError
from monopart.geometry.weight_transfer import closest_faces
from monopart.tools.distance_grid import DistanceGrid, distance_grid


def box_distance(points: np.ndarray) -> np.ndarray:
    """Signed distance to the cube of edge 1 about 0, in closed form."""
    over = np.abs(points) - 0.5
    return np.linalg.norm(np.maximum(over, 0), axis=1) + np.minimum(over.max(1), 0)


@settings(max_examples=25)
@given(st.integers(0, 10**6), st.sampled_from([0.07, 0.21, 0.5, 1.7]), st.booleans())
def test_the_true_distance_is_within_the_bounds(seed: int, spacing: float, signed: bool) -> None:
    grid = distance_grid(cube(), spacing, margin=0.3, signed=signed)
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.6, 1.6, size=(400, 3))  # some are outside the grid
    true = box_distance(points) if signed else np.abs(box_distance(points))
    value, lower, upper = grid.query(points)
    assert (lower <= true).all() and (true <= upper).all()
    assert (lower <= value).all() and (value <= upper).all()
    end = grid.origin + spacing * (np.array(grid.values.shape) - 1)
    inside = ((points >= grid.origin) & (points <= end)).all(1)
    assert inside.any()
    assert np.abs(value - true)[inside].max() <= grid.bound
    assert (upper - lower)[inside].max() <= 2 * grid.bound + 1e-12


def test_the_bound_is_reached_within_a_factor() -> None:
    """A point in the middle of a cell is off by √3/2 of the spacing: the bound is not idle."""
    spike = np.array([[0.0, 0, 0], [1e-9, 0, 0], [0, 1e-9, 0]])
    mesh = changed(cube(), verts=spike, faces=np.array([[0, 1, 2]]))
    grid = distance_grid(mesh, 1.0, margin=0.5, signed=False)
    value, lower, _ = grid.query(np.array([[0.0, 0.0, 0.0]]))
    assert value[0] == pytest.approx(np.sqrt(3) / 2, rel=1e-5)
    assert value[0] <= grid.bound and lower[0] == 0
    assert value[0] > 0.99 * grid.bound


def test_nodes_are_exact_and_hollow_bodies_have_an_inside() -> None:
    inner = changed(sphere(radius=0.5), faces=sphere().faces[:, ::-1])
    hollow = joined(sphere(), inner)
    grid = distance_grid(hollow, 0.13)
    nodes = grid.origin + 0.13 * np.stack(np.indices(grid.values.shape), -1).reshape(-1, 3)
    value = grid.query(nodes)[0]
    true = closest_faces(nodes, hollow.verts, hollow.faces)[2]
    assert np.abs(np.abs(value) - true).max() < 1e-6
    far = np.linalg.norm(nodes, axis=1)
    shell = (far > 0.52) & (far < 0.9)
    assert (value[shell] < 0).all()
    assert (value[(far < 0.4) | (far > 1.01)] > 0).all()
    turned = distance_grid(changed(sphere(), faces=sphere().faces[:, ::-1]), 0.2)
    assert np.array_equal(turned.values, distance_grid(sphere(), 0.2).values)


def test_progress_files_and_damage(tmp_path) -> None:
    seen: list[tuple[int, int]] = []
    grid = distance_grid(shifted(sphere(), 5, 0, 0), 0.04, progress=lambda *x: seen.append(x))
    assert seen[-1][0] == seen[-1][1] == grid.values.size and len(seen) > 1
    path = grid.save(tmp_path / "grid.npz")
    back = DistanceGrid.load(path)
    assert np.array_equal(back.values, grid.values) and back.signed and back.bound == grid.bound
    points = np.random.default_rng(0).normal(size=(50, 3))
    assert np.array_equal(back.query(points)[1], grid.query(points)[1])
    assert [p.name for p in tmp_path.iterdir()] == ["grid.npz"]
    path.write_bytes(path.read_bytes()[:500])
    for bad in (path, tmp_path / "none.npz"):
        with pytest.raises(InputError, match="expected"):
            DistanceGrid.load(bad)
    np.savez(path, values=np.zeros(3), origin=np.zeros(3), spacing=1.0, signed=True)
    with pytest.raises(InputError, match="float32"):
        DistanceGrid.load(path)
    assert grid.query(points[:0])[0].shape == (0,)


def test_wrong_requests_are_refused() -> None:
    with pytest.raises(InputError, match="spacing"):
        distance_grid(cube(), 0.0)
    with pytest.raises(InputError, match="spacing"):
        distance_grid(cube(), np.nan)
    with pytest.raises(InputError, match="nodes"):
        distance_grid(cube(), 1e-5)
    with pytest.raises(InputError, match="closed"):
        distance_grid(sample_meshes()["hole"], 0.1)
    assert distance_grid(sample_meshes()["hole"], 0.1, signed=False).values.min() >= 0


@pytest.mark.parametrize("name", list(sample_meshes()))
def test_any_mesh_gives_a_grid_or_a_clear_error(name: str) -> None:
    mesh = sample_meshes()[name]
    for signed in (True, False):
        try:
            grid = distance_grid(mesh, 0.5, signed=signed)
        except InputError as error:
            assert "expected" in str(error) and "found" in str(error)
            continue
        assert np.isfinite(grid.values).all() and min(grid.values.shape) >= 1
