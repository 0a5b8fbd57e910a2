"""How points that are skinned to a body move when its joints turn: the Jacobian in closed form."""

import torch
from jaxtyping import Float
from torch import Tensor

from .errors import InputError
from .kinematics import KinematicTree


def descendants(tree: KinematicTree) -> Float[Tensor, "j j"]:
    """Which joints a joint carries.

    Args:
        tree: the joints.

    Returns:
        Entry [k, j] is 1 where k is j or comes after it, else 0.

    >>> descendants(KinematicTree((-1, 0, 0)))
    tensor([[1., 0., 0.],
            [1., 1., 0.],
            [1., 0., 1.]])
    """
    carried = torch.eye(tree.num_joints)
    for joint, parent in enumerate(tree.parents[1:], start=1):
        carried[joint] += carried[parent]
    return carried


def joint_motion(
    rest: Float[Tensor, "n 3"],
    weights: Float[Tensor, "n j"],
    transforms: Float[Tensor, "k 4 4"],
    joints: Float[Tensor, "c 3"],
    tree: KinematicTree,
) -> Float[Tensor, "n j 3 3"]:
    """Derivative of posed points by small turns of each joint, in the axes of its parent.

    A turn δ of joint j replaces its rotation R by R(δ) R; the skinning weights are held. Exact for
    linear blend skinning x = Σ_k w_k T_k x̄ (SMPL, Loper et al. 2015, eq. 6), folded or not:
    ∂x/∂δ_j is the cross product with Σ_k w_k (T_k x̄ − c_j) over the joints k that j carries, c_j
    the posed joint.

    Args:
        rest: points in the rest pose, metres.
        weights: their skinning weights; rows sum to 1.
        transforms: joint transforms from the rest pose to the pose.
        joints: posed joints, local, metres.
        tree: their parents.

    Returns:
        [n, joint, axis, xyz] metres per radian. The root's axes are those of the local frame.

    Raises:
        InputError: another number of joints.
    """
    count = tree.num_joints
    if not weights.shape[1] == len(transforms) == len(joints) == count:
        raise InputError(
            f"weights, transforms, joints: expected {count} joints (the tree's), found "
            f"{weights.shape[1]}, {len(transforms)} and {len(joints)}; take them of one body"
        )
    carried = descendants(tree).to(rest)
    moved = torch.einsum("kab,nb->nka", transforms[:, :3, :3], rest) + transforms[:, :3, 3]
    lever = torch.einsum("nka,kj->nja", weights[..., None] * moved, carried)
    lever = lever - (weights @ carried)[..., None] * joints
    parents = torch.tensor([max(parent, 0) for parent in tree.parents], device=rest.device)
    axes = transforms[parents, :3, :3].mT.clone()  # rows: the parent's axes
    axes[0] = torch.eye(3).to(axes)
    return torch.linalg.cross(axes.expand(len(rest), -1, -1, -1), lever[:, :, None])
