"""Parts of bodies."""

import pytest
import torch

from monopart.geometry.body import BodyModel
from monopart.geometry.errors import InputError
from monopart.geometry.parts import PartMap

PRESETS = ["five", "three", "six", "per_limb", "single"]


def test_default_is_the_table_of_the_method() -> None:
    parts = PartMap.default()
    assert parts == PartMap.preset("five", 24)
    assert parts.names == ("body", "legs", "head", "left_arm", "right_arm")
    assert [set(parts.joints_of(p)) for p in range(5)] == [
        {0, 3, 6, 9, 13, 14},
        {1, 2, 4, 5, 7, 8, 10, 11},
        {12, 15},
        {16, 18, 20, 22},
        {17, 19, 21, 23},
    ]


@pytest.mark.parametrize(("name", "count"), list(zip(PRESETS, [5, 3, 6, 10, 1], strict=True)))
@pytest.mark.parametrize("num_joints", [22, 24, 52, 55])
def test_presets_cover_every_joint(name: str, count: int, num_joints: int) -> None:
    parts = PartMap.preset(name, num_joints)
    assert parts.num_parts == count
    joints = [j for p in range(count) for j in parts.joints_of(p)]
    assert sorted(joints) == list(range(num_joints))


def test_vertex_parts_follow_the_largest_weight() -> None:
    body = BodyModel.default()
    parts = PartMap.default(body.num_joints)
    found = parts.vertex_parts(body.weights)
    assert found.shape == (body.num_verts,) and found.dtype == torch.int64
    for v in range(0, body.num_verts, 97):
        weights = body.weights[v].tolist()
        assert found[v] == parts.joint_part[weights.index(max(weights))]
    assert body.v_template[found == 3][:, 0].min() > 0  # the left arm is at +x
    assert body.v_template[found == 4][:, 0].max() < 0
    assert body.v_template[found == 2][:, 1].mean() > body.v_template[found == 1][:, 1].max()


def test_face_parts_by_majority_then_by_weight() -> None:
    parts = PartMap((0, 1, 2), ("a", "b", "c"))
    weights = torch.tensor([[0.6, 0.3, 0.1], [0.3, 0.6, 0.1], [0.2, 0.38, 0.42], [0.9, 0.1, 0.0]])
    faces = torch.tensor([[0, 1, 2], [0, 3, 2], [2, 2, 3]])
    # sums over the corners of the first: 1.1, 1.28, 0.62
    assert parts.face_parts(weights, faces).tolist() == [1, 0, 2]


def test_every_face_of_the_body_has_the_part_of_two_corners() -> None:
    body = BodyModel.default()
    for name in PRESETS:
        parts = PartMap.preset(name, body.num_joints)
        face = parts.face_parts(body.weights, body.faces)
        votes = (parts.vertex_parts(body.weights)[body.faces] == face[:, None]).sum(1)
        corners = parts.vertex_parts(body.weights)[body.faces].sort(1).values
        different = (corners[:, 1:] != corners[:, :-1]).all(1)
        assert (votes[~different] >= 2).all() and (votes[different] == 1).all()
        assert face.unique().tolist() == list(range(parts.num_parts))


def test_no_faces() -> None:
    parts = PartMap.preset("single", 3)
    assert parts.face_parts(torch.ones(2, 3), torch.zeros(0, 3, dtype=torch.int64)).shape == (0,)


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: PartMap.preset("seven"), "seven"),
        (lambda: PartMap.preset("five", 17), "17"),
        (lambda: PartMap((0, 2), ("a", "b")), "joint_part"),
        (lambda: PartMap((0, 0), ("a", "b")), "joint_part"),
        (lambda: PartMap.from_table({"a": (0,), "b": (0, 1)}, 2), "exactly one"),
        (lambda: PartMap.from_table({"a": (0,)}, 2), "exactly one"),
        (lambda: PartMap.default().vertex_parts(torch.ones(3, 5)), "weights"),
    ],
)
def test_bad_tables_are_refused(make: object, named: str) -> None:
    with pytest.raises(InputError, match=named):
        make()  # pyright: ignore
