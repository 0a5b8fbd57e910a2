"""Kinematic trees and forward kinematics."""

import functools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, SupportsInt

import torch
from jaxtyping import Float
from torch import Tensor

from .backend import Backend, choose_backend
from .errors import BackendError, InputError
from .rigid import append_last_row

_UINT32_MINUS_ONE = 4294967295


@dataclass(frozen=True)
class KinematicTree:
    """Parents of the joints of a skeleton, one root, every parent before its children."""

    parents: tuple[int, ...]
    """Index of each joint's parent; −1 for the root, which is joint 0."""

    def __post_init__(self) -> None:
        """Refuse a table that is not one tree in topological order."""
        if not self.parents or self.parents[0] != -1:
            found = self.parents[:1] or "an empty table"
            raise InputError(
                f"kinematic tree: expected joint 0 to be the root (parent -1), found {found}; "
                "order the joints from the root outwards"
            )
        for joint, parent in enumerate(self.parents[1:], start=1):
            if not 0 <= parent < joint:
                raise InputError(
                    f"kinematic tree: expected the parent of joint {joint} in 0..{joint - 1}, "
                    f"found {parent}; order the joints from the one root outwards"
                )

    @classmethod
    def from_parents(cls, parents: Iterable[SupportsInt]) -> "KinematicTree":
        """Tree of a parent table; the root is marked −1 or, as in SMPL files, 4294967295.

        Args:
            parents: one parent index per joint (a sequence, an array or a tensor).

        Raises:
            InputError: the table is not one tree with parents before children.

        >>> KinematicTree.from_parents([4294967295, 0, 0]).parents
        (-1, 0, 0)
        """
        table = (int(parent) for parent in parents)
        return cls(tuple(-1 if p in (-1, _UINT32_MINUS_ONE) else p for p in table))

    @property
    def num_joints(self) -> int:
        """Number of joints, the root included."""
        return len(self.parents)

    @functools.cached_property
    def levels(self) -> tuple[tuple[int, ...], ...]:
        """Joints by their distance from the root, the root's level first."""
        depth = [0] * len(self.parents)
        for joint, parent in enumerate(self.parents[1:], start=1):
            depth[joint] = depth[parent] + 1
        return tuple(
            tuple(j for j, d in enumerate(depth) if d == level) for level in range(max(depth) + 1)
        )


@functools.lru_cache(maxsize=32)
def _level_indices(
    tree: KinematicTree, device: torch.device
) -> tuple[list[tuple[Tensor, Tensor, Tensor]], Tensor]:
    """Per level (joints, their parents, place of the parents in the level above), and the order."""
    levels = []
    for above, level in zip(tree.levels[:-1], tree.levels[1:], strict=True):
        parents = [tree.parents[j] for j in level]
        places = [above.index(p) for p in parents]
        levels.append(tuple(torch.tensor(i, device=device) for i in (level, parents, places)))
    order = [j for level in tree.levels for j in level]
    inverse = [0] * len(order)
    for place, joint in enumerate(order):
        inverse[joint] = place
    return levels, torch.tensor(inverse, device=device)


def forward_kinematics(
    tree: KinematicTree,
    rotmats: Float[Tensor, "*#b J 3 3"],
    joints: Float[Tensor, "*#b J 3"],
    backend: Backend = "auto",
) -> Float[Tensor, "*b J 4 4"]:
    """Rest-to-posed transforms of the joints: they act on points of the rest pose.

    Args:
        tree: the skeleton, J joints.
        rotmats: rotation of each joint relative to its parent, (*b, J, 3, 3).
        joints: rest positions of the joints in metres, (*b, J, 3). Batches of 1 are expanded to
            the other's.
        backend: ``warp`` (float32, one derivative, no `torch.func` transforms; one thread walks
            the tree of a body), ``torch`` (any dtype, any order; one batched product per level of
            the tree), ``auto``.

    Returns:
        Transforms, (*b, J, 4, 4): x_posed = T_j x_rest for a point fixed to joint j.
        Differentiable in `rotmats` and `joints`.

    Raises:
        InputError: the number of joints is not that of the tree.
        BackendError: ``warp`` asked for and not able to run.

    Reference:
        Loper et al. 2015 (SMPL), equation 4: G_j = Π_a [R_a | j_a − R_a j_a] over ancestors a.

    >>> tree = KinematicTree((-1, 0))
    >>> forward_kinematics(tree, torch.eye(3).expand(2, 3, 3), torch.rand(2, 3))[1, :3, 3].tolist()
    [0.0, 0.0, 0.0]
    """
    for name, found in (("rotmats", rotmats.shape[-3]), ("joints", joints.shape[-2])):
        if found != tree.num_joints:
            raise InputError(
                f"{name}: expected {tree.num_joints} joints (the tree's), found {found}; "
                "pass one rotation and one position per joint"
            )
    if rotmats.dtype != joints.dtype:
        raise InputError(
            f"joints: expected {rotmats.dtype} as the rotations, found {joints.dtype}; convert one"
        )
    if choose_backend(backend, rotmats) == "torch":
        return _chain_torch(tree, rotmats, joints)
    batch = torch.broadcast_shapes(rotmats.shape[:-3], joints.shape[:-2])
    rotmats, joints = rotmats.expand(*batch, -1, -1, -1), joints.expand(*batch, -1, -1)
    return _WarpChain.apply(rotmats, joints, _parent_table(tree, rotmats.device))


def _chain_torch(tree: KinematicTree, rotmats: Tensor, joints: Tensor) -> Tensor:
    """One batched product per level of the tree: the twin of the kernels."""
    levels, order = _level_indices(tree, rotmats.device)
    # x → R_j (x − j_j) + j_j fixes the joint: offsets stay small, so float32 loses little
    offsets = joints - (rotmats @ joints[..., None]).squeeze(-1)
    rotation, translation = rotmats[..., :1, :, :], offsets[..., :1, :]
    rotations, translations = [rotation], [translation]
    for level, _, places in levels:
        above = rotation.index_select(-3, places)
        step = above @ offsets.index_select(-2, level)[..., None]
        translation = step.squeeze(-1) + translation.index_select(-2, places)
        rotation = above @ rotmats.index_select(-3, level)
        rotations.append(rotation)
        translations.append(translation)
    linear = torch.cat(rotations, dim=-3).index_select(-3, order)
    shift = torch.cat(translations, dim=-2).index_select(-2, order)
    return append_last_row(torch.cat((linear, shift[..., None]), dim=-1))


@functools.lru_cache(maxsize=32)
def _parent_table(tree: KinematicTree, device: torch.device) -> Tensor:
    return torch.tensor(tree.parents, dtype=torch.int32, device=device)


class _WarpChain(torch.autograd.Function):
    """Forward kinematics and its first derivative on the Warp kernels."""

    @staticmethod
    def forward(ctx: Any, rotmats: Tensor, joints: Tensor, parents: Tensor) -> Tensor:
        from .kernels.kinematics import chain
        from .kernels.launch import launch, view

        rotmats, joints = rotmats.contiguous(), joints.contiguous()
        transforms = rotmats.new_empty(*rotmats.shape[:-2], 4, 4)
        args = [view(rotmats.view(-1, 3), 3), view(joints.view(-1, 3), 3), view(parents)]
        args += [view(transforms.view(-1, 4), 4)]
        launch(chain, rotmats.shape[:-3].numel(), args, rotmats)
        ctx.save_for_backward(rotmats, joints, parents, transforms)
        return transforms

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        from .kernels.kinematics import chain_gradient
        from .kernels.launch import launch, view

        if torch.is_grad_enabled():
            raise BackendError(
                "forward kinematics: the warp back end has no second derivative "
                "(create_graph=True); pass backend='torch'"
            )
        rotmats, joints, parents, transforms = ctx.saved_tensors
        carried = cotangents[0].clone(memory_format=torch.contiguous_format)
        grads = torch.empty_like(rotmats), torch.empty_like(joints)
        args = [view(t.view(-1, 3), 3) for t in (rotmats, joints)] + [view(parents)]
        args += [view(t.view(-1, 4), 4) for t in (transforms, carried)]
        args += [view(g.view(-1, 3), 3) for g in grads]
        launch(chain_gradient, rotmats.shape[:-3].numel(), args, rotmats)
        return *grads, None
