"""Parts of rigged and unrigged meshes, their pictures and reports."""

import json
import subprocess
import sys

import numpy as np
import pytest
from sample_meshes import changed, cube, rigged, sample_meshes, sphere

from monopart.geometry.errors import InputError
from monopart.tools.images import decoded
from monopart.tools.meshio import Mesh, Skeleton
from monopart.tools.partition import (
    default_body,
    part_table,
    partition,
    partition_picture,
    partition_report,
    write_partition,
)
from monopart.tools.pictures import front_and_back, part_colors, view


@pytest.fixture(scope="module")
def body() -> Mesh:
    return default_body()


def test_each_way_finds_the_same_parts(body: Mesh) -> None:
    own = partition(body, "six")
    assert own.method == "weights" and not own.notes
    heat = partition(changed(body, weights=None), "six")
    assert heat.method == "heat"
    assert (heat.face_part == own.face_part).mean() > 0.96
    turned = changed(body, weights=None, skeleton=None, verts=100 * body.verts[:, [2, 0, 1]] + 7)
    moved = partition(turned, "six")
    assert moved.method == "transfer"
    assert (moved.face_part == own.face_part).mean() > 0.98
    assert np.allclose(moved.weights.sum(1), 1)
    for parts in (own, heat, moved):
        report = partition_report(body, parts)
        assert [p["pieces"] for p in report["parts"]] == [1] * 6
        assert sum(p["faces"] for p in report["parts"]) == body.num_faces
        assert sum(p["vertices"] for p in report["parts"]) == body.num_verts


def test_a_renamed_and_reordered_rig_is_known_by_its_names(body: Mesh) -> None:
    bones = body.skeleton
    order = [0, 3, 6, 9, 12, 15, 13, 16, 18, 20, 22, 14, 17, 19, 21, 23, 1, 4, 7, 10, 2, 5, 8, 11]
    name = {
        "pelvis": "Hips",
        "spine1": "Spine",
        "neck": "Neck",
        "head": "Head",
        **{f"{s}_collar": f"{s.title()}Shoulder" for s in ("left", "right")},
        **{f"{s}_shoulder": f"{s.title()}Arm" for s in ("left", "right")},
        **{f"{s}_elbow": f"{s.title()}ForeArm" for s in ("left", "right")},
        **{f"{s}_hip": f"{s.title()}UpLeg" for s in ("left", "right")},
        **{f"{s}_knee": f"{s.title()}Leg" for s in ("left", "right")},
    }
    names = tuple("mixamorig:" + name.get(bones.names[j], bones.names[j]) for j in order)
    parents = tuple(-1 if bones.parents[j] < 0 else order.index(bones.parents[j]) for j in order)
    rig = Skeleton(names, parents, bones.joints[order])
    foreign = changed(body, weights=body.weights[:, order], skeleton=rig)
    for preset in ("three", "five", "six", "per_limb", "six+hands"):
        own, other = partition(body, preset), partition(foreign, preset)
        assert np.array_equal(own.face_part, other.face_part)
        assert own.names == other.names
    assert part_table("five", 24, rig)["head"] == (4, 5)


def test_a_table_of_ones_own_and_bands(body: Mesh) -> None:
    table = {"upper": [*range(3), *range(3, 24)][:0] or [0, 3, 6, 9, *range(12, 24)], "lower": []}
    table["lower"] = sorted(set(range(24)) - set(table["upper"]))
    parts = partition(body, table=table, band=0.04)
    assert parts.names == ("upper", "lower")
    assert parts.bands is not None and (parts.bands.faces.sum(0) == 2).sum() > 50
    report = partition_report(body, parts)
    assert all(p["faces_with_band"] > p["faces"] for p in report["parts"])
    with pytest.raises(InputError, match="exactly one part"):
        partition(body, table={"a": [0, 1]})


def test_files_of_a_partition(body: Mesh, tmp_path) -> None:
    parts = partition(body, "three", band=0.02)
    files = write_partition(body, parts, tmp_path, "arms")
    assert [f.name for f in files] == ["arms.npz", "arms.json", "arms.png"]
    assert sorted(f.name for f in tmp_path.iterdir()) == sorted(f.name for f in files)
    with np.load(files[0], allow_pickle=False) as back:
        assert back["names"].tolist() == ["body", "legs", "arms"]
        assert np.array_equal(back["face_part"], parts.face_part)
        assert back["band_faces"].shape == (3, body.num_faces)
    assert json.loads(files[1].read_text())["parts"][1]["pieces"] == 2
    image = decoded(files[2].read_bytes(), "arms.png")
    for color in part_colors(3):  # every part is seen: its hue, shaded
        away = image / np.maximum(image.max(2, keepdims=True), 1e-9) - color / color.max()
        assert (np.abs(away).max(2) < 0.05).mean() > 0.01
    with pytest.raises(InputError, match="folder"):
        write_partition(body, parts, tmp_path / "none")


@pytest.mark.parametrize("name", list(sample_meshes()))
def test_any_mesh_gives_parts_or_a_clear_error(name: str) -> None:
    mesh = sample_meshes()[name]
    try:
        parts = partition(mesh, "three", band=0.1)
    except InputError as error:
        assert "expected" in str(error) and "found" in str(error)
        return
    assert parts.face_part.shape == (mesh.num_faces,)
    assert parts.vertex_part.shape == (mesh.num_verts,)
    assert np.isfinite(parts.weights).all()
    assert partition_picture(mesh, parts, 60).shape[2] == 3
    json.dumps(partition_report(mesh, parts), allow_nan=False)


def test_a_mesh_unlike_the_body_is_doubted() -> None:
    notes = partition(changed(sphere(20, 30), name="ball"), "five").notes
    assert any("unlike our body" in note for note in notes)


def test_wrong_requests_are_refused(body: Mesh) -> None:
    with pytest.raises(InputError, match="found 'seven'"):
        partition(body, "seven")
    with pytest.raises(InputError, match="skeleton"):
        partition(cube(), method="heat")
    with pytest.raises(InputError, match="weights"):
        partition(cube(), method="weights")
    with pytest.raises(InputError, match="joint names"):
        partition(rigged(), "five")
    assert partition(rigged(), table={"a": [0], "b": [1]}).names == ("a", "b")


def test_views_are_of_the_right_side() -> None:
    box = cube()
    colors = np.zeros((12, 3))
    colors[:, 0] = (box.verts[box.faces].mean(1)[:, 2] > 0.49).astype(float)  # the front is red
    colors[:, 2] = (box.verts[box.faces].mean(1)[:, 2] < -0.49).astype(float)
    front = view(box.verts, box.faces, colors, height=100)
    back = view(box.verts, box.faces, colors, back=True, height=100)
    middle = front[50, front.shape[1] // 2], back[50, back.shape[1] // 2]
    assert middle[0].tolist() == [1, 0, 0] and middle[1].tolist() == [0, 0, 1]
    wide = np.vstack([box.verts, [[3.0, 0, 0], [3, 0.1, 0], [3, 0, 0.1]]])
    faces = np.vstack([box.faces, [[8, 9, 10]]])
    white = np.ones((13, 3))
    left = view(wide, faces, 0 * white, height=100)[50]  # x grows to the right: the cube is left
    assert left[: len(left) // 4].min() == 0 and left[len(left) // 2 : -10].min() > 0.9
    right = view(wide, faces, 0 * white, back=True, height=100)[50]
    assert right[-len(left) // 4 :].min() == 0 and right[10 : len(left) // 2].min() > 0.9
    half = view(np.eye(3), np.array([[0, 1, 2]]), np.ones((1, 3)), height=100)
    # x − y triangle below the diagonal covers half of 94 % squared
    assert (half < 0.9).any(2).mean() == pytest.approx(0.5 * 0.94**2, rel=0.05)


def test_pictures_of_nothing() -> None:
    none = np.zeros((0, 3), np.int64)
    assert view(np.zeros((0, 3)), none, np.zeros((0, 3))).min() > 0.9
    nan = view(np.full((3, 3), np.nan), np.array([[0, 1, 2]]), np.ones((1, 3)))
    assert nan.min() > 0.9
    legend = [(f"part {k}", c) for k, c in enumerate(part_colors(14))]
    image = front_and_back(np.eye(3), np.array([[0, 1, 2]]), np.ones((1, 3)), legend, height=100)
    assert image.shape[0] > 100
    assert len({tuple(c) for c in part_colors(40).round(3).tolist()}) == 40


def test_parts_from_weights_need_no_torch() -> None:
    code = (
        "import sys\n"
        "from monopart.tools.partition import default_body, partition, partition_picture\n"
        "body = default_body()\n"
        "partition_picture(body, partition(body))\n"
        "print([m for m in ('torch', 'warp', 'igl', 'cv2', 'trimesh') if m in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
