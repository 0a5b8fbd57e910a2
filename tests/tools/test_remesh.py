"""Remeshed surfaces lie on the old ones and carry what those carried."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
from building import ROOT
from mesh_samples import cube, tube

from monopart.geometry.errors import InputError
from monopart.tools import remesh
from monopart.tools.bake_uv import uv_charts
from monopart.tools.meshio import Mesh, read_mesh

pytest.importorskip("pymeshlab", reason="PyMeshLab is not installed (extra tools)")


def _body():
    return read_mesh(ROOT / "geometry" / "assets" / "body.npz")


def _edge_lengths(mesh):
    corners = mesh.verts[mesh.faces]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).reshape(-1)


def _is_closed(mesh):
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()


def test_decimated_body_keeps_its_skin():
    body = _body()
    done = remesh.decimate(body, 3000)
    assert done.mesh.num_faces == done.report["faces"] == 3000
    assert _is_closed(done.mesh)
    assert done.report["distance_max"] < 0.02
    assert done.mesh.skeleton.parents == body.skeleton.parents
    np.testing.assert_allclose(done.mesh.weights.sum(axis=1), 1)
    # each joint still moves the same region: centres of the weights stay
    for mesh in (body, done.mesh):
        corners = mesh.verts[mesh.faces]
        area = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        share = mesh.weights[mesh.faces].mean(axis=1) * area[:, None]
        centres = (share.T @ corners.mean(axis=1)) / share.sum(axis=0)[:, None]
        reference = centres if mesh is body else reference
    assert np.abs(centres - reference).max() < 0.01
    count = [len(np.unique(uv_charts(m))) for m in (body, done.mesh)]
    assert count[1] >= count[0]
    again = remesh.decimate(body, 3000)
    np.testing.assert_array_equal(again.mesh.verts, done.mesh.verts)


def test_isotropic_edges_are_near_the_length():
    done = remesh.isotropic(cube(2.0), 0.25)
    lengths = _edge_lengths(done.mesh)
    assert abs(np.median(lengths) / 0.25 - 1) < 0.25
    assert lengths.max() < 0.5
    assert _is_closed(done.mesh)
    assert done.report["distance_max"] < 1e-6


@pytest.mark.parametrize("size", [2.0**-40, 2.0**66])
def test_the_unit_does_not_matter(size):
    small = remesh.isotropic(cube(size), 0.25 * size)
    usual = remesh.isotropic(cube(1.0), 0.25)
    assert small.mesh.num_faces == usual.mesh.num_faces
    np.testing.assert_allclose(small.mesh.verts / size, usual.mesh.verts, atol=1e-12)


def test_clean_mends_what_is_broken():
    box = cube()
    verts = np.concatenate([box.verts, box.verts, [[np.nan, 0, 0], [9.0, 9, 9]]])
    extra = [[0, 1, 16], [0, 0, 1], [2, 3, 3]]
    faces = np.concatenate([box.faces, box.faces[3:6] + 8, extra])
    done = remesh.clean(Mesh(verts, faces, weights=np.ones((18, 1)), name="broken"))
    assert done.mesh.num_verts == 8 and done.mesh.num_faces == 12
    assert _is_closed(done.mesh)
    assert done.report["vertices_not_finite"] == 1
    assert done.report["faces_before"] == 18
    np.testing.assert_array_equal(done.mesh.weights, np.ones((8, 1)))


def test_clean_leaves_a_good_mesh_alone():
    mesh = tube()
    done = remesh.clean(mesh)
    assert done.mesh.num_faces == mesh.num_faces
    np.testing.assert_allclose(
        np.sort(done.mesh.verts, axis=0), np.sort(mesh.verts, axis=0), atol=1e-12
    )
    np.testing.assert_allclose(done.mesh.weights.sum(axis=1), 1)


def test_clean_closes_holes_when_asked():
    open_box = dataclasses.replace(cube(), faces=cube().faces[2:])
    assert not _is_closed(remesh.clean(open_box).mesh)
    assert _is_closed(remesh.clean(open_box, close_holes=10).mesh)


def test_wrong_input():
    box = cube()
    cloud = Mesh(np.eye(3), np.zeros((0, 3)), name="cloud")
    broken = Mesh(np.full((3, 3), np.nan), np.array([[0, 1, 2]]), name="broken")
    for work, words in [
        (lambda: remesh.decimate(box, 12), "from 4 to 11"),
        (lambda: remesh.decimate(box, 3), "found 3"),
        (lambda: remesh.isotropic(box, 0.0), "above 0"),
        (lambda: remesh.isotropic(box, -1.0), "above 0"),
        (lambda: remesh.isotropic(box, float("nan")), "above 0"),
        (lambda: remesh.isotropic(box, 1e-6), "ten million"),
        (lambda: remesh.decimate(cloud, 4), "at least one triangle"),
        (lambda: remesh.clean(cloud), "finite corners"),
        (lambda: remesh.clean(broken), "finite corners"),
        (lambda: remesh.isotropic(broken, 1.0), "finite numbers"),
    ]:
        with pytest.raises(InputError, match=words):
            work()


def test_nothing_of_no_area_crashes():
    """Lines and single points as triangles: a result or a clear error."""
    for faces in ([[0, 0, 0]], [[0, 1, 1]], [[0, 1, 2]]):
        line = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array(faces))
        for work in (remesh.clean, lambda m: remesh.isotropic(m, 0.5)):
            try:
                work(line)
            except InputError as error:
                assert "expected" in str(error)


def test_pymeshlab_is_loaded_late():
    code = "import sys, monopart.tools.remesh; print('pymeshlab' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == "False\n", done.stderr
