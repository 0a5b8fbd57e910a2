"""Rotation conversions and undistortion: ours, kornia, roma, scipy and OpenCV."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from monopart.geometry.cameras import Camera
from monopart.geometry.distortion import distort
from monopart.geometry.rotations import axis_angle_to_rotmat, rotmat_to_axis_angle

from .registry import Method, load


@dataclass(eq=False)
class RotationData:
    """Axis-angle vectors, single precision, angles in [0, π)."""

    axis_angle: Tensor

    @cached_property
    def exact(self) -> Tensor:
        """Their matrices in double precision, by the exponential of the skew matrix."""
        x, y, z = self.axis_angle.double().unbind(-1)
        zero = torch.zeros_like(x)
        skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1)
        return torch.linalg.matrix_exp(skew.unflatten(-1, (3, 3)))

    @cached_property
    def rotmat(self) -> Tensor:
        """The matrices rounded to single precision."""
        return self.exact.float()


def rotation_data(count: int) -> RotationData:
    """Random axes; angles uniform up to just below π, every tenth next to 0 or to π."""
    generator = torch.Generator().manual_seed(7)
    axis = torch.randn(count, 3, generator=generator)
    axis = axis / axis.norm(dim=-1, keepdim=True)
    angle = torch.rand(count, 1, generator=generator) * 3.14
    angle[::20] *= 1e-5
    angle[10::20] = 3.1415 - 1e-3 * angle[10::20]
    return RotationData(axis * angle)


def _to_matrix(function: Callable[[], Callable[[Tensor], Tensor]]) -> Callable[[Any], Any]:
    def prepare(data: RotationData) -> Callable[[], Tensor]:
        convert = function()
        return lambda: convert(data.axis_angle)

    return prepare


def _to_vector(function: Callable[[], Callable[[Tensor], Tensor]]) -> Callable[[Any], Any]:
    def prepare(data: RotationData) -> Callable[[], Tensor]:
        convert, rotmat = function(), data.rotmat
        return lambda: convert(rotmat)

    return prepare


def _kornia(name: str) -> Callable[[], Callable[[Tensor], Tensor]]:
    return lambda: getattr(load("kornia.geometry.conversions"), name)


def _roma(name: str) -> Callable[[], Callable[[Tensor], Tensor]]:
    return lambda: getattr(load("roma"), name)


def _scipy(read: str, write: str) -> Callable[[], Callable[[Tensor], Tensor]]:
    def make() -> Callable[[Tensor], Tensor]:
        kind = load("scipy.spatial.transform").Rotation
        return lambda x: torch.from_numpy(getattr(getattr(kind, read)(x.numpy()), write)())

    return make


_SCIPY = (("scipy",), "pip install scipy")
_KORNIA = (("kornia",), "pip install kornia")
_ROMA = (("roma",), "pip install roma")


def to_matrix_methods() -> tuple[Method, ...]:
    """Axis-angle to matrix."""
    return (
        Method("monopart", _to_matrix(lambda: axis_angle_to_rotmat), ours=True),
        Method("kornia", _to_matrix(_kornia("axis_angle_to_rotation_matrix")), *_KORNIA),
        Method("roma", _to_matrix(_roma("rotvec_to_rotmat")), *_ROMA),
        Method("scipy (float64)", _to_matrix(_scipy("from_rotvec", "as_matrix")), *_SCIPY),
    )


def to_vector_methods() -> tuple[Method, ...]:
    """Matrix to axis-angle."""
    return (
        Method("monopart", _to_vector(lambda: rotmat_to_axis_angle), ours=True),
        Method("kornia", _to_vector(_kornia("rotation_matrix_to_axis_angle")), *_KORNIA),
        Method("roma", _to_vector(_roma("rotmat_to_rotvec")), *_ROMA),
        Method("scipy (float64)", _to_vector(_scipy("from_matrix", "as_rotvec")), *_SCIPY),
    )


def judge_matrix(data: RotationData, result: Tensor) -> dict[str, float]:
    """Largest entry of the difference to the exact matrix."""
    return {"error": float((result.double() - data.exact).abs().max())}


def judge_vector(data: RotationData, result: Tensor) -> dict[str, float]:
    """Largest entry of the difference of the matrices that the vectors stand for."""
    again = RotationData(result.double()).exact
    return {"error": float((again - data.exact).abs().max())}


LENSES: dict[str, tuple[float, ...]] = {
    "ZJU-like": (-0.25, 0.11, 0.001, -0.0005, -0.02),
    "strong barrel": (-0.38, 0.12, 0.0, 0.0, 0.0),
    "strong pincushion": (0.6, 0.5, 0.0, 0.0, 0.0),
}


@dataclass(eq=False)
class LensData:
    """Pixels of a camera with a lens, in double precision."""

    camera: Camera

    @cached_property
    def pixels(self) -> Tensor:
        """All pixel centres [N, 2]."""
        return self.camera.pixel_grid().reshape(-1, 2)

    @cached_property
    def seen(self) -> Tensor:
        """Pixels that the lens can see: others have no ray."""
        return self.camera.valid_pixels(self.pixels)


def lens_data(name: str, edge: int) -> LensData:
    """A camera of ``edge``² pixels with one of the lenses."""
    K = torch.tensor([[edge * 1.05, 0.0, edge / 2], [0.0, edge * 1.05, edge / 2], [0.0, 0.0, 1.0]])
    lens = torch.tensor(LENSES[name], dtype=torch.float64)
    K = K.double()
    camera = Camera(K, torch.eye(3).to(K), torch.zeros(3).to(K), (edge, edge), lens)
    return LensData(camera)


def _our_lens(data: LensData) -> Callable[[], Tensor]:
    camera, pixels = data.camera, data.pixels

    def call() -> Tensor:
        directions = camera.rays(pixels).directions
        return directions[:, :2] / directions[:, 2:]

    return call


def _kornia_lens(steps: int) -> Callable[[Any], Callable[[], Tensor]]:
    def prepare(data: LensData) -> Callable[[], Tensor]:
        undistort = load("kornia.geometry.calibration").undistort_points
        K, lens, pixels = data.camera.K[None], data.camera.distortion[None], data.pixels[None]
        unit = torch.eye(3).to(K)[None]
        return lambda: undistort(pixels, K, lens, unit, steps)[0]

    return prepare


def _opencv_lens(steps: int) -> Callable[[Any], Callable[[], Tensor]]:
    def prepare(data: LensData) -> Callable[[], Tensor]:
        cv2 = load("cv2")
        K, lens = data.camera.K.numpy(), data.camera.distortion.numpy()
        pixels = data.pixels.numpy()[:, None]
        stop = (cv2.TERM_CRITERIA_COUNT, steps, 0.0)

        def call() -> Tensor:
            found = cv2.undistortPoints(pixels, K, lens, R=None, P=None, criteria=stop)
            return torch.from_numpy(np.asarray(found)[:, 0])

        return call

    return prepare


def lens_methods() -> tuple[Method, ...]:
    """Pixels to the ideal plane."""
    cv2 = (("cv2",), "pip install opencv-contrib-python-headless")
    return (
        Method("monopart (Newton, rays)", _our_lens, ours=True),
        Method("kornia, 5 steps", _kornia_lens(5), *_KORNIA),
        Method("kornia, 20 steps", _kornia_lens(20), *_KORNIA),
        Method("OpenCV, 5 steps", _opencv_lens(5), *cv2),
        Method("OpenCV, 20 steps", _opencv_lens(20), *cv2),
    )


def judge_lens(data: LensData, plane: Tensor) -> dict[str, float]:
    """Largest distance, in pixels, between a pixel and its ideal point sent through the lens."""
    camera = data.camera
    back = distort(plane.double(), camera.distortion) @ camera.K[:2, :2].mT + camera.K[:2, 2]
    return {"error": float((back - data.pixels)[data.seen].norm(dim=-1).max())}
