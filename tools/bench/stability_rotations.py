"""Stress of rotations, affine maps and kinematics; the oracle of rotations has 50 digits."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.rotations import (
    axis_angle_to_rotmat,
    quat_wxyz_to_rotmat,
    rotation_angle,
    rotmat_to_axis_angle,
    rotmat_to_quat_wxyz,
)

from .registry import load
from .stability_cases import DOUBLE, HALVES, SINGLE, Family, Inputs, Stress, Way

_DIGITS = 50
Make = Callable[[torch.Generator, int], Inputs]


def axes(generator: torch.Generator, count: int) -> Tensor:
    """Unit vectors: random ones and the axes of coordinates."""
    axis = torch.randn(count, 3, generator=generator, dtype=DOUBLE)
    axis[: min(3, count)] = torch.eye(3, dtype=DOUBLE)[: min(3, count)]
    return axis / axis.norm(dim=1, keepdim=True)


def turned(angle: float | tuple[float, float]) -> Make:
    """Axis-angle vectors of one angle or of a range of angles, radians."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        axis = axes(generator, count)
        if isinstance(angle, tuple):
            share = torch.rand(count, 1, generator=generator, dtype=DOUBLE)
            return (axis * (angle[0] + share * (angle[1] - angle[0])),)
        return (axis * angle,)

    return make


def matrices(angle: float | tuple[float, float], drift: float = 0.0, mirror: bool = False) -> Make:
    """Rotation matrices of such vectors, off by noise or mirrored."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        (vectors,) = turned(angle)(generator, count)
        rotmat = axis_angle_to_rotmat(vectors)
        noise = torch.randn(rotmat.shape, generator=generator, dtype=DOUBLE)
        return ((-1.0 if mirror else 1.0) * rotmat + drift * noise,)

    return make


def _named(make: Callable[..., Make], **half_turn: Any) -> list[Family]:
    """Families of angles: at and next to 0, in between, next to and at π, with what holds there."""
    out = [Family("0", make(0.0))]
    out += [Family(f"1e-{k}", make(10.0**-k)) for k in (12, 8, 5, 4, 3, 2)]
    out += [Family("0.1-3", make((0.1, 3.0)))]
    out += [Family(f"π-1e-{k}", make(np.pi - 10.0**-k)) for k in (1, 2)]
    out += [Family(f"π-1e-{k}", make(np.pi - 10.0**-k), **half_turn) for k in (4, 6)]
    return [*out, Family("π", make(np.pi), **half_turn)]


# --- the oracle --------------------------------------------------------------------------------


def _mp() -> Any:
    mp = load("mpmath").mp
    mp.dps = _DIGITS
    return mp


def exact_rotmat(extra: None, vectors: np.ndarray) -> np.ndarray:
    """Rodrigues' formula with 50 digits."""
    mp, out = _mp(), np.zeros((len(vectors), 3, 3))
    for i, vector in enumerate(vectors):
        v = [mp.mpf(float(x)) for x in vector]
        angle = mp.sqrt(sum(x * x for x in v))
        a = mp.sin(angle) / angle if angle else mp.mpf(1)
        b = 2 * (mp.sin(angle / 2) / angle) ** 2 if angle else mp.mpf(1) / 2
        cross = [[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]]
        for r in range(3):
            for c in range(3):
                square = sum(cross[r][k] * cross[k][c] for k in range(3))
                out[i, r, c] = float((r == c) + a * cross[r][c] + b * square)
    return out


def exact_of_quat(extra: None, quats: np.ndarray) -> np.ndarray:
    """Rotation matrix of a quaternion of any length with 50 digits."""
    mp, out = _mp(), np.zeros((len(quats), 3, 3))
    for i, quat in enumerate(quats):
        w, x, y, z = (mp.mpf(float(q)) for q in quat)
        n = w * w + x * x + y * y + z * z
        s = 2 / n if n else mp.mpf(0)
        rows = (
            (1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)),
            (s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)),
            (s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)),
        )
        out[i] = [[float(e) for e in row] for row in rows]
    return out


def exact_angle(extra: None, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """atan2 of skew part and trace with 50 digits."""
    mp, out = _mp(), np.zeros(len(a))
    for i, (first, second) in enumerate(zip(a, b, strict=True)):
        m = mp.matrix(first.tolist()).T * mp.matrix(second.tolist())
        skew = (m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1])
        sine = mp.sqrt(sum(s * s for s in skew))
        out[i] = float(mp.atan2(sine, m[0, 0] + m[1, 1] + m[2, 2] - 1))
    return out


def _itself(extra: None, matrix: np.ndarray) -> np.ndarray:
    return matrix


def _back(of: Callable[[None, np.ndarray], np.ndarray]) -> Callable[..., np.ndarray]:
    """Error of a description of a rotation: of the matrix that it stands for."""

    def off(found: np.ndarray, exact: np.ndarray) -> np.ndarray:
        return np.abs(of(None, np.nan_to_num(found)) - exact).reshape(len(found), -1).max(1)

    return off


# --- peers -------------------------------------------------------------------------------------


def _kornia(name: str) -> Way:
    def run(extra: None, *inputs: Tensor) -> Tensor:
        return getattr(load("kornia.geometry.conversions"), name)(*inputs)

    return Way("kornia", run, modules=("kornia",))


def _roma(name: str, order: tuple[int, ...] | None = None, first: bool = False) -> Way:
    """A function of roma, whose quaternions end with w."""

    def run(extra: None, *inputs: Tensor) -> Tensor:
        given = [x[..., [1, 2, 3, 0]] for x in inputs] if first else inputs
        found = getattr(load("roma"), name)(*given)
        return found if order is None else found[..., list(order)]

    return Way("roma", run, modules=("roma",))


def _opencv(extra: None, values: Tensor) -> Tensor:
    cv2 = load("cv2")
    rows = [torch.from_numpy(np.asarray(cv2.Rodrigues(v)[0])) for v in values.detach().numpy()]
    found = torch.stack(rows) if rows else values
    return found.reshape(len(values), -1) if values.ndim == 3 else found


def _scipy(read: str, write: str) -> Way:
    def run(extra: None, values: Tensor) -> Tensor:
        kind = load("scipy.spatial.transform").Rotation
        return torch.from_numpy(getattr(getattr(kind, read)(values.numpy()), write)())

    return Way("scipy", run, modules=("scipy",), dtypes=(DOUBLE,), differentiable=False)


def _smplx(extra: None, vectors: Tensor) -> Tensor:
    return load("smplx.lbs").batch_rodrigues(vectors)


def _ours(function: Callable[..., Tensor], halves: bool = True) -> Way:
    kinds = (SINGLE, DOUBLE, *HALVES) if halves else (SINGLE, DOUBLE)
    return Way("monopart", lambda extra, *x: function(*x), True, kinds)


_CV2 = Way("OpenCV", _opencv, modules=("cv2",), differentiable=False)


def _to_rotmat() -> Stress:
    more = (
        Family("2π", turned(2 * np.pi)),
        # an angle is held to its last place: 6e-4 rad here, of gradients that may be small
        Family("10-1e4", turned((10.0, 1e4)), step=1e-6, halves=False),
        Family("1e-30", turned(1e-30)),
        Family("1e25", turned(1e25), inside=False),
        Family("NaN", lambda g, n: (torch.full((n, 3), torch.nan, dtype=DOUBLE),), inside=False),
    )
    return Stress(
        name="axis_angle_to_rotmat",
        title="axis-angle to matrix",
        domain="vectors below 1e18 rad (float16: 200 rad); beyond it, and for NaN, NaN",
        error="1, and the angle where it is larger (it is rounded to 1 ulp before its sine)",
        families=(*_named(turned), *more),
        ways=(
            _ours(axis_angle_to_rotmat),
            _kornia("axis_angle_to_rotation_matrix"),
            _roma("rotvec_to_rotmat"),
            Way("smplx", _smplx, modules=("smplx",)),
            _CV2,
            _scipy("from_rotvec", "as_matrix"),
        ),
        exact=exact_rotmat,
        scale=lambda extra, exact, v: np.maximum(1.0, np.linalg.norm(v, axis=1)),
        cases=48,
    )


def _from_rotmat(quaternions: bool) -> Stress:
    families = (
        *_named(matrices, smooth=False),
        Family("drift 1e-3", matrices((0.1, 3.0), drift=1e-3), inside=False),
        Family("mirrored", matrices((0.1, 3.0), mirror=True), inside=False),
        Family("zero", lambda g, n: (torch.zeros(n, 3, 3, dtype=DOUBLE),), inside=False),
    )
    if quaternions:
        ways = (
            _ours(rotmat_to_quat_wxyz),
            _kornia("rotation_matrix_to_quaternion"),
            _roma("rotmat_to_unitquat", (3, 0, 1, 2)),
        )
        name, title, back = "rotmat_to_quat_wxyz", "matrix to quaternion", exact_of_quat
    else:
        ways = (
            _ours(rotmat_to_axis_angle),
            _kornia("rotation_matrix_to_axis_angle"),
            _roma("rotmat_to_rotvec"),
            _CV2,
            _scipy("from_matrix", "as_rotvec"),
        )
        name, title, back = "rotmat_to_axis_angle", "matrix to axis-angle", exact_rotmat
    return Stress(
        name=name,
        title=title,
        domain="rotation matrices up to rounding; a drifted or mirrored matrix gives the rotation "
        "of its largest quaternion products, finite, without warning; the sign jumps at π",
        error="1; of the matrix that the result stands for",
        families=families,
        ways=ways,
        exact=_itself,
        off=_back(back),
        cases=48,
    )


def quaternions(length: float, near: float | None = None) -> Make:
    """Quaternions of a length; or pairs next to each other's negative."""

    def make(generator: torch.Generator, count: int) -> Inputs:
        q = torch.randn(count, 4, generator=generator, dtype=DOUBLE)
        q = q / q.norm(dim=1, keepdim=True)
        if near is not None:
            q[1::2] = -q[0::2][: len(q[1::2])] + near * q.flip(1)[1::2]
        return (q * length,)

    return make


def _from_quat() -> Stress:
    sizes = (1e-30, 1e-20, 1e-10, 1e-3, 1.0, 1e3, 1e10, 1e20, 1e30)
    families = [
        Family(f"length {s:g}", quaternions(s), step=1e-5 * s, smooth=1e-11 < s < 1e11)
        for s in sizes
    ]
    families += [
        Family("near-opposite", quaternions(1.0, 1e-7)),
        Family("zero", lambda g, n: (torch.zeros(n, 4, dtype=DOUBLE),), smooth=False),
        Family("infinite", lambda g, n: (torch.full((n, 4), torch.inf).double(),), inside=False),
    ]
    return Stress(
        name="quat_wxyz_to_rotmat",
        title="quaternion to matrix",
        domain="any finite quaternion; zero gives the identity; an infinite one NaN",
        error="1",
        families=tuple(families),
        ways=(
            _ours(quat_wxyz_to_rotmat, halves=False),
            _kornia("quaternion_to_rotation_matrix"),
            dataclasses.replace(
                _roma("unitquat_to_rotmat", first=True),
                serves=lambda f: f.name == "length 1",  # as it asks for
            ),
        ),
        exact=exact_of_quat,
        cases=48,
    )


def _pair(angle: float | tuple[float, float]) -> Make:
    def make(generator: torch.Generator, count: int) -> Inputs:
        (first,) = matrices((0.1, 3.0))(generator, count)
        (turn,) = matrices(angle)(generator, count)
        return first, first @ turn

    return make


def _angle() -> Stress:
    # in float32 a matrix cannot hold an angle below 1e-7: its gradient is one of noise there
    families = [
        dataclasses.replace(f, smooth=f.smooth and f.name in ("0.1-3", "π-1e-1", "1e-2", "π-1e-2"))
        for f in _named(_pair)
    ]
    return Stress(
        name="rotation_angle",
        title="angle between rotations",
        domain="rotation matrices up to rounding; the gradient at exactly 0 and π is taken as 0",
        error="1 rad",
        families=tuple(families),
        ways=(_ours(rotation_angle, halves=False), _roma("rotmat_geodesic_distance")),
        exact=exact_angle,
        wrt=(0, 1),
        cases=32,
    )


def stresses() -> list[Stress]:
    """Operations on rotations and affine maps."""
    from . import stability_affine

    rotations = [_to_rotmat(), _from_rotmat(True), _from_rotmat(False), _from_quat(), _angle()]
    return [*rotations, *stability_affine.stresses()]
