"""Clean parts: graph cuts against enumeration, islands, symmetry, order of vertices."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sample_meshes import grid

from monopart.geometry.body import BodyModel
from monopart.geometry.errors import InputError
from monopart.geometry.mesh_graph import (
    MeshGraph,
    components,
    face_graph,
    mirror_faces,
    vertex_graph,
    weld_by_place,
)
from monopart.geometry.part_cleaning import (
    clean_face_labels,
    cut_energy,
    label_shares,
    remove_islands,
    smooth_labels,
    vertex_labels,
)
from monopart.geometry.parts import PartMap

PRESETS = ["three", "five", "six", "per_limb", "six+hands"]


def random_graph(seed: int, n: int, chance: float) -> MeshGraph:
    rng = np.random.default_rng(seed)
    pairs = np.array(list(itertools.combinations(range(n), 2)))
    edges = pairs[rng.random(len(pairs)) < chance]
    return MeshGraph(edges, rng.random(len(edges)) + 0.1, rng.random(n) + 0.1)


def pieces(labels: np.ndarray, graph: MeshGraph) -> list[set[int]]:
    """Connected pieces of equal labels, by walking."""
    left, found = set(range(len(labels))), []
    near: dict[int, set[int]] = {n: set() for n in left}
    for a, b in graph.edges.tolist():
        near[a].add(b)
        near[b].add(a)
    while left:
        todo, piece = [left.pop()], set()
        while todo:
            node = todo.pop()
            piece.add(node)
            new = {m for m in near[node] if m in left and labels[m] == labels[node]}
            left -= new
            todo += new
        found.append(piece)
    return found


def no_islands(labels: np.ndarray, graph: MeshGraph) -> bool:
    whole = components(graph.num_nodes, graph.edges)
    named = [(whole[min(p)], labels[min(p)]) for p in pieces(labels, graph)]
    return len(named) == len(set(named))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.0, 1.0))
def test_two_labels_are_cut_at_the_minimum(seed: int, chance: float) -> None:
    graph = random_graph(seed, 8, chance)
    costs = np.random.default_rng(seed + 1).random((8, 2))
    best = min(
        cut_energy(np.array(labels), costs, graph) for labels in itertools.product((0, 1), repeat=8)
    )
    assert cut_energy(smooth_labels(costs, graph), costs, graph) <= best + 1e-6


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_three_labels_stay_within_twice_the_minimum(seed: int) -> None:
    graph = random_graph(seed, 6, 0.6)
    costs = np.random.default_rng(seed + 1).random((6, 3))
    every = (np.array(labels) for labels in itertools.product((0, 1, 2), repeat=6))
    best = min(cut_energy(labels, costs, graph) for labels in every)
    found = cut_energy(smooth_labels(costs, graph), costs, graph)
    assert best - 1e-9 <= found <= 2 * best
    assert found <= cut_energy(costs.argmin(1), costs, graph) + 1e-12


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.05, 0.6), st.integers(1, 4))
def test_islands_go_and_the_largest_piece_stays(seed: int, chance: float, count: int) -> None:
    graph = random_graph(seed, 14, chance)
    labels = np.random.default_rng(seed + 2).integers(0, count, 14)
    clean = remove_islands(labels, graph)
    assert no_islands(clean, graph)
    assert np.array_equal(remove_islands(clean, graph), clean)
    whole = components(14, graph.edges)
    largest: dict[tuple[int, int], float] = {}
    for piece in pieces(labels, graph):
        key = (int(whole[min(piece)]), int(labels[min(piece)]))
        largest[key] = max(largest.get(key, 0.0), graph.mass[sorted(piece)].sum())
    for piece in pieces(labels, graph):
        key = (int(whole[min(piece)]), int(labels[min(piece)]))
        if graph.mass[sorted(piece)].sum() == largest[key]:
            assert (clean[sorted(piece)] == labels[min(piece)]).all()


def test_a_ragged_border_becomes_straight() -> None:
    verts, faces = grid(20)
    side = (verts[faces].mean(1)[:, 1] > 0).astype(int)
    noise = np.random.default_rng(0).random(len(faces)) < 0.3
    near = abs(verts[faces].mean(1)[:, 1]) < 0.15
    ragged = np.where(noise & near, 1 - side, side)
    graph = face_graph(verts, faces)
    clean = clean_face_labels(np.eye(2)[ragged], verts, faces, smoothing=0.3, plane=None)

    def border(labels: np.ndarray) -> float:
        return cut_energy(labels, np.zeros((len(faces), 2)), graph)

    assert border(ragged) > 5
    assert border(clean) <= 2.0 + 1e-9  # the width of the square
    rough = clean_face_labels(np.eye(2)[ragged], verts, faces, smoothing=0.0, plane=None)
    assert no_islands(rough, graph) and border(rough) > border(clean)


@pytest.mark.parametrize("name", PRESETS)
def test_parts_of_the_body_are_whole_and_the_same_left_and_right(name: str) -> None:
    body = BodyModel.default()
    parts = PartMap.preset(name)
    face, vertex = parts.clean(body.weights, body.v_template, body.faces, body.tree.parents)
    verts, faces = body.v_template.double().numpy(), body.faces.numpy()
    sides = {"left": "right", "right": "left"}
    twin = [
        parts.names.index(
            "_".join([sides.get(n.split("_")[0], n.split("_")[0]), *n.split("_")[1:]])
        )
        for n in parts.names
    ]
    mirror = mirror_faces(verts, faces)
    known = mirror >= 0
    assert known.mean() > 0.97
    # faces that cross the plane of symmetry are their own mirror images
    off = known & (mirror != np.arange(len(faces)))
    assert np.array_equal(np.array(twin)[face[off].numpy()], face[mirror[off]].numpy())
    pairs = {"legs": 2, "arms": 2}
    for labels, graph in ((face, face_graph(verts, faces)), (vertex, vertex_graph(verts, faces))):
        found = [parts.names[int(labels[min(p)])] for p in pieces(labels.numpy(), graph)]
        assert sorted(found) == sorted(n for n in parts.names for _ in range(pairs.get(n, 1)))
    raw = parts.face_parts(body.weights, body.faces)
    assert 0.97 < (raw == face).double().mean() < 1
    assert face.dtype == vertex.dtype == torch.int64 and vertex.shape == (body.num_verts,)


def test_borders_of_the_body_become_shorter() -> None:
    body = BodyModel.default()
    parts = PartMap.default()
    graph = face_graph(body.v_template.double().numpy(), body.faces.numpy())
    face, _ = parts.clean(body.weights, body.v_template, body.faces, body.tree.parents)
    raw = parts.face_parts(body.weights, body.faces)
    none = np.zeros((len(raw), 5))
    assert cut_energy(face.numpy(), none, graph) < 0.75 * cut_energy(raw.numpy(), none, graph)


def test_another_order_of_vertices_and_faces_gives_the_same_parts() -> None:
    body = BodyModel.default()
    rng = np.random.default_rng(0)
    new = torch.from_numpy(rng.permutation(body.num_verts))  # old vertex of each new one
    order = torch.from_numpy(rng.permutation(len(body.faces)))
    number = torch.empty_like(new)
    number[new] = torch.arange(len(new))
    args = body.tree.parents
    face, vertex = PartMap.default().clean(body.weights, body.v_template, body.faces, args)
    other, moved = PartMap.default().clean(
        body.weights[new], body.v_template[new], number[body.faces[order]], args
    )
    assert torch.equal(other, face[order])
    assert torch.equal(moved, vertex[new])


def test_cutting_the_mesh_along_seams_changes_nothing() -> None:
    body = BodyModel.default()
    verts, faces = body.v_template.double().numpy(), body.faces.numpy()
    shares = label_shares(body.weights.double().numpy(), PartMap.default().joint_part, 5)
    whole = clean_face_labels(shares[faces].mean(1), verts, faces)
    apart = np.arange(3 * len(faces)).reshape(-1, 3)
    loose = clean_face_labels(shares[faces].mean(1), verts[faces].reshape(-1, 3), apart)
    assert np.array_equal(whole, loose)
    twins = vertex_labels(whole, verts[faces].reshape(-1, 3), apart, 5)
    place = weld_by_place(verts[faces].reshape(-1, 3))
    assert np.array_equal(twins[place], twins)  # corners at one place have one part


def test_graphs_by_hand() -> None:
    verts, faces = grid(2)
    graph = face_graph(verts, faces)
    assert len(graph.edges) == 8 and graph.mass.tolist() == [0.5] * 8
    assert sorted(set(graph.weights.round(6))) == [1.0, round(2**0.5, 6)]
    assert np.isclose(vertex_graph(verts, faces).mass.sum(), 4.0)
    assert (mirror_faces(verts, faces) >= 0).all()
    assert (mirror_faces(verts + np.array([0.5, 0, 0]), faces, plane=0.5) >= 0).all()
    assert (mirror_faces(verts + np.array([7.0, 0, 0]), faces) < 0).all()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.0, 0.4))
def test_components_are_what_walking_finds(seed: int, chance: float) -> None:
    graph = random_graph(seed, 20, chance)
    name = components(20, graph.edges)
    for piece in pieces(np.zeros(20, int), graph):
        assert {int(name[n]) for n in piece} == {min(piece)}


def test_empty_single_and_wrong_input() -> None:
    none, one = np.zeros((0, 3), np.int64), np.array([[0, 1, 2]])
    assert clean_face_labels(np.zeros((0, 2)), np.eye(3), none).shape == (0,)
    assert clean_face_labels(np.array([[0.1, 0.9]]), np.eye(3), one).tolist() == [1]
    assert components(0, np.zeros((0, 2), np.int64)).shape == (0,)
    with pytest.raises(InputError, match="at least one triangle"):
        vertex_labels(np.zeros(0, np.int64), np.eye(3), none, 1)
    with pytest.raises(InputError, match="finite"):
        face_graph(np.full((3, 3), np.nan), one)
    with pytest.raises(InputError, match=r"0\.\.2"):
        face_graph(np.eye(3), np.array([[0, 1, 7]]))
    with pytest.raises(InputError, match="weights"):
        clean_face_labels(np.array([[np.nan, 1.0]]), np.eye(3), one)
    with pytest.raises(InputError, match="costs"):
        smooth_labels(
            np.array([[-1.0]]), MeshGraph(np.zeros((0, 2), np.int64), np.ones(0), np.ones(1))
        )
    with pytest.raises(InputError, match="2 joints"):
        label_shares(np.ones((1, 3)), (0, 1), 2)
    lonely = vertex_labels(np.array([1]), np.vstack([np.eye(3), [[9.0, 9, 9]]]), one, 2)
    assert lonely.tolist() == [1, 1, 1, 1]
