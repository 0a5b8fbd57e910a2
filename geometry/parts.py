"""Division of a body into parts, by the joint that moves each vertex most."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from .errors import InputError
from .part_tables import joint_parts, pieces_of_joints, preset_table, table_by_name


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
            name: "five", "three", "six" (legs apart), "per_limb" (limb segments apart), any of them
                with "+hands" behind it (each hand a part of its own), or "single".
            num_joints: 24 (SMPL), 22, 52 (SMPL-H) or 55 (SMPL-X); any for "single".

        Raises:
            InputError: unknown name, or no table for this number of joints.

        >>> PartMap.preset("single", 3).joint_part
        (0, 0, 0)
        """
        return cls.from_table(preset_table(name, num_joints), num_joints)

    @classmethod
    def by_name(cls, preset: str, names: Sequence[str], parents: Sequence[int]) -> "PartMap":
        """A preset for any skeleton whose joints are named for the body (Mixamo and the like).

        Args:
            preset: as in `preset`.
            names: names of the joints.
            parents: parent of each joint, -1 for a root; parents come before children.

        Raises:
            InputError: unknown preset, or no joint was recognised for one of its parts.

        >>> PartMap.by_name("three", ["Hips", "LeftLeg", "RightArm"], [-1, 0, 0]).joint_part
        (0, 1, 2)
        """
        return cls.from_table(table_by_name(preset, names, parents), len(names))

    @classmethod
    def from_table(cls, table: Mapping[str, Sequence[int]], num_joints: int) -> "PartMap":
        """A division given as the joints of each named part.

        Args:
            table: joints of each part; every joint in exactly one.
            num_joints: number of joints of the body.

        Raises:
            InputError: a joint is missing, named twice or does not exist.

        >>> PartMap.from_table({"a": (0, 2), "b": (1,)}, 3).joint_part
        (0, 1, 0)
        """
        return cls(joint_parts(table, num_joints), tuple(table))

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

    def clean(
        self,
        weights: Float[Tensor, "V J"],
        verts: Float[Tensor, "V 3"],
        faces: Int[Tensor, "F 3"],
        parents: Sequence[int],
        smoothing: float | None = None,
    ) -> tuple[Int[Tensor, "F"], Int[Tensor, "V"]]:
        """Parts without islands and with short borders, the same left and right.

        Joints of a part that hang together in the skeleton keep one connected piece each: the legs
        are two. Left and right are equal where the mesh is symmetric in x = 0.

        Args:
            weights: skinning weights, (V, J).
            verts: rest vertices, metres, (V, 3); +x is the subject's left.
            faces: vertex indices, (F, 3).
            parents: parent of each joint, -1 for a root (`body.tree.parents`).
            smoothing: width over which a border may move to become shorter, metres; None is a
                hundredth of the diagonal of the mesh, 0 only removes islands.

        Returns:
            Part of each face (F) and of each vertex (V), int64; constants for autograd.

        Raises:
            InputError: numbers of joints do not agree, numbers are not finite, faces are missing.

        >>> from monopart.geometry import BodyModel
        >>> body = BodyModel.default()
        >>> face, _ = PartMap.default().clean(
        ...     body.weights, body.v_template, body.faces, body.tree.parents
        ... )
        >>> sorted(set(face.tolist()))
        [0, 1, 2, 3, 4]
        """
        from .part_cleaning import clean_face_labels, label_shares, vertex_labels

        def plain(tensor: Tensor) -> np.ndarray:
            array = tensor.detach().cpu()
            return (array.double() if array.is_floating_point() else array.long()).numpy()

        piece, part = pieces_of_joints(self.joint_part, parents)
        points, corners = plain(verts), plain(faces)
        shares = label_shares(plain(weights), piece, len(part))[corners].mean(1)
        label = clean_face_labels(shares, points, corners, smoothing)
        vertex = vertex_labels(label, points, corners, len(part))
        table = torch.tensor(part, device=weights.device)
        rows = [torch.from_numpy(x).to(weights.device) for x in (label, vertex)]
        return table[rows[0]], table[rows[1]]

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
