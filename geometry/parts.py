"""Division of a body into parts, by the joint that moves each vertex most."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

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
    "left_forearm": (18, 20),
    "right_upper_arm": (17,),
    "right_forearm": (19, 21),
}
# Joints beyond the wrists (index 22 on) by the number of joints: SMPL, SMPL-H, SMPL-X
_EXTRA: dict[int, dict[str, tuple[int, ...]]] = {
    22: {},
    24: {"left_forearm": (22,), "right_forearm": (23,)},
    52: {"left_forearm": tuple(range(22, 37)), "right_forearm": tuple(range(37, 52))},
    55: {
        "head": (22, 23, 24),
        "left_forearm": tuple(range(25, 40)),
        "right_forearm": tuple(range(40, 55)),
    },
}
_LEFT_LEG, _RIGHT_LEG = ("left_thigh", "left_shin"), ("right_thigh", "right_shin")
_LEFT_ARM = ("left_upper_arm", "left_forearm")
_RIGHT_ARM = ("right_upper_arm", "right_forearm")
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
    "per_limb": {region: (region,) for region in _REGIONS},
}


@dataclass(frozen=True)
class PartMap:
    """Which part each joint belongs to; parts are numbered from 0 and every part has a joint."""

    joint_part: tuple[int, ...]
    """Part of each joint."""
    names: tuple[str, ...]
    """Name of each part."""

    def __post_init__(self) -> None:
        """Refuse a table that names parts which do not exist, or leaves one empty."""
        used, wanted = set(self.joint_part), set(range(len(self.names)))
        if used != wanted:
            raise InputError(
                f"joint_part: expected every part 0..{len(self.names) - 1} to hold a joint and no "
                f"others, found parts {sorted(used)}; give one name per part in use"
            )

    @classmethod
    def default(cls, num_joints: int = 24) -> "PartMap":
        """The five parts body, legs, head, left arm, right arm.

        Args:
            num_joints: 24 (SMPL), 22, 52 (SMPL-H) or 55 (SMPL-X).

        Raises:
            InputError: another number of joints.

        >>> PartMap.default().names
        ('body', 'legs', 'head', 'left_arm', 'right_arm')
        """
        return cls.preset("five", num_joints)

    @classmethod
    def preset(cls, name: str, num_joints: int = 24) -> "PartMap":
        """A division by its name.

        Args:
            name: "five", "three", "six" (legs apart), "per_limb" (limb segments apart) or "single".
            num_joints: 24 (SMPL), 22, 52 (SMPL-H) or 55 (SMPL-X); any for "single".

        Raises:
            InputError: unknown name, or no table for this number of joints.

        >>> PartMap.preset("single", 3).joint_part
        (0, 0, 0)
        """
        if name == "single":
            return cls((0,) * num_joints, ("whole",))
        if name not in _PRESETS:
            known = ", ".join((*_PRESETS, "single"))
            raise InputError(f"parts: expected one of {known}, found {name!r}; choose one of them")
        if num_joints not in _EXTRA:
            raise InputError(
                f"parts: expected a body of {', '.join(map(str, _EXTRA))} joints for {name!r}, "
                f"found {num_joints}; use 'single' or PartMap.from_table"
            )
        table = {
            part: tuple(
                joint
                for region in regions
                for joint in _REGIONS[region] + _EXTRA[num_joints].get(region, ())
            )
            for part, regions in _PRESETS[name].items()
        }
        return cls.from_table(table, num_joints)

    @classmethod
    def from_table(cls, table: Mapping[str, tuple[int, ...]], num_joints: int) -> "PartMap":
        """A division given as the joints of each named part.

        Args:
            table: joints of each part; every joint in exactly one.
            num_joints: number of joints of the body.

        Raises:
            InputError: a joint is missing, named twice or does not exist.

        >>> PartMap.from_table({"a": (0, 2), "b": (1,)}, 3).joint_part
        (0, 1, 0)
        """
        listed = sorted(joint for joints in table.values() for joint in joints)
        if listed != list(range(num_joints)):
            raise InputError(
                f"parts: expected each joint 0..{num_joints - 1} in exactly one part, "
                f"found {listed}; correct the table"
            )
        part_of = {joint: part for part, joints in enumerate(table.values()) for joint in joints}
        return cls(tuple(part_of[joint] for joint in range(num_joints)), tuple(table))

    @property
    def num_parts(self) -> int:
        """Number of parts."""
        return len(self.names)

    def joints_of(self, part: int) -> tuple[int, ...]:
        """Joints of a part, ascending.

        >>> PartMap.default().joints_of(2)
        (12, 15)
        """
        return tuple(joint for joint, p in enumerate(self.joint_part) if p == part)

    def vertex_parts(self, weights: Float[Tensor, "V J"]) -> Int[Tensor, "V"]:
        """Part of each vertex: that of its joint of largest weight (the first of equals).

        Args:
            weights: skinning weights, (V, J).

        Returns:
            Part indices, (V), int64.

        Raises:
            InputError: the number of joints is not that of this map.
        """
        return self._joint_part(weights)[weights.argmax(-1)]

    def face_parts(
        self, weights: Float[Tensor, "V J"], faces: Int[Tensor, "F 3"]
    ) -> Int[Tensor, "F"]:
        """Part of each face: that of most of its corners.

        Corners of three different parts give the part whose joints weigh most over the three.

        Args:
            weights: skinning weights, (V, J).
            faces: vertex indices, (F, 3).

        Returns:
            Part indices, (F), int64.

        Raises:
            InputError: the number of joints is not that of this map.
        """
        table = self._joint_part(weights)
        one_hot = torch.nn.functional.one_hot(table, self.num_parts).to(weights)
        votes = torch.nn.functional.one_hot(self.vertex_parts(weights)[faces], self.num_parts)
        share = (weights @ one_hot)[faces].sum(1)
        # votes are whole numbers and shares of weight are scaled below 1, so they only break ties
        return (votes.sum(1) + share / (2 * share.sum(-1, keepdim=True))).argmax(-1)

    def _joint_part(self, weights: Tensor) -> Tensor:
        if weights.shape[-1] != len(self.joint_part):
            raise InputError(
                f"weights: expected {len(self.joint_part)} joints (the part map's), found "
                f"{weights.shape[-1]}; make the part map for this body"
            )
        return torch.tensor(self.joint_part, device=weights.device)


def rows_of_parts(part: Int[Tensor, "m"], num_parts: int) -> tuple[int, ...]:
    """Number of rows of each part, where rows are sorted by part; waits once for the device.

    Args:
        part: part of each row, ascending.
        num_parts: number of parts.

    Returns:
        One number per part.

    >>> rows_of_parts(torch.tensor([0, 0, 2]), 4)
    (2, 0, 1, 0)
    """
    edges = torch.arange(num_parts + 1, device=part.device, dtype=part.dtype)
    ends = torch.searchsorted(part.contiguous(), edges).tolist()
    return tuple(end - start for start, end in itertools.pairwise(ends))
