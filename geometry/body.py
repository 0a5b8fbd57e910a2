"""Parametric bodies in SMPL form: shape, pose, linear blend skinning, placement in the world."""

import functools
import importlib.resources
from dataclasses import dataclass, field
from os import PathLike

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from .backend import Backend
from .body_io import BodyArrays, read_body
from .errors import InputError
from .kinematics import KinematicTree, forward_kinematics
from .rotations import axis_angle_to_rotmat
from .skinning import SkinWeights, blend_skin, skin
from .uv import UVMap

BIG_POSE_HIP_ANGLE = np.pi / 6
"""Angle about z of the hips in the canonical pose, radians: joint 1 turns by +, joint 2 by −."""


@dataclass(frozen=True, eq=False)
class BodyPose:
    """Pose, shape and placement of a body; a world point is w = R(rotation)·p + translation."""

    pose: Float[Tensor, "*b J 3"]
    """Axis-angle of each joint relative to its parent, radians."""
    betas: Float[Tensor, "*b B"]
    """Shape coefficients; may be fewer than the body has."""
    rotation: Float[Tensor, "*b 3"]
    """Rh: axis-angle of the whole body about the local origin (not about the pelvis), radians."""
    translation: Float[Tensor, "*b 3"]
    """Th, metres."""

    @classmethod
    def zeros(cls, body: "BodyModel", batch: tuple[int, ...] = ()) -> "BodyPose":
        """Rest pose, mean shape, at the local origin; device and dtype are the body's."""
        make = functools.partial(body.v_template.new_zeros)
        return cls(
            pose=make((*batch, body.num_joints, 3)),
            betas=make((*batch, body.num_betas)),
            rotation=make((*batch, 3)),
            translation=make((*batch, 3)),
        )

    def to(self, ref: Tensor) -> "BodyPose":
        """The same pose on a tensor's device and in its float dtype."""
        return BodyPose(
            self.pose.to(ref), self.betas.to(ref), self.rotation.to(ref), self.translation.to(ref)
        )


@dataclass(frozen=True, eq=False)
class PosedBody:
    """A posed body in local pose space (before Rh and Th) and its placement in the world."""

    verts: Float[Tensor, "*b V 3"]
    """Posed vertices, metres, local; pose blend shapes are part of them."""
    joints: Float[Tensor, "*b J 3"]
    """Posed joints, metres, local."""
    transforms: Float[Tensor, "*b J 4 4"]
    """Joint transforms from the shaped rest pose to pose space; without pose blend shapes."""
    rotation: Float[Tensor, "*b 3 3"]
    """R(Rh)."""
    translation: Float[Tensor, "*b 3"]
    """Th, metres."""

    @property
    def verts_world(self) -> Float[Tensor, "*b V 3"]:
        """Posed vertices in the world, metres."""
        return self.to_world(self.verts)

    def to_world(self, points: Float[Tensor, "*b N 3"]) -> Float[Tensor, "*b N 3"]:
        """World points of local points, metres: w = R p + t; differentiable."""
        return points @ self.rotation.mT + self.translation[..., None, :]

    def to_local(self, points: Float[Tensor, "*b N 3"]) -> Float[Tensor, "*b N 3"]:
        """Local points of world points, metres: p = Rᵀ (w − t); differentiable."""
        return (points - self.translation[..., None, :]) @ self.rotation


@dataclass(frozen=True, eq=False)
class BodyModel:
    """Static tensors of a body in SMPL form; call it with a `BodyPose`."""

    v_template: Float[Tensor, "V 3"]
    """Rest vertices of the mean shape, metres; y up, +x the subject's left, z front."""
    faces: Int[Tensor, "F 3"]
    """Vertex indices of the triangles, int64."""
    weights: Float[Tensor, "V J"]
    """Skinning weights; rows sum to 1."""
    tree: KinematicTree
    """Parents of the joints."""
    joint_regressor: Float[Tensor, "J V"]
    """Rest joints as linear combinations of the shaped vertices."""
    shapedirs: Float[Tensor, "V 3 B"]
    """Vertex offsets per shape coefficient, metres."""
    posedirs: Float[Tensor, "V 3 P"]
    """Vertex offsets per entry of R_j − I of the joints but the root, P = 9 (J − 1), metres."""
    uv: UVMap | None = None
    """Texture coordinates per face corner, or None."""
    joint_names: tuple[str, ...] = ()
    """Names of the joints."""
    _copies: dict[tuple[torch.device, torch.dtype], "BodyModel"] = field(
        default_factory=dict, init=False, repr=False
    )

    @classmethod
    def default(cls) -> "BodyModel":
        """The free body that ships with the package (24 joints in the SMPL order, float32)."""
        return _default_body()

    @classmethod
    def load(cls, path: str | PathLike[str]) -> "BodyModel":
        """Body of an SMPL, SMPL-H or SMPL-X file, `.npz` or `.pkl`; nothing in it is executed.

        Hand components, landmarks and the like are ignored. In SMPL-X files the expression
        directions follow the shape directions, so betas longer than the shape part reach them.

        Args:
            path: the file.

        Returns:
            The body in float32 on the CPU.

        Raises:
            InputError: missing or damaged file, code in a pickle, arrays that do not agree.
        """
        return cls.from_arrays(read_body(path))

    @classmethod
    def from_arrays(cls, arrays: BodyArrays) -> "BodyModel":
        """Body of checked arrays, in float32 on the CPU."""

        def single(array: np.ndarray) -> Tensor:
            return torch.from_numpy(array.astype(np.float32))

        return cls(
            v_template=single(arrays.v_template),
            faces=torch.from_numpy(arrays.faces),
            weights=single(arrays.weights),
            tree=arrays.tree,
            joint_regressor=single(arrays.joint_regressor),
            shapedirs=single(arrays.shapedirs),
            posedirs=single(arrays.posedirs),
            uv=None if arrays.corner_uv is None else UVMap(single(arrays.corner_uv)),
            joint_names=arrays.joint_names,
        )

    @property
    def num_verts(self) -> int:
        """Number of vertices."""
        return self.v_template.shape[0]

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return self.tree.num_joints

    @property
    def num_betas(self) -> int:
        """Number of shape coefficients."""
        return self.shapedirs.shape[-1]

    @functools.cached_property
    def has_pose_blend_shapes(self) -> bool:
        """Whether any pose blend shape is not zero; they are skipped, exactly, where none is."""
        return bool(self.posedirs.any())

    @functools.cached_property
    def _rest_joints(self) -> tuple[Tensor, Tensor]:
        """Joints of the mean shape (J, 3) and their change per coefficient (J, 3, B)."""
        # summed in float64 once: thousands of float32 terms would cost the last digits of a joint
        regressor = self.joint_regressor.double()
        mean = regressor @ self.v_template.double()
        change = (regressor @ self.shapedirs.double().flatten(1)).unflatten(1, (3, -1))
        return mean.to(self.v_template), change.to(self.v_template)

    @functools.cached_property
    def _shape_rows(self) -> Tensor:
        """Static shape directions as rows (B, 3 V): the backward takes half the time."""
        return self.shapedirs.detach().flatten(0, 1).mT.contiguous()

    @functools.cached_property
    def _skin_weights(self) -> SkinWeights:
        return SkinWeights(self.weights)

    def to(self, ref: Tensor) -> "BodyModel":
        """The same body on a tensor's device and in its float dtype; copies are kept."""
        key = (ref.device, ref.dtype)
        if key == (self.v_template.device, self.v_template.dtype):
            return self
        if key not in self._copies:
            self._copies[key] = BodyModel(
                v_template=self.v_template.to(ref),
                faces=self.faces.to(ref.device),
                weights=self.weights.to(ref),
                tree=self.tree,
                joint_regressor=self.joint_regressor.to(ref),
                shapedirs=self.shapedirs.to(ref),
                posedirs=self.posedirs.to(ref),
                uv=None if self.uv is None else self.uv.to(ref),
                joint_names=self.joint_names,
            )
        return self._copies[key]

    def shaped(
        self, betas: Float[Tensor, "*b B"]
    ) -> tuple[Float[Tensor, "*b V 3"], Float[Tensor, "*b J 3"]]:
        """Rest vertices and joints of a shape.

        Args:
            betas: shape coefficients, (*b, B); at most as many as the body has, the rest are zero.

        Returns:
            Vertices (*b, V, 3) and joints (*b, J, 3) of the rest pose, metres; differentiable.

        Raises:
            InputError: more coefficients than the body has.
        """
        count = betas.shape[-1]
        if count > self.num_betas:
            raise InputError(
                f"betas: expected at most {self.num_betas} shape coefficients (the body's), "
                f"found {count}; cut them or load a body with more"
            )
        body = self.to(betas)
        joints, joint_dirs = body._rest_joints
        fitted = body.shapedirs.requires_grad
        rows = body.shapedirs.flatten(0, 1).mT if fitted else body._shape_rows
        verts = _combine(body.v_template, rows[:count], betas)
        return verts, _combine(joints, joint_dirs.flatten(0, 1).mT[:count], betas)

    def __call__(self, pose: BodyPose, backend: Backend = "auto") -> PosedBody:
        """Pose the body.

        Args:
            pose: J joints, any batch; device and dtype of the result are those of `pose.pose`.
            backend: ``warp`` (float32, one derivative), ``torch`` (any dtype, any order), ``auto``.

        Returns:
            The posed body in local space, with its placement; differentiable in every field.

        Raises:
            InputError: joints or shape coefficients do not fit the body.
            BackendError: ``warp`` asked for and not able to run.

        Reference:
            Loper et al. 2015 (SMPL), equations 2 to 9.

        >>> body = BodyModel.default()
        >>> posed = body(BodyPose.zeros(body))
        >>> torch.allclose(posed.verts, body.v_template, atol=1e-6)
        True
        """
        if pose.pose.shape[-2] != self.num_joints:
            raise InputError(
                f"pose: expected {self.num_joints} joints (the body's), found "
                f"{pose.pose.shape[-2]}; pass one axis-angle per joint, the root included"
            )
        body = self.to(pose.pose)
        verts, rest_joints = body.shaped(pose.betas)
        rotmats = axis_angle_to_rotmat(pose.pose)
        transforms = forward_kinematics(body.tree, rotmats, rest_joints, backend)
        if body.has_pose_blend_shapes:
            identity = torch.eye(3, dtype=rotmats.dtype, device=rotmats.device)
            feature = (rotmats[..., 1:, :, :] - identity).flatten(-3)
            verts = verts + (feature @ body.posedirs.flatten(0, 1).mT).view_as(verts)
        return PosedBody(
            verts=blend_skin(verts, transforms, body._skin_weights, backend),
            joints=skin(rest_joints, transforms),
            transforms=transforms,
            rotation=axis_angle_to_rotmat(pose.rotation),
            translation=pose.translation,
        )

    def canonical(self, betas: Float[Tensor, "*b B"]) -> PosedBody:
        """The body in the canonical "big pose": zero but for the hips, turned ±30° about z.

        Args:
            betas: shape coefficients, (*b, B).

        Returns:
            The posed body at the local origin; a body of fewer than three joints stays at rest.
        """
        batch = betas.shape[:-1]
        pose = betas.new_zeros((*batch, self.num_joints, 3))
        if self.num_joints >= 3:
            pose[..., 1, 2] = BIG_POSE_HIP_ANGLE
            pose[..., 2, 2] = -BIG_POSE_HIP_ANGLE
        still = betas.new_zeros((*batch, 3))
        return self(BodyPose(pose=pose, betas=betas, rotation=still, translation=still))


def convert_smplx_translation(
    rotation: Float[Tensor, "*b 3"],
    translation: Float[Tensor, "*b 3"],
    pelvis: Float[Tensor, "*b 3"],
    inverse: bool = False,
) -> Float[Tensor, "*b 3"]:
    """Th of the translation of the smplx package, which turns the body about the pelvis.

    smplx places a body as w = R (p − pelvis) + pelvis + transl; here w = R p + Th.

    Args:
        rotation: global orientation, axis-angle in radians, (*b, 3); the same in both.
        translation: smplx `transl` in metres, (*b, 3), or Th where `inverse`.
        pelvis: rest position of the root joint of the shaped body, metres, (*b, 3).
        inverse: convert Th to `transl` instead.

    Returns:
        Th (or `transl`) in metres, (*b, 3); differentiable.

    >>> zero = torch.zeros(3)
    >>> convert_smplx_translation(zero, torch.ones(3), torch.rand(3)).tolist()
    [1.0, 1.0, 1.0]
    """
    turned = (axis_angle_to_rotmat(rotation) @ pelvis[..., None]).squeeze(-1)
    shift = pelvis - turned
    return translation - shift if inverse else translation + shift


def _combine(base: Tensor, rows: Tensor, coefficients: Tensor) -> Tensor:
    """Vectors (*b, V, 3) of a mean (V, 3), directions (B, 3 V) and coefficients (*b, B)."""
    # the small terms are summed first: a product that starts from the mean rounds at its size
    return base + (coefficients @ rows).unflatten(-1, base.shape)


@functools.cache
def _default_body() -> BodyModel:
    asset = importlib.resources.files("monopart.geometry") / "assets" / "body.npz"
    with importlib.resources.as_file(asset) as path:
        return BodyModel.load(path)
