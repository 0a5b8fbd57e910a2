"""The report on a mesh: every fault that was put in is found, and nothing else."""

import json
import subprocess
import sys

import numpy as np
import pytest
from sample_meshes import changed, cube, joined, rigged, sample_meshes, shifted, sphere, torus

from monopart.geometry.atomic import write_json
from monopart.tools.check import check_mesh, check_picture
from monopart.tools.meshio import Mesh
from monopart.tools.topology import topology

FAULTS: dict[str, dict[str, int | None]] = {
    "sphere": {},
    "cube": {},
    "torus": {},
    "rigged": {},
    "two spheres": {},
    "tiny": {},
    "huge": {},
    "far away": {},
    "seams": {"duplicate_vertices": None},
    "sheet": {"open_edges": 16},
    "sheet with texture": {"open_edges": 16},
    "hole": {"open_edges": 3},
    "empty": {"empty": 1},
    "points": {"empty": 1, "unused_vertices": None},
    "one face": {"open_edges": 3},
    "NaN": {"not_finite": 1, "open_edges": None},
    "all NaN": {"not_finite": None},
    "infinite": {"not_finite": None, "open_edges": None},
    "collapsed": {"degenerate": None, "duplicate_vertices": None},
    "degenerate": {"degenerate": 2, "open_edges": None, "turned_edges": 1},
    "branching": {"branching_edges": 1, "open_edges": None},
    "duplicate faces": {"duplicate_faces": 2, "branching_edges": None},
    "unused vertex": {"unused_vertices": 1},
    "turned face": {"turned_edges": 3},
    "inside out": {"inside_out": 168},
    "pinched": {"pinched_vertices": 1, "duplicate_vertices": None, "unused_vertices": None},
    "cutting": {"self_intersections": None},
    "overlapping texture": {"uv_overlaps": 32 * 31 // 2, "open_edges": 16},
    "turned texture": {"uv_flipped": 32, "uv_outside": None, "open_edges": 16},
    "bad weights": {"weights_sum": None, "weights_negative": None},
    "no weights": {"unweighted": 86},
}


@pytest.mark.parametrize("name", list(sample_meshes()))
def test_every_fault_is_found_and_no_other(name: str) -> None:
    mesh = sample_meshes()[name]
    before = {
        k: None if v is None else np.array(v) for k, v in vars(mesh).items() if k != "skeleton"
    }
    report = check_mesh(mesh)
    found = {f.name: f.count for f in report.findings if f.count and f.name != "asymmetric"}
    assert set(found) == set(FAULTS[name])
    for fault, count in FAULTS[name].items():
        assert count is None or found[fault] == count, fault
    harmless = {"open_edges", "duplicate_vertices", "unused_vertices", "inside_out", "uv_outside"}
    assert report.ok == (set(found) <= harmless)
    for finding in report.findings:
        assert len(finding.worst) == min(finding.count, 10) or finding.name == "empty"
        values = [o.value for o in finding.worst if o.value is not None]
        assert values == sorted(values, reverse=True)
    for key, value in before.items():  # nothing was changed
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            assert np.array_equal(value, getattr(mesh, key), equal_nan=True)
    assert report.lines()[-1].endswith("ok" if report.ok else "faults found")


def test_the_report_is_json(tmp_path) -> None:
    for mesh in sample_meshes().values():
        path = write_json(tmp_path / "report.json", check_mesh(mesh).as_dict())
        back = json.loads(path.read_text())
        assert back["ok"] in (True, False) and len(back["findings"]) >= 12


def test_numbers_of_known_bodies() -> None:
    box = check_mesh(shifted(cube(), 100.0, 0, 0)).numbers
    assert (box["euler"], box["pieces"], box["holes"]) == (2, 1, 0)
    assert box["volume"] == pytest.approx(1, rel=1e-9) and box["area"] == pytest.approx(6)
    assert check_mesh(torus()).numbers["euler"] == 0
    two = joined(sphere(), shifted(sphere(), 3.0, 0, 0))
    assert check_mesh(two).numbers["pieces"] == 2
    one = check_mesh(sphere()).numbers["volume"]
    assert check_mesh(two).numbers["volume"] == pytest.approx(2 * one)
    inner = changed(sphere(radius=0.5), faces=sphere().faces[:, ::-1])
    hollow = check_mesh(joined(sphere(), inner))
    assert hollow.numbers["volume"] == pytest.approx(one * (1 - 0.125))
    assert hollow["inside_out"].count == inner.num_faces


def test_left_and_right() -> None:
    assert check_mesh(cube())["asymmetric"].count == 0
    moved = shifted(cube(), 0.25, 0, 0)
    report = check_mesh(moved)
    assert report["asymmetric"].count == 8 and report.ok
    assert report["asymmetric"].worst[0].value == pytest.approx(0.5)
    assert check_mesh(moved, symmetry_plane=0.25)["asymmetric"].count == 0
    names = [f.name for f in check_mesh(moved, symmetry_plane=None, intersections=False).findings]
    assert "asymmetric" not in names and "self_intersections" not in names


def test_worst_weights_come_first_with_their_vertex() -> None:
    mesh = rigged()
    weights = mesh.weights.copy()
    weights[7] *= 1.5
    weights[3] = [1.2, -0.2]
    weights[4] = [1.05, 0.05]
    weights[9] = np.nan
    report = check_mesh(changed(mesh, weights=weights))
    worst = report["weights_sum"].worst
    assert [o.indices for o in worst] == [(7,), (4,)]
    assert worst[0].value == pytest.approx(0.5)
    assert report["weights_negative"].worst[0].value == pytest.approx(0.2)
    assert report["weights_not_finite"].worst[0].indices == (9,)
    assert not report.ok


def test_topology_of_known_nets() -> None:
    strip = topology(np.array([[0, 1, 2], [2, 1, 3], [4, 5, 6]]), 7)
    assert strip.num_pieces == 2 and strip.holes == 2 and not strip.closed
    assert strip.turned_edges.tolist() == []
    assert topology(np.array([[0, 1, 2], [1, 2, 3]]), 4).turned_edges.tolist() == [[1, 2]]
    bow = topology(np.array([[0, 1, 2], [2, 3, 4]]), 5)
    assert bow.pinched_verts.tolist() == [2]
    assert topology(np.zeros((0, 3), np.int64), 0).euler == 0
    moebius = np.array([[k, (k + 1) % 6, (k + 2) % 6] for k in range(6)])
    assert len(topology(moebius, 6).turned_edges) >= 1


def test_a_check_needs_no_torch() -> None:
    code = (
        "import sys, numpy as np\n"
        "from monopart.tools.check import check_mesh\n"
        "from monopart.tools.meshio import Mesh\n"
        "uv, weights = np.zeros((1, 3, 2)), np.ones((3, 1))\n"
        "mesh = Mesh(np.eye(3), np.array([[0, 1, 2]]), corner_uv=uv, weights=weights)\n"
        "check_mesh(mesh)\n"
        "print([m for m in ('torch', 'warp', 'igl', 'cv2', 'trimesh') if m in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_mesh_of_one_joint_and_no_skeleton() -> None:
    mesh = Mesh(np.eye(3), np.array([[0, 1, 2]]), weights=np.ones((3, 1)))
    assert check_mesh(mesh).ok


def test_faulty_faces_are_red_in_the_picture() -> None:
    for name, count in (("sphere", 0), ("turned face", 4), ("bad weights", 132), ("pinched", 12)):
        mesh = sample_meshes()[name]
        report = check_mesh(mesh)
        assert report.faulty is not None and report.faulty.sum() == count, name
        image = check_picture(mesh, report, 80)
        red = (image[:80, :, 0] > 2 * image[:80, :, 1]).any()
        assert red == (count > 0), name
    for mesh in sample_meshes().values():
        assert check_picture(mesh, check_mesh(mesh, intersections=False), 30).shape[2] == 3
