"""Tables of parts by number and by name."""

import pytest

from monopart.geometry.errors import InputError
from monopart.geometry.part_tables import (
    APART,
    joint_parts,
    pieces_of_joints,
    preset_names,
    preset_table,
    regions_by_name,
    table_by_name,
)
from monopart.geometry.parts import PartMap

SMPL = (
    "pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 "
    "left_foot right_foot neck left_collar right_collar head left_shoulder right_shoulder "
    "left_elbow right_elbow left_wrist right_wrist left_hand right_hand"
).split()
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
EVERY = [name + end for name in preset_names() for end in ("", APART)]

MIXAMO = {
    "Hips": "torso",
    "Spine2": "torso",
    "LeftShoulder": "torso",
    "LeftArm": "left_upper_arm",
    "LeftForeArm": "left_forearm",
    "LeftHand": "left_hand",
    "LeftHandThumb1": "left_hand",
    "Neck": "head",
    "HeadTop_End": "head",
    "RightUpLeg": "right_thigh",
    "RightLeg": "right_shin",
    "RightToeBase": "right_shin",
}
UNREAL = {
    "pelvis": "torso",
    "spine_03": "torso",
    "clavicle_l": "torso",
    "upperarm_l": "left_upper_arm",
    "lowerarm_l": "left_forearm",
    "hand_l": "left_hand",
    "index_01_l": "left_hand",
    "thigh_r": "right_thigh",
    "calf_r": "right_shin",
    "ball_r": "right_shin",
    "head": "head",
}
BLENDER = {
    "spine.001": "torso",
    "shoulder.R": "torso",
    "upper_arm.R": "right_upper_arm",
    "forearm.R": "right_forearm",
    "f_ring.01.R": "right_hand",
    "thigh.L": "left_thigh",
    "shin.L": "left_shin",
}


@pytest.mark.parametrize("name", EVERY)
def test_names_and_numbers_give_the_same_parts(name: str) -> None:
    by_number = preset_table(name, 24)
    by_name = table_by_name(name, SMPL, PARENTS)
    assert {p: sorted(j) for p, j in by_number.items()} == {
        p: sorted(j) for p, j in by_name.items()
    }


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("num_joints", [22, 24, 52, 55])
def test_every_joint_is_in_one_part(name: str, num_joints: int) -> None:
    table = preset_table(name, num_joints)
    assert sorted(j for joints in table.values() for j in joints) == list(range(num_joints))
    assert all(table.values())


def test_hands_apart_take_all_beyond_the_wrist() -> None:
    assert preset_table("three+hands", 24)["left_hand"] == (20, 22)
    assert set(preset_table("per_limb+hands", 52)["right_hand"]) == {21, *range(37, 52)}
    assert 20 not in preset_table("six+hands", 24)["left_arm"]
    assert PartMap.preset("five+hands").num_parts == 7


@pytest.mark.parametrize("rig", [MIXAMO, UNREAL, BLENDER], ids=["mixamo", "unreal", "blender"])
def test_common_rigs_are_known_by_name(rig: dict[str, str]) -> None:
    prefix = "mixamorig:" if rig is MIXAMO else ""
    names = [prefix + name for name in rig]
    found = regions_by_name(names, [-1] + [0] * (len(names) - 1))
    assert dict(zip(rig, found, strict=True)) == rig


def test_unknown_names_follow_their_parents_and_sides() -> None:
    found = regions_by_name(["x", "LeftArm", "twist", "hand", "RightFoot"], [-1, 0, 1, 2, 0])
    assert found == ("torso", "left_upper_arm", "left_upper_arm", "left_hand", "right_shin")


def test_by_name_says_what_is_missing() -> None:
    with pytest.raises(InputError, match="left_arm"):
        PartMap.by_name("five", ["hips", "left_leg", "head"], [-1, 0, 0])
    with pytest.raises(InputError, match="one of five"):
        PartMap.by_name("seven", ["hips"], [-1])
    with pytest.raises(InputError, match="found 1"):
        regions_by_name(["a"], [-1, 0])
    with pytest.raises(InputError, match="before its child"):
        regions_by_name(["a", "b"], [1, -1])


def test_tables_are_checked() -> None:
    assert joint_parts({"a": (1,), "b": (0,)}, 2) == (1, 0)
    for table in ({"a": (0,)}, {"a": (0, 0), "b": (1,)}, {"a": (0, 1, 2)}):
        with pytest.raises(InputError, match="exactly one part"):
            joint_parts(table, 2)


def test_pieces_hang_together_in_the_skeleton() -> None:
    part = joint_parts(preset_table("three", 24), 24)
    piece, owner = pieces_of_joints(part, PARENTS)
    assert owner == (0, 1, 1, 2, 2)  # body, two legs, two arms
    for joint, parent in enumerate(PARENTS):
        together = parent >= 0 and part[joint] == part[parent]
        assert (parent >= 0 and piece[joint] == piece[parent]) == together
