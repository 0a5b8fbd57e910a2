"""Pictures of meshes: the rasteriser against a loop, sides, distortion, odd input."""

import dataclasses

import numpy as np
import pytest
from mesh_samples import cube, tube

from monopart.tools.colors import face_distortion, heat_color, texture_color, unit_box
from monopart.tools.meshio import Mesh
from monopart.tools.raster import rasterise
from monopart.tools.views import fault_panels, grid_panels, sheet, surface_panels, uv_panels, view


def _nearest(corners, depth, x, y):
    """Face and place at a pixel's middle, by a loop over the triangles."""
    best = (np.inf, -1, np.zeros(3))
    for face, (triangle, away) in enumerate(zip(corners, depth, strict=True)):
        matrix = np.vstack([triangle.T, np.ones(3)])
        if abs(np.linalg.det(matrix)) < 1e-12:
            continue
        bary = np.linalg.solve(matrix, [x + 0.5, y + 0.5, 1])
        if bary.min() >= 0 and bary @ away < best[0]:
            best = (bary @ away, face, bary)
    return best[1:]


def test_rasteriser_agrees_with_a_loop():
    rng = np.random.default_rng(0)
    corners = rng.uniform(-3, 15, size=(30, 3, 2))
    depth = rng.random((30, 3))
    corners[4], corners[7], depth[9] = np.nan, corners[7, :1], np.inf
    raster = rasterise(corners, depth, 11, 13)
    known = [f for f in range(30) if f not in (4, 7, 9)]
    for y in range(11):
        for x in range(13):
            face, bary = _nearest(corners[known], depth[known], x, y)
            assert raster.face[y, x] == (known[face] if face >= 0 else -1)
            if face >= 0:
                np.testing.assert_allclose(raster.bary[y, x], bary, atol=1e-9)
    values = rng.random((30, 3, 2))
    shown = raster.of_corners(values)
    y, x = np.argwhere(raster.face >= 0)[0]
    np.testing.assert_allclose(shown[y, x], raster.bary[y, x] @ values[raster.face[y, x]])
    assert (shown[raster.face < 0] == 0).all()


def test_the_first_of_equals_is_seen_and_nothing_is_nothing():
    corners = np.array([[[0.0, 0], [4, 0], [0, 4]]] * 3)
    assert rasterise(corners, np.zeros((3, 3)), 2, 2).face.max() == 0
    assert rasterise(corners[:0], np.zeros((0, 3)), 2, 2).face.tolist() == [[-1, -1], [-1, -1]]


def test_front_is_left_and_shows_the_front():
    """The subject's left (+x) is on the right of the front view, on the left of the back view."""
    box = cube()
    middle = box.verts[box.faces].mean(axis=1)
    red = np.zeros((12, 3, 3))
    red[middle[:, 2] == 1] = [1, 0, 0]  # the front
    red[middle[:, 2] == 0] = [0, 0, 1]
    image = view(box, 64).colored(red)
    row = len(image) // 2
    front, back = image[:, :32], image[:, 32:]
    assert front[row, 16].argmax() == 0 and back[row, 16].argmax() == 2
    blue = np.zeros((12, 3, 3)) + (box.verts[box.faces][..., :1] > 0.5) * [0, 1, 0]
    sides = view(box, 64).colored(blue)
    assert sides[row, 26, 1] > 0.5 > sides[row, 6, 1]
    assert sides[row, 32 + 6, 1] > 0.5 > sides[row, 32 + 26, 1]


def test_faults_are_seen_through_the_surface():
    box = cube()
    inner = dataclasses.replace(cube(0.2), verts=cube(0.2).verts + 0.4)
    faces = np.concatenate([box.faces, inner.faces + 8])
    both = Mesh(np.concatenate([box.verts, inner.verts]), faces)

    def reds(faults):
        (panel,) = fault_panels(both, faults, 64)
        return int((panel.image[..., 0] > 2 * panel.image[..., 1]).sum())

    assert reds([]) == 0
    assert reds([("faces", tuple(range(12, 24)))]) > 20
    assert reds([("vertices", (8,))]) > 5


def test_distortion_is_four_for_a_copy_and_known_for_a_stretch():
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    uv = flat[faces][..., :2]
    mesh = Mesh(flat, faces, corner_uv=uv)
    np.testing.assert_allclose(face_distortion(mesh), 4)
    np.testing.assert_allclose(face_distortion(dataclasses.replace(mesh, corner_uv=uv * 0.1)), 4)
    wide = dataclasses.replace(mesh, corner_uv=uv * [4, 1])
    np.testing.assert_allclose(face_distortion(wide), 4 + 0.25 + 4 + 0.25)
    flipped = dataclasses.replace(mesh, corner_uv=uv * [-1, 1])
    assert np.isinf(face_distortion(flipped)).all()
    broken = dataclasses.replace(mesh, verts=flat * [np.nan, 1, 1])
    assert np.isnan(face_distortion(broken)).all()


def test_colours():
    texture = np.arange(12.0).reshape(2, 2, 3)
    np.testing.assert_array_equal(texture_color(texture, np.array([[0.1, 0.9]])), texture[:1, 0])
    np.testing.assert_array_equal(texture_color(texture, np.array([[1.9, -0.9]])), texture[1:, 1])
    low, high, over, none = heat_color(np.array([4.0, 5, np.inf, np.nan]), 4.0, 5.0)
    np.testing.assert_array_equal(high, over)
    assert low[2] > low[0] and high[0] > high[2] and np.ptp(none) < 0.1
    far = unit_box(np.array([[1e300, 0, 0], [-1e300, 0, 0], [np.nan, 0, 0]]))
    np.testing.assert_allclose(far[:2], [[0.5, 0, 0], [-0.5, 0, 0]])


@pytest.mark.parametrize(
    "mesh",
    [
        tube(),
        cube(),
        Mesh(np.zeros((0, 3)), np.zeros((0, 3))),
        Mesh(np.full((3, 3), np.nan), np.array([[0, 1, 2]])),
        Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]), corner_uv=np.full((1, 3, 2), np.nan)),
        Mesh(np.random.default_rng(0).random((9, 3)), np.zeros((0, 3)), colors=np.ones((9, 3))),
    ],
    ids=["tube", "cube", "empty", "nan", "collapsed", "points"],
)
def test_every_mesh_has_a_picture(mesh):
    with np.errstate(all="ignore"):
        panels = [*surface_panels(mesh, "a", 32), *uv_panels(mesh, 32), *fault_panels(mesh, [], 32)]
    image = sheet(panels)
    assert np.isfinite(image).all() and image.min() >= 0 and image.max() <= 1


def test_slices_of_a_grid():
    panels = grid_panels(np.linspace(-1, 1, 60).reshape(3, 4, 5), 40)
    assert [p.image.shape for p in panels] == [(40, 30, 3), (32, 40, 3)]
