"""Rotations as axis-angle vectors, matrices and quaternions (w first), safe to differentiate.

Every map uses a power series where its closed form is 0/0, so that values and gradients are finite
and accurate at the identity and next to half turns.
"""

import torch
from jaxtyping import Float
from torch import Tensor

# sin(s)/s and asin(s)/s as polynomials of s², accurate to float64 inside the switch points below
_SINC_SERIES = (1.0, -1 / 6, 1 / 120, -1 / 5040, 1 / 362880, -1 / 39916800, 1 / 6227020800)
_SINC_SWITCH = 0.25
_ASINC_SERIES = (1.0, 1 / 6, 3 / 40, 15 / 336, 105 / 3456, 945 / 42240)
_ASINC_SWITCH = 1e-3


def _series(x: Tensor, coefficients: tuple[float, ...]) -> Tensor:
    result = torch.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        result = result * x + coefficient
    return result


def _sinc_of_square(square: Tensor) -> Tensor:
    """sin(s)/s as a smooth function of s²."""
    small = square < _SINC_SWITCH
    s = torch.where(small, torch.ones_like(square), square).sqrt()
    inside = torch.where(small, square, torch.zeros_like(square))
    return torch.where(small, _series(inside, _SINC_SERIES), torch.sin(s) / s)


def _safe_norm(vector: Tensor) -> Tensor:
    """Euclidean norm over the last axis whose gradient at zero is zero instead of NaN."""
    square = vector.square().sum(-1)
    zero = square == 0
    root = torch.where(zero, torch.ones_like(square), square).sqrt()
    return torch.where(zero, torch.zeros_like(square), root)


def axis_angle_to_rotmat(axis_angle: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation matrices of axis-angle vectors.

    Args:
        axis_angle: unit axis times angle in radians, (*b, 3); any length.

    Returns:
        Rotation matrices, (*b, 3, 3); differentiable to any order, at zero too.

    Reference:
        Rodrigues: R = I + sin(θ)/θ K + (1 - cos θ)/θ² K².

    >>> axis_angle_to_rotmat(torch.zeros(3)).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    x, y, z = axis_angle.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    square = xx + yy + zz
    a = _sinc_of_square(square)
    b = 0.5 * _sinc_of_square(0.25 * square).square()
    ax, ay, az = a * x, a * y, a * z
    bxy, bxz, byz = b * x * y, b * x * z, b * y * z
    rows = (
        *(1 - b * (yy + zz), bxy - az, bxz + ay),
        *(bxy + az, 1 - b * (xx + zz), byz - ax),
        *(bxz - ay, byz + ax, 1 - b * (xx + yy)),
    )
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def rotmat_to_quat_wxyz(rotmat: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 4"]:
    """Unit quaternions (w first, w ≥ 0) of rotation matrices.

    Args:
        rotmat: rotation matrices, (*b, 3, 3).

    Returns:
        Unit quaternions, (*b, 4); differentiable, the sign jumps where w = 0 (half turns).

    Reference:
        Shepperd 1978: 4 q qᵀ is linear in R; its row of largest diagonal is divided by a root ≥ 1.

    >>> rotmat_to_quat_wxyz(torch.eye(3)).tolist()
    [1.0, 0.0, 0.0, 0.0]
    """
    m = rotmat
    d0, d1, d2 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    wx, wy, wz = (
        m[..., 2, 1] - m[..., 1, 2],
        m[..., 0, 2] - m[..., 2, 0],
        m[..., 1, 0] - m[..., 0, 1],
    )
    xy, xz, yz = (
        m[..., 0, 1] + m[..., 1, 0],
        m[..., 0, 2] + m[..., 2, 0],
        m[..., 1, 2] + m[..., 2, 1],
    )
    products = torch.stack(
        (
            *(1 + d0 + d1 + d2, wx, wy, wz),
            *(wx, 1 + d0 - d1 - d2, xy, xz),
            *(wy, xy, 1 - d0 + d1 - d2, yz),
            *(wz, xz, yz, 1 - d0 - d1 + d2),
        ),
        dim=-1,
    ).unflatten(-1, (4, 4))
    best = products.detach().diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = products.take_along_dim(best[..., None, None], dim=-2).squeeze(-2)
    quat = torch.nn.functional.normalize(row, dim=-1)
    return torch.where(quat[..., :1] < 0, -quat, quat)


def quat_wxyz_to_rotmat(quat: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation matrices of quaternions (w first), which need not have unit length.

    Args:
        quat: quaternions, (*b, 4), of any finite length; a zero quaternion gives the identity.

    Returns:
        Rotation matrices, (*b, 3, 3); differentiable; NaN where the quaternion is not finite. The
        gradient is as large as one over the length, and leaves float32 below a length of 1e-37.

    >>> quat_wxyz_to_rotmat(torch.tensor([2.0, 0.0, 0.0, 0.0])).diagonal().tolist()
    [1.0, 1.0, 1.0]
    """
    # squares of tiny and of huge components leave the range of floats: scaled to size one first
    largest = quat.detach().abs().amax(-1, keepdim=True)
    w, x, y, z = (quat / torch.where(largest > 0, largest, torch.ones_like(largest))).unbind(-1)
    square = w * w + x * x + y * y + z * z
    s = 2 / torch.where(square > 0, square, torch.ones_like(square))
    s = torch.where(square.isnan(), square, s)
    sx, sy, sz = s * x, s * y, s * z
    rows = (
        *(1 - (sy * y + sz * z), sx * y - sz * w, sx * z + sy * w),
        *(sx * y + sz * w, 1 - (sx * x + sz * z), sy * z - sx * w),
        *(sx * z - sy * w, sy * z + sx * w, 1 - (sx * x + sy * y)),
    )
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def rotmat_to_axis_angle(rotmat: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Axis-angle vectors, of angle in [0, π], of rotation matrices.

    Args:
        rotmat: rotation matrices, (*b, 3, 3).

    Returns:
        Unit axis times angle in radians, (*b, 3); differentiable, with finite gradients at the
        identity and at half turns (where the axis may flip its sign).

    >>> rotmat_to_axis_angle(torch.eye(3)).tolist()
    [0.0, 0.0, 0.0]
    """
    quat = rotmat_to_quat_wxyz(rotmat)
    w, vector = quat[..., 0], quat[..., 1:]
    square = vector.square().sum(-1)
    small = square < _ASINC_SWITCH
    inside = torch.where(small, square, torch.zeros_like(square))
    sine = torch.where(small, torch.ones_like(square), square).sqrt()
    half = torch.where(small, _series(inside, _ASINC_SERIES), torch.atan2(sine, w) / sine)
    return 2 * half[..., None] * vector


def rotation_angle(a: Float[Tensor, "*b 3 3"], b: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Angle of the rotation that takes one rotation to another.

    Args:
        a: rotation matrices, (*b, 3, 3).
        b: rotation matrices, (*b, 3, 3).

    Returns:
        Angles in [0, π] radians, (*b); differentiable, with the gradient taken as zero where the
        angle is exactly 0 or π and finite everywhere.

    Reference:
        atan2 of the skew part (sine) and the trace (cosine) of aᵀ b; accurate at both ends.

    >>> rotation_angle(torch.eye(3), torch.eye(3)).item()
    0.0
    """
    relative = a.mT @ b
    skew = (
        relative[..., 2, 1] - relative[..., 1, 2],
        relative[..., 0, 2] - relative[..., 2, 0],
        relative[..., 1, 0] - relative[..., 0, 1],
    )
    sine = 0.5 * _safe_norm(torch.stack(skew, dim=-1))
    cosine = 0.5 * (relative.diagonal(dim1=-2, dim2=-1).sum(-1) - 1)
    return torch.atan2(sine, cosine)
