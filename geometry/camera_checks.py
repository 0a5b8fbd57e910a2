"""What a camera must be: checks and intrinsics that `cameras` applies on construction."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from .errors import InputError
from .lenses import check_lens
from .norms import brought_to_one


def check_size(size: tuple[int, int]) -> None:
    """Refuses sizes that are not two positive whole numbers.

    Args:
        size: (height, width) in pixels.

    Raises:
        InputError: anything else.
    """
    if len(size) != 2 or any(int(n) != n or n <= 0 for n in size):
        raise InputError(f"size: expected positive (height, width), found {size}; give pixels")


def intrinsics_from_fov(ref: Tensor, size: tuple[int, int], fov: float) -> Float[Tensor, "3 3"]:
    """Centred intrinsics with square pixels.

    Args:
        ref: a tensor whose dtype and device the result takes.
        size: (height, width) in pixels.
        fov: vertical field of view, radians.

    Returns:
        K in pixels, for pixel centres at +½, 3 3.

    Raises:
        InputError: a field of view outside (0, π) or a bad size.

    >>> round(float(intrinsics_from_fov(torch.zeros(1), (2, 4), math.pi / 2)[0, 0]), 5)
    1.0
    """
    check_size(size)
    if not 0 < fov < math.pi:
        raise InputError(f"fov: expected radians between 0 and π, found {fov}; convert degrees")
    focal = size[0] / (2 * math.tan(fov / 2))
    return ref.new_tensor([[focal, 0, size[1] / 2], [0, focal, size[0] / 2], [0, 0, 1]])


def look_at_rotation(
    eye: Float[Tensor, "3"], target: Float[Tensor, "3"], up: Float[Tensor, "3"]
) -> Float[Tensor, "3 3"]:
    """Rotation world → camera of a view from one point to another.

    Args:
        eye: camera centre, world metres, 3.
        target: point seen along the optical axis, world metres, 3.
        up: direction that points up in the image, world axes, any length, 3.

    Returns:
        R, 3 3, differentiable in all three.

    Raises:
        InputError: a target at the eye, up along the view.

    >>> y, z = torch.tensor([0.0, 1, 0]), torch.tensor([0.0, 0, 1])
    >>> look_at_rotation(torch.zeros(3), y, z).tolist()
    [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    """
    # lengths of the view and of up do not matter: without them no square overflows or vanishes
    forward, upwards = brought_to_one(target - eye), brought_to_one(up)
    right = torch.linalg.cross(forward, upwards)
    sine = right.detach().norm() / (forward.norm() * upwards.norm()).detach()
    if not float(sine) > 1e-6:
        raise InputError(
            f"look_at: expected up not along the view, found up {up.tolist()} and view "
            f"{(target - eye).tolist()}; move the target or choose another up"
        )
    z = forward / forward.norm()
    x = right / right.norm()
    return torch.stack([x, torch.linalg.cross(z, x), z])


def check_camera(
    K: Tensor, R: Tensor, t: Tensor, size: tuple[int, int], distortion: Tensor, lens: str = "brown"
) -> None:
    """Refuses cameras that cannot project.

    Args:
        K: intrinsics, 3 3.
        R: rotation world → camera, 3 3.
        t: translation, 3.
        size: (height, width) in pixels.
        distortion: coefficients in OpenCV's order, d.
        lens: kind of lens.

    Raises:
        InputError: as `Camera` says.
    """
    shapes = {"K": (3, 3), "R": (3, 3), "t": (3,), "distortion": (distortion.numel(),)}
    for name, value in {"K": K, "R": R, "t": t, "distortion": distortion}.items():
        shape = tuple(value.shape)
        if shape != shapes[name]:
            raise InputError(f"{name}: expected shape {shapes[name]}, found {shape}; reshape it")
        if not value.is_floating_point() or not bool(torch.isfinite(value).all()):
            raise InputError(f"{name}: expected finite floats, found {value.tolist()}; check it")
        if value.numel() and (value.dtype, value.device) != (K.dtype, K.device):
            raise InputError(
                f"{name}: expected {K.dtype} on {K.device} as K has, found "
                f"{value.dtype} on {value.device}; convert it"
            )
    check_size(size)
    check_lens(lens, distortion.numel())
    _check_rotation(R.detach())
    _check_intrinsics(K.detach().tolist())


def _check_rotation(R: Tensor) -> None:
    """Refuses reflections and matrices that are off orthonormal by more than 1e-3."""
    error = float((R @ R.mT - torch.eye(3).to(R)).abs().max())
    det = float(torch.linalg.det(R))
    if error > 1e-3 or det < 0:
        raise InputError(
            f"R: expected a rotation within 1e-3, found an error of {error:.2g} and determinant "
            f"{det:.3g}; orthonormalise it"
        )


def _check_intrinsics(K: list[list[float]]) -> None:
    """Refuses matrices that are not upper triangular with positive focal lengths."""
    lower = max(abs(K[1][0]), abs(K[2][0]), abs(K[2][1]), abs(K[2][2] - 1))
    if lower > 0 or K[0][0] <= 0 or K[1][1] <= 0:
        raise InputError(
            f"K: expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with positive fx, fy, found {K}; "
            f"divide it by its last entry or flip the axes in R"
        )
