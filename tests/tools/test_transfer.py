"""Attributes that are carried to another mesh of the same surface."""

import dataclasses

import numpy as np
from mesh_samples import cube, tube

from monopart.tools.bake_uv import uv_charts
from monopart.tools.meshio import Mesh
from monopart.tools.transfer import transferred


def test_the_same_mesh_gets_what_it_has():
    mesh = tube()
    back = transferred(mesh.verts, mesh.faces, mesh)
    np.testing.assert_allclose(back.weights, mesh.weights, atol=1e-9)
    np.testing.assert_allclose(back.colors, mesh.colors, atol=1e-9)
    np.testing.assert_allclose(back.corner_uv, mesh.corner_uv, atol=1e-7)
    assert back.skeleton is mesh.skeleton
    assert back.texture is mesh.texture


def test_subdivided_faces_stay_in_their_chart():
    """The tube is one chart, both sides of whose seam are the same edge: u = 0 and u = 1."""
    mesh = tube()
    middles = mesh.verts[mesh.faces].mean(axis=1)
    count = mesh.num_verts + np.arange(mesh.num_faces)
    a, b, c = mesh.faces.T
    faces = np.concatenate([np.stack([p, q, count], axis=1) for p, q in ((a, b), (b, c), (c, a))])
    new = transferred(np.concatenate([mesh.verts, middles]), faces, mesh)
    middle = mesh.corner_uv.mean(axis=1)
    for n, (p, q) in enumerate(((0, 1), (1, 2), (2, 0))):
        rows = new.corner_uv[n * mesh.num_faces : (n + 1) * mesh.num_faces]
        wanted = np.stack([mesh.corner_uv[:, p], mesh.corner_uv[:, q], middle], axis=1)
        np.testing.assert_allclose(rows, wanted, atol=1e-9)
    np.testing.assert_allclose(new.weights.sum(axis=1), 1)


def test_a_face_over_a_seam_is_not_stretched_over_the_chart():
    """Turned by half a side, faces run over the seam; their UVs stay together."""
    mesh = tube()
    turn = np.pi / 8
    matrix = np.array(
        [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    )
    axis = mesh.verts * [0, 1, 0] + mesh.verts[:, 1:2] * [0.1, 0, 0]
    new = transferred((mesh.verts - axis) @ matrix.T + axis, mesh.faces, mesh)
    span = np.ptp(new.corner_uv, axis=1)
    assert span[:, 0].max() < 0.3
    assert np.ptp(new.corner_uv[..., 0]) > 0.9


def test_two_charts_never_mix():
    mesh = cube()
    uv = np.random.default_rng(0).random((12, 3, 2)) * 0.1 + np.arange(12)[:, None, None]
    mesh = dataclasses.replace(mesh, corner_uv=uv)
    assert len(np.unique(uv_charts(mesh))) == 12
    rng = np.random.default_rng(1)
    jitter = mesh.verts + rng.normal(scale=1e-3, size=(8, 3))
    new = transferred(jitter, mesh.faces[:, [1, 2, 0]], mesh)
    assert (np.floor(new.corner_uv[..., 0]) == np.arange(12)[:, None]).all()
    np.testing.assert_allclose(new.corner_uv, uv[:, [1, 2, 0]], atol=1e-2)


def test_a_point_cloud_gives_nothing():
    new = transferred(np.eye(3), np.array([[0, 1, 2]]), Mesh(np.eye(3), np.zeros((0, 3))))
    assert new.weights is None and new.corner_uv is None
