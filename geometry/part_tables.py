"""Tables of body parts as plain Python: which joints make which part, by number or by name."""

import itertools
import re
from collections.abc import Mapping, Sequence

from .errors import InputError

# Regions of the SMPL joints: every preset is a union of them
_REGIONS: dict[str, tuple[int, ...]] = {
    "torso": (0, 3, 6, 9, 13, 14),
    "head": (12, 15),
    "left_thigh": (1,),
    "left_shin": (4, 7, 10),
    "right_thigh": (2,),
    "right_shin": (5, 8, 11),
    "left_upper_arm": (16,),
    "left_forearm": (18,),
    "left_hand": (20,),
    "right_upper_arm": (17,),
    "right_forearm": (19,),
    "right_hand": (21,),
}
# Joints beyond the wrists (index 22 on) by the number of joints: SMPL, SMPL-H, SMPL-X
_EXTRA: dict[int, dict[str, tuple[int, ...]]] = {
    22: {},
    24: {"left_hand": (22,), "right_hand": (23,)},
    52: {"left_hand": tuple(range(22, 37)), "right_hand": tuple(range(37, 52))},
    55: {
        "head": (22, 23, 24),
        "left_hand": tuple(range(25, 40)),
        "right_hand": tuple(range(40, 55)),
    },
}
_LEFT_LEG, _RIGHT_LEG = ("left_thigh", "left_shin"), ("right_thigh", "right_shin")
_LEFT_ARM = ("left_upper_arm", "left_forearm", "left_hand")
_RIGHT_ARM = ("right_upper_arm", "right_forearm", "right_hand")
_PRESETS: dict[str, dict[str, tuple[str, ...]]] = {
    "five": {
        "body": ("torso",),
        "legs": _LEFT_LEG + _RIGHT_LEG,
        "head": ("head",),
        "left_arm": _LEFT_ARM,
        "right_arm": _RIGHT_ARM,
    },
    "three": {
        "body": ("torso", "head"),
        "legs": _LEFT_LEG + _RIGHT_LEG,
        "arms": _LEFT_ARM + _RIGHT_ARM,
    },
    "six": {
        "body": ("torso",),
        "left_leg": _LEFT_LEG,
        "right_leg": _RIGHT_LEG,
        "head": ("head",),
        "left_arm": _LEFT_ARM,
        "right_arm": _RIGHT_ARM,
    },
    "per_limb": {
        "torso": ("torso",),
        "head": ("head",),
        "left_thigh": ("left_thigh",),
        "left_shin": ("left_shin",),
        "right_thigh": ("right_thigh",),
        "right_shin": ("right_shin",),
        "left_upper_arm": ("left_upper_arm",),
        "left_forearm": ("left_forearm", "left_hand"),
        "right_upper_arm": ("right_upper_arm",),
        "right_forearm": ("right_forearm", "right_hand"),
    },
}
_HANDS = ("left_hand", "right_hand")
APART = "+hands"
"""Ending of a preset's name that makes a part of each hand."""

# Words of joint names, in the order in which they are looked for
_WORDS: tuple[tuple[str, str], ...] = (
    ("hand", "hand|wrist|palm|thumb|index|middle|ring|pinky|little|finger|carpal|metacarpal"),
    ("forearm", "forearm|lowerarm|elbow|ulna|radius|armlower"),
    ("torso", "collar|clavicle|scapula"),
    ("upper_arm", "upperarm|armupper|uparm|humerus|arm|bicep"),
    ("thigh", "upleg|upperleg|legupper|thigh|femur"),
    ("shin", "foot|toe|toes|toebase|ankle|ball|heel|knee|shin|calf|lowerleg|leglower|tibia|leg"),
    ("head", "head|neck|jaw|eye|skull|face|tongue|teeth|ear|nose|brow|lip"),
    ("torso", "pelvis|hips|spine|chest|torso|abdomen|waist|root|breast|belly"),
)
_CHOICE = {place: re.compile(rf"^(?:{words})\d*$") for place, (_, words) in enumerate(_WORDS)}


def preset_names() -> tuple[str, ...]:
    """Names of the presets, without ``single``; each may carry the ending ``+hands``.

    Returns:
        The names.

    >>> preset_names()
    ('five', 'three', 'six', 'per_limb')
    """
    return tuple(_PRESETS)


def _regions_of_preset(name: str) -> dict[str, tuple[str, ...]]:
    base = name.removesuffix(APART)
    if base not in _PRESETS:
        known = ", ".join((*_PRESETS, "single"))
        raise InputError(
            f"parts: expected one of {known}, found {name!r}; choose one of them, "
            f"with {APART!r} behind it for a part of each hand"
        )
    if base == name:
        return _PRESETS[base]
    rest = {p: tuple(r for r in rs if r not in _HANDS) for p, rs in _PRESETS[base].items()}
    return rest | {hand: (hand,) for hand in _HANDS}


def preset_table(name: str, num_joints: int) -> dict[str, tuple[int, ...]]:
    """Joints of each part of a preset, for bodies in the order of the SMPL family.

    Args:
        name: "five", "three", "six" (legs apart), "per_limb" (limb segments apart), any of them
            with "+hands" behind it (each hand a part of its own), or "single".
        num_joints: 24 (SMPL), 22, 52 (SMPL-H) or 55 (SMPL-X); any for "single".

    Returns:
        Part name → joints; every joint is in exactly one part.

    Raises:
        InputError: unknown name, or no table for this number of joints.

    >>> preset_table("three", 22)["arms"]
    (16, 18, 20, 17, 19, 21)
    """
    if name == "single":
        return {"whole": tuple(range(num_joints))}
    regions = _regions_of_preset(name)
    if num_joints not in _EXTRA:
        raise InputError(
            f"parts: expected a body of {', '.join(map(str, _EXTRA))} joints for {name!r}, "
            f"found {num_joints}; use 'single' or PartMap.from_table"
        )
    extra = _EXTRA[num_joints]
    return {
        part: tuple(joint for r in wanted for joint in _REGIONS[r] + extra.get(r, ()))
        for part, wanted in regions.items()
    }


def _tokens(name: str) -> list[str]:
    """Lower-case words of a joint name, its prefix before a colon dropped."""
    bare = re.sub(r"([a-z])([A-Z])", r"\1 \2", name.rpartition(":")[2])
    return [word for word in re.split(r"[^A-Za-z0-9]+", bare.lower()) if word]


def _side(tokens: list[str]) -> str:
    for side, marks in (("left_", ("left", "l", "lft")), ("right_", ("right", "r", "rgt"))):
        if any(token in marks for token in tokens):
            return side
    return ""


def _pairs(tokens: list[str]) -> list[str]:
    """Joined neighbours first, so that "up leg" is found before "leg"."""
    joined = [a + b for a, b in itertools.pairwise(tokens)]
    return joined + [re.sub(r"^(left|right)", "", token) for token in tokens]


def _region_of_name(name: str, shoulder_is_arm: bool) -> str | None:
    tokens = _tokens(name)
    side, words = _side(tokens), _pairs(tokens)
    if not side:  # "leftarm" in one word
        side = next((f"{s}_" for s in ("left", "right") for t in tokens if t.startswith(s)), "")
    if side and any(re.match(r"^hips?\d*$", word) for word in words):
        return side + "thigh"
    if side and any(re.match(r"^shoulders?\d*$", word) for word in words):
        return side + "upper_arm" if shoulder_is_arm else "torso"
    for place, (region, _) in enumerate(_WORDS):
        if any(_CHOICE[place].match(word) for word in words):
            middle = region in ("torso", "head")
            return region if middle else side + region if side else None
    return None


def _check_skeleton(names: Sequence[str], parents: Sequence[int]) -> None:
    if len(names) != len(parents) or not names:
        raise InputError(
            f"joint names: expected one for each of {len(parents)} parents, found {len(names)}; "
            "pass the names and parents of one skeleton"
        )
    late = [j for j, parent in enumerate(parents) if not -1 <= parent < j]
    if late:
        raise InputError(
            f"parents: expected each parent before its child, or -1, found {parents[late[0]]} at "
            f"joint {late[0]}; sort the joints from the root outwards"
        )


def regions_by_name(names: Sequence[str], parents: Sequence[int]) -> tuple[str, ...]:
    """Body region of each joint of a foreign skeleton, by the words of its name.

    Knows the common rigs (SMPL, Mixamo, Unreal, Blender and similar). A name without a known word
    takes the region of its parent; a nameless root is torso. "Shoulder" is the upper arm, unless
    other joints are called arm, which makes it the collar.

    Args:
        names: names of the joints.
        parents: parent of each joint, -1 for a root; parents come before children.

    Returns:
        One of the regions torso, head, left_thigh, left_shin, left_upper_arm, left_forearm,
        left_hand and their right twins, per joint.

    Raises:
        InputError: as many names as parents are needed, parents first.

    >>> regions_by_name(["mixamorig:Hips", "mixamorig:LeftUpLeg", "Toe_End"], [-1, 0, 1])
    ('torso', 'left_thigh', 'left_shin')
    """
    _check_skeleton(names, parents)
    arm = re.compile(r"^(upper|up)?arm(upper)?\d*$")
    has_arm = any(arm.match(word) for name in names for word in _pairs(_tokens(name)))
    regions: list[str] = []
    for name, parent in zip(names, parents, strict=True):
        above = "torso" if parent < 0 else regions[parent]
        found = _region_of_name(name, not has_arm)
        if found is None:
            side = above.partition("_")[0] + " " if "_" in above else ""  # that of the parent
            found = _region_of_name(side + name.rpartition(":")[2], not has_arm) or above
        regions.append(found)
    return tuple(regions)


def table_by_name(
    preset: str, names: Sequence[str], parents: Sequence[int]
) -> dict[str, tuple[int, ...]]:
    """Joints of each part of a preset, for any skeleton whose joints are named for the body.

    Args:
        preset: as in `preset_table`.
        names: names of the joints.
        parents: parent of each joint, -1 for a root; parents come before children.

    Returns:
        Part name → joints.

    Raises:
        InputError: unknown preset, or no joint was recognised for one of its parts.

    >>> table_by_name("single", ["a", "b"], [-1, 0])
    {'whole': (0, 1)}
    """
    if preset == "single":
        return {"whole": tuple(range(len(names)))}
    wanted = _regions_of_preset(preset)
    regions = regions_by_name(names, parents)
    table = {
        part: tuple(j for j, region in enumerate(regions) if region in inside)
        for part, inside in wanted.items()
    }
    empty = [part for part, joints in table.items() if not joints]
    if empty:
        shown = ", ".join(list(names)[:8])
        raise InputError(
            f"parts: expected joint names that tell the parts of {preset!r}, found none for "
            f"{', '.join(empty)} among {shown}, …; give a table of joints per part"
        )
    return table


def joint_parts(table: Mapping[str, Sequence[int]], num_joints: int) -> tuple[int, ...]:
    """Part of each joint of a table, checked.

    Args:
        table: joints of each named part; every joint in exactly one.
        num_joints: number of joints of the body.

    Returns:
        Part of each joint, numbered in the order of the table.

    Raises:
        InputError: a joint is missing, named twice or does not exist.

    >>> joint_parts({"a": (0, 2), "b": (1,)}, 3)
    (0, 1, 0)
    """
    listed = sorted(joint for joints in table.values() for joint in joints)
    if listed != list(range(num_joints)):
        raise InputError(
            f"parts: expected each joint 0..{num_joints - 1} in exactly one part, "
            f"found {listed}; correct the table"
        )
    part_of = {joint: part for part, joints in enumerate(table.values()) for joint in joints}
    return tuple(part_of[joint] for joint in range(num_joints))


def pieces_of_joints(
    joint_part: Sequence[int], parents: Sequence[int]
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Groups of joints of one part that hang together in the skeleton.

    "Legs" are two pieces, since the pelvis between them belongs to the body; a connected part is
    one piece.

    Args:
        joint_part: part of each joint.
        parents: parent of each joint, -1 for a root; parents come before children.

    Returns:
        Piece of each joint, numbered by first joint, and the part of each piece.

    Raises:
        InputError: another number of parents, or a parent behind its child.

    >>> pieces_of_joints((0, 1, 1, 1), (-1, 0, 0, 1))
    ((0, 1, 2, 1), (0, 1, 1))
    """
    _check_skeleton([""] * len(joint_part), parents)
    piece: list[int] = []
    parts: list[int] = []
    for joint, parent in enumerate(parents):
        if parent >= 0 and joint_part[parent] == joint_part[joint]:
            piece.append(piece[parent])
        else:
            piece.append(len(parts))
            parts.append(joint_part[joint])
    return tuple(piece), tuple(parts)
