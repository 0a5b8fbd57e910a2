"""Distances along surfaces, and overlapping bands."""

import math

import igl
import numpy as np
import pytest
from sample_meshes import grid

from monopart.geometry.body import BodyModel
from monopart.geometry.errors import InputError
from monopart.geometry.geodesics import part_bands, surface_distance
from monopart.geometry.parts import PartMap


def edge_distance(verts: np.ndarray, faces: np.ndarray, sources: list[int]) -> np.ndarray:
    """Along edges only (Dijkstra by plain relaxation): never shorter than over faces."""
    distance = np.full(len(verts), math.inf)
    distance[sources] = 0
    edges = {tuple(sorted((int(f[k]), int(f[k - 1])))) for f in faces for k in range(3)}
    for _ in range(len(verts)):
        before = distance.copy()
        for a, b in edges:
            length = float(np.linalg.norm(verts[a] - verts[b]))
            distance[a] = min(distance[a], distance[b] + length)
            distance[b] = min(distance[b], distance[a] + length)
        if np.array_equal(before, distance):
            return distance
    return distance


def test_a_straight_source_is_exact_on_a_plane() -> None:
    verts, faces = grid(8)
    sources = np.flatnonzero(verts[:, 0] == -1)
    assert np.allclose(surface_distance(verts, faces, sources), verts[:, 0] + 1, atol=1e-12)
    bent = verts.copy()  # rolled onto a cylinder, folded along rows of edges
    chord = 0.25 / (2 * math.sin(0.25 / 2))
    bent[:, 0], bent[:, 2] = chord * np.sin(verts[:, 0]), chord * np.cos(verts[:, 0])
    assert np.allclose(surface_distance(bent, faces, sources), verts[:, 0] + 1, atol=1e-12)


def test_a_point_source_lies_between_the_straight_way_and_the_edges() -> None:
    verts, faces = grid(6)
    source = 3 * 7 + 3
    found = surface_distance(verts, faces, np.array([source]))
    straight = np.linalg.norm(verts - verts[source], axis=1)
    assert (found >= straight - 1e-9).all()
    assert (found <= edge_distance(verts, faces, [source]) + 1e-9).all()
    finer, more = grid(24)
    fine = surface_distance(finer, more, np.array([12 * 25 + 12]))
    gap = np.abs(fine - np.linalg.norm(finer, axis=1)).max()
    assert gap < 0.6 * np.abs(found - straight).max()  # of first order in the edge length


def test_the_body_against_exact_windows() -> None:
    body = BodyModel.default()
    verts, faces = body.v_template.double().numpy(), body.faces.numpy()
    arm = np.unique(faces[PartMap.default().face_parts(body.weights, body.faces).numpy() == 3])
    none = np.zeros(0, np.int64)
    exact = igl.exact_geodesic(verts, faces, arm, none, np.arange(len(verts)), none)
    found = surface_distance(verts, faces, arm)
    near = (exact > 0) & (exact < 0.1)
    assert abs((found - exact)[near].mean()) < 1.5e-3
    assert np.abs(found - exact)[near].max() < 0.012
    assert np.isfinite(found).all() and (found[arm] == 0).all()


def test_limits_seams_and_unreachable_vertices() -> None:
    verts, faces = grid(4)
    source = np.array([0])
    whole = surface_distance(verts, faces, source)
    near = surface_distance(verts, faces, source, 1.0)
    assert np.array_equal(near[near < np.inf], whole[near < np.inf])
    assert (whole[near == np.inf] > 1.0 - 1e-9).all()
    apart = np.arange(3 * len(faces)).reshape(-1, 3)
    loose = surface_distance(verts[faces].reshape(-1, 3), apart, np.array([int(apart[0, 0])]))
    assert np.allclose(loose, whole[faces].reshape(-1))
    two = np.concatenate([verts, verts + np.array([9.0, 0, 0])])
    assert np.isinf(surface_distance(two, faces, source)[len(verts) :]).all()
    assert np.isinf(surface_distance(verts, faces, np.zeros(0, np.int64))).all()


@pytest.mark.parametrize("width", [0.0, 0.02, 0.05])
def test_bands_of_the_body(width: float) -> None:
    body = BodyModel.default()
    parts = PartMap.default()
    verts, faces = body.v_template.double().numpy(), body.faces.numpy()
    face, _ = parts.clean(body.weights, body.v_template, body.faces, body.tree.parents)
    labels = face.numpy()
    bands = part_bands(labels, verts, faces, 5, width)
    own = labels == np.arange(5)[:, None]
    assert (bands.faces[own]).all()
    assert (bands.faces.sum() > own.sum()) == (width > 0)
    assert np.allclose(bands.shares.sum(1), 1, atol=1e-12) and bands.shares.min() >= 0
    inside = np.isfinite(bands.distance)
    assert (bands.distance[inside] <= width).all()
    assert ((bands.shares > 0) <= inside.T).all()
    # no vertex of a band is farther from its part than the width, straight as the crow flies
    for part in range(5):
        reached = np.unique(faces[bands.faces[part]])
        gap = igl.point_mesh_squared_distance(verts[reached], verts, faces[own[part]])[0] ** 0.5
        assert gap.max() <= width + 1e-3
        assert gap.max() >= 0.7 * width


def test_bands_say_what_is_wrong() -> None:
    verts, faces = grid(2)
    labels = np.zeros(8, np.int64)
    with pytest.raises(InputError, match="width"):
        part_bands(labels, verts, faces, 1, -0.1)
    with pytest.raises(InputError, match="width"):
        part_bands(labels, verts, faces, 1, math.nan)
    with pytest.raises(InputError, match="labels"):
        part_bands(labels[:3], verts, faces, 1, 0.1)
    with pytest.raises(InputError, match="labels"):
        part_bands(labels + 1, verts, faces, 1, 0.1)
    empty = part_bands(labels[:0], verts, faces[:0], 2, 0.1)
    assert empty.shares.tolist() == [[0.5, 0.5]] * 9 and empty.faces.shape == (2, 0)
