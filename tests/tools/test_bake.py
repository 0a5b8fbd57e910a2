"""Baking: weights, texture coordinates, colours, textures; meshes that cannot be baked."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sample_meshes import changed, cube, grid, rigged, sample_meshes, sphere

from monopart.geometry.errors import InputError
from monopart.tools.bake import bake_colors, bake_texture, bake_uv, bake_weights, looked_up
from monopart.tools.bake_uv import uv_charts, uv_neighbours
from monopart.tools.meshio import Mesh
from monopart.tools.partition import default_body


def tube(around: int, along: int = 6, seam: bool = True) -> Mesh:
    """An open cylinder about y, unrolled once, with one seam at angle 0."""
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    height = np.linspace(0, 2, along + 1)
    verts = np.stack(
        [
            np.tile(np.cos(angle), along + 1),
            np.repeat(height, around),
            np.tile(np.sin(angle), along + 1),
        ],
        1,
    )
    faces, uv = [], []
    for i, j in itertools.product(range(along), range(around)):
        a, b = i * around + j, i * around + (j + 1) % around
        u0, u1, v0, v1 = j / around, (j + 1) / around, i / along, (i + 1) / along
        faces += [[a, a + around, b], [b, a + around, b + around]]
        uv += [[[u0, v0], [u0, v1], [u1, v0]], [[u1, v0], [u0, v1], [u1, v1]]]
    return Mesh(verts, np.array(faces), corner_uv=np.array(uv) if seam else None, name="tube")


def test_a_body_baked_to_itself_is_itself() -> None:
    body = default_body()
    bare = changed(body, corner_uv=None, weights=None, skeleton=None)
    uv, report = bake_uv(body, bare)
    assert np.abs(uv.corner_uv - body.corner_uv).max() < 1e-9
    assert report.max_distance < 1e-9 and report.count == 3 * body.num_faces
    weights, report = bake_weights(body, bare)
    assert np.abs(weights.weights - body.weights / body.weights.sum(1, keepdims=True)).max() < 1e-4
    assert weights.skeleton is body.skeleton and report.taken > 0.99 * report.count
    assert bare.weights is None and bare.corner_uv is None


@pytest.mark.parametrize("around", [12, 17, 40])
def test_no_face_spans_the_seam_of_a_tube(around: int) -> None:
    """The other tube has its edges elsewhere, so faces straddle the seam; none is smeared."""
    source, target = tube(24), tube(around, 5, seam=False)
    turn = 0.05
    spin = np.array([[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]])
    target = changed(target, verts=target.verts @ spin.T)
    baked, report = bake_uv(source, target)
    width = np.ptp(baked.corner_uv[..., 0], axis=1)
    assert width.max() < 1.5 / around
    assert "seam" in report.notes[0]
    # away from the seam the coordinates are those of the angle and the height
    angle = np.arctan2(target.verts[:, 2], target.verts[:, 0]) % (2 * np.pi) / (2 * np.pi)
    exact = np.stack([angle, target.verts[:, 1] / 2], 1)[target.faces]
    whole = np.ptp(exact[..., 0], axis=1) < 0.5
    assert whole.mean() > 0.8
    assert np.abs(baked.corner_uv - exact)[whole].max() < 0.01


def test_charts_of_a_cube_of_six_sides() -> None:
    box = cube()
    uv = np.zeros((12, 3, 2))
    for face in range(12):
        corner, side = box.verts[box.faces[face]], face // 2
        flat = corner[:, np.ptp(corner, axis=0) > 0]
        uv[face] = flat + np.array([2 * side, 0])
    mesh = changed(box, corner_uv=uv)
    assert uv_charts(mesh).tolist() == [k // 2 for k in range(12)]
    assert sorted(uv_neighbours(mesh).tolist()) == [[2 * k, 2 * k + 1] for k in range(6)]
    baked, _ = bake_uv(mesh, box)
    assert np.abs(baked.corner_uv - uv).max() < 1e-9


def test_colors_go_from_texture_and_from_vertices() -> None:
    verts, faces = grid(8)
    ramp = (verts + 1) / 2 * [1, 1, 0]
    coarse, coarse_faces = grid(4)
    source = Mesh(verts, faces, colors=ramp)
    target, report = bake_colors(source, Mesh(coarse, coarse_faces))
    assert np.abs(target.colors - (coarse + 1) / 2 * [1, 1, 0]).max() < 1e-9
    assert report.max_distance == 0
    uv = (verts[faces][..., :2] + 1) / 2
    texel = (np.arange(64) + 0.5) / 64
    image = np.stack(np.broadcast_arrays(texel[None, :], texel[::-1, None], 0.0), 2)
    textured = Mesh(verts, faces, corner_uv=uv, texture=image)
    target, _ = bake_colors(textured, Mesh(coarse, coarse_faces))
    assert np.abs(target.colors - (coarse + 1) / 2 * [1, 1, 0]).max() < 0.01
    with pytest.raises(InputError, match="colours"):
        bake_colors(Mesh(verts, faces), Mesh(coarse, coarse_faces))


def test_a_texture_is_what_the_surface_shows() -> None:
    verts, faces = grid(8)
    source = Mesh(verts, faces, colors=(verts + 1) / 2 * [1, 1, 0])
    coarse, coarse_faces = grid(4)
    uv = (coarse[coarse_faces][..., :2] + 1) / 2 * 0.5 + 0.25  # the middle of the picture
    target, report = bake_texture(source, Mesh(coarse, coarse_faces, corner_uv=uv), 64, gutter=4)
    rows, cols = np.mgrid[:64, :64]
    u, v = (cols + 0.5) / 64, 1 - (rows + 0.5) / 64
    inside = (np.abs(u - 0.5) < 0.25) & (np.abs(v - 0.5) < 0.25)
    exact = np.stack([(u - 0.25) * 2, (v - 0.25) * 2, 0 * u], 2)
    assert np.abs(target.texture - exact)[inside].max() < 1e-9
    assert report.count == inside.sum() == 32 * 32
    away = np.maximum(np.abs(u - 0.5), np.abs(v - 0.5)) * 64 - 16
    assert (target.texture[(away > 6)] == 0).all()
    filled = (away > 0) & (away < 3) & (np.minimum(np.abs(u - 0.5), np.abs(v - 0.5)) < 0.2)
    near = np.clip(exact, 0.5 / 32, 1 - 0.5 / 32) * [1, 1, 0]
    assert np.abs(target.texture - near)[filled].max() < 1e-9
    back, _ = bake_colors(target, Mesh(coarse * 0.9, coarse_faces))
    assert np.abs(back.colors - (coarse * 0.9 + 1) / 2 * [1, 1, 0]).max() < 0.02
    empty, report = bake_texture(source, changed(target, corner_uv=uv * 0), 8)
    assert report.count == 0 and report.notes and (empty.texture == 0).all()


@settings(max_examples=20)
@given(st.integers(0, 10**6))
def test_bilinear_look_up_against_a_loop(seed: int) -> None:
    rng = np.random.default_rng(seed)
    image = rng.random((rng.integers(1, 5), rng.integers(1, 5), 3))
    height, width = image.shape[:2]
    uv = rng.uniform(-0.2, 1.2, size=(6, 2))
    for (u, v), found in zip(uv, looked_up(image, uv), strict=True):
        total = np.zeros(3)
        x, y = (
            np.clip(u * width - 0.5, 0, width - 1),
            np.clip((1 - v) * height - 0.5, 0, height - 1),
        )
        for i, j in itertools.product(range(height), range(width)):
            total += max(0, 1 - abs(y - i)) * max(0, 1 - abs(x - j)) * image[i, j]
        assert np.allclose(found, total)


def test_weights_that_cannot_be_baked() -> None:
    ball = rigged()
    bare = sphere(6, 9)
    baked, report = bake_weights(ball, bare, max_distance=0.2)
    assert np.abs(baked.weights.sum(1) - 1).max() < 1e-12 and report.max_distance < 0.2
    with pytest.raises(InputError, match="weights"):
        bake_weights(bare, ball)
    for weights in (ball.weights * -1, ball.weights * np.nan, ball.weights * 0):
        with pytest.raises(InputError, match="weights"):
            bake_weights(changed(ball, weights=weights), bare)


@pytest.mark.parametrize("name", list(sample_meshes()))
def test_any_mesh_is_baked_or_refused(name: str) -> None:
    mesh = sample_meshes()[name]
    source = changed(rigged(), colors=np.ones((86, 3)), corner_uv=np.zeros((168, 3, 2)))
    before = mesh.verts.copy()
    for bake in (bake_weights, bake_uv, bake_colors):
        for pair in ((source, mesh), (mesh, source)):
            try:
                found, report = bake(*pair)
            except InputError as error:
                assert "expected" in str(error) and "found" in str(error)
                continue
            assert found.num_faces == pair[1].num_faces and report.max_distance >= 0
    assert np.array_equal(before, mesh.verts, equal_nan=True)


def test_sizes_are_checked() -> None:
    source = changed(sphere(), colors=np.ones((86, 3)))
    target = changed(sphere(), corner_uv=np.zeros((168, 3, 2)))
    with pytest.raises(InputError, match="size"):
        bake_texture(source, target, 0)
    with pytest.raises(InputError, match="texture coordinates"):
        bake_texture(source, sphere(), 8)
