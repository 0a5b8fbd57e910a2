"""Faces that cut each other and texture triangles that overlap, against linear programs."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sample_meshes import cube, grid, joined, sample_meshes, shifted, sphere, torus
from scipy.optimize import linprog

from monopart.tools.box_pairs import overlapping_boxes
from monopart.tools.intersections import self_intersections, uv_faults


def meet(one: np.ndarray, two: np.ndarray, free: list[bool]) -> bool:
    """Do triangles share a point with a part of the free corners of the first? A linear program."""
    dim = one.shape[1]
    equal = np.zeros((dim + 2, 6))
    equal[:dim, :3], equal[:dim, 3:] = one.T, -two.T
    equal[dim, :3] = equal[dim + 1, 3:] = 1
    target = np.r_[np.zeros(dim), 1, 1]
    cost = -np.r_[np.array(free, float), np.zeros(3)]
    found = linprog(cost, A_eq=equal, b_eq=target, bounds=(0, None), method="highs")
    if found.status == 2:  # infeasible: no common point
        return False
    assert found.status == 0
    return bool(-found.fun > 1e-7) or all(free)


def by_programs(verts: np.ndarray, faces: np.ndarray) -> list[list[int]]:
    pairs = []
    for i, j in itertools.combinations(range(len(faces)), 2):
        shared = [v in faces[j] for v in faces[i]]
        if all(shared):
            continue
        if meet(verts[faces[i]], verts[faces[j]], [not s for s in shared]):
            pairs.append([i, j])
    return pairs


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.sampled_from([2, 3, 6]), st.integers(4, 9))
def test_random_faces_on_a_lattice(seed: int, size: int, count: int) -> None:
    """Few lattice points make many touching, flat and folded pairs."""
    rng = np.random.default_rng(seed)
    every = np.array(list(itertools.product(range(size + 1), repeat=3)), float)
    verts = every[rng.permutation(len(every))[:count]]
    triples = np.array(list(itertools.combinations(range(count), 3)))
    a, b, c = np.moveaxis(verts[triples], 1, 0)
    triples = triples[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0]
    faces = triples[rng.permutation(len(triples))[:6]]
    assert self_intersections(verts, faces).tolist() == by_programs(verts, faces)


def test_closed_bodies_do_not_cut_themselves() -> None:
    for mesh in (cube(), sphere(), torus(), joined(sphere(), shifted(sphere(), 3.0, 0, 0))):
        turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
        for verts in (mesh.verts, mesh.verts @ turn, mesh.verts * 1e-200, mesh.verts * 1e200):
            assert self_intersections(verts, mesh.faces).shape == (0, 2)


def test_two_spheres_cut_along_a_circle() -> None:
    mesh = sample_meshes()["cutting"]
    pairs = self_intersections(mesh.verts, mesh.faces)
    assert pairs.tolist() == by_programs_between(mesh.verts, mesh.faces)
    assert len(pairs) > 50


def by_programs_between(verts: np.ndarray, faces: np.ndarray) -> list[list[int]]:
    half = len(faces) // 2
    corner = verts[faces]
    low, high = corner.min(1), corner.max(1)
    return [
        [i, j]
        for i, j in itertools.product(range(half), range(half, 2 * half))
        if (low[i] <= high[j]).all() and (low[j] <= high[i]).all()
        if meet(corner[i], corner[j], [True] * 3)
    ]


def test_the_order_of_vertices_and_faces_does_not_matter() -> None:
    mesh = sample_meshes()["cutting"]
    rng = np.random.default_rng(0)
    new, order = rng.permutation(mesh.num_verts), rng.permutation(mesh.num_faces)
    number = np.argsort(new)
    found = order[self_intersections(mesh.verts[new], number[mesh.faces[order]])]
    whole = self_intersections(mesh.verts, mesh.faces)
    assert {tuple(sorted(p)) for p in found.tolist()} == {tuple(p) for p in whole.tolist()}


@given(st.integers(0, 10**6), st.integers(0, 40), st.sampled_from([2, 3]))
def test_box_pairs_are_all_pairs(seed: int, count: int, dim: int) -> None:
    rng = np.random.default_rng(seed)
    low = rng.integers(0, 5, size=(count, dim)).astype(float)
    high = low + rng.integers(0, 3, size=(count, dim))
    found = [tuple(p) for pairs in overlapping_boxes(low, high) for p in pairs.tolist()]
    wanted = [
        (i, j)
        for i, j in itertools.combinations(range(count), 2)
        if (low[i] <= high[j]).all() and (low[j] <= high[i]).all()
    ]
    assert sorted(found) == wanted


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.sampled_from([2, 4]))
def test_uv_overlaps_on_a_lattice(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    uv = rng.integers(0, size + 1, size=(5, 3, 2)).astype(float)
    verts, faces = rng.normal(size=(15, 3)), np.arange(15).reshape(5, 3)
    found = uv_faults(uv, verts, faces)
    cross = (uv[:, 1, 0] - uv[:, 0, 0]) * (uv[:, 2, 1] - uv[:, 0, 1]) - (
        uv[:, 1, 1] - uv[:, 0, 1]
    ) * (uv[:, 2, 0] - uv[:, 0, 0])
    assert found.flipped.tolist() == np.flatnonzero(cross < 0).tolist()
    assert found.flat.tolist() == np.flatnonzero(cross == 0).tolist()
    # insides meet where triangles shrunk about their middles do
    inner = uv.mean(1, keepdims=True) + (1 - 1e-5) * (uv - uv.mean(1, keepdims=True))
    wanted = [
        [i, j]
        for i, j in itertools.combinations(np.flatnonzero(cross != 0).tolist(), 2)
        if meet(inner[i], inner[j], [True] * 3)
    ]
    assert found.overlaps.tolist() == wanted
    assert (found.depth > 0).all()


def test_a_flat_sheet_is_a_good_texture_until_a_corner_moves() -> None:
    verts, faces = grid(6)
    uv = verts[faces][..., :2]
    found = uv_faults(uv, verts, faces)
    assert not len(found.flipped) and not len(found.overlaps) and not len(found.flat)
    moved = verts[:, :2].copy()
    moved[24] += 0.6  # past its neighbours
    found = uv_faults(moved[faces], verts, faces)
    assert len(found.flipped) and len(found.overlaps)
    assert found.depth.max() == pytest.approx(0.2, rel=0.9)


def test_nothing_and_one() -> None:
    none = np.zeros((0, 3), np.int64)
    assert self_intersections(np.zeros((0, 3)), none).shape == (0, 2)
    assert self_intersections(np.eye(3), np.array([[0, 1, 2]])).shape == (0, 2)
    assert uv_faults(np.zeros((0, 3, 2)), np.eye(3), none).overlaps.shape == (0, 2)
