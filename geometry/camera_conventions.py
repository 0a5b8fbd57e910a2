"""Cameras as OpenGL, Blender and PyTorch3D state them, and back.

All three know pinholes alone: a camera with a lens is refused, `Camera.undistorted` comes first.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from .camera_checks import check_size
from .cameras import Camera
from .errors import InputError


def _flip(like: Tensor, x: int, y: int, z: int) -> Float[Tensor, "3"]:
    """Signs of the three axes."""
    return torch.tensor([x, y, z], dtype=like.dtype, device=like.device)


def _need_pinhole(camera: Camera, skew: bool = False) -> None:
    """Refuses what the other side cannot say."""
    if camera.is_distorted:
        raise InputError(
            "camera: expected a pinhole, found a lens with distortion; take undistorted()[0] and "
            "resample the image"
        )
    slant = float(camera.K[0, 1].detach())
    if not skew and slant != 0:
        raise InputError(
            f"camera: expected no skew, found {slant:g} pixels; this convention has no place for it"
        )


def _rigid(matrix: Float[Tensor, "4 4"], name: str) -> tuple[Tensor, Tensor]:
    """Rotation and translation of a 4×4 matrix whose last row is (0, 0, 0, 1)."""
    if float((matrix[3].detach() - matrix.new_tensor([0, 0, 0, 1])).abs().max()) > 1e-6:
        raise InputError(
            f"{name}: expected a last row of (0, 0, 0, 1), found {matrix[3].tolist()}; transpose it"
        )
    return matrix[:3, :3], matrix[:3, 3]


# --- OpenGL ---------------------------------------------------------------------------------------


def camera_to_opengl(
    camera: Camera, near: float, far: float
) -> tuple[Float[Tensor, "4 4"], Float[Tensor, "4 4"]]:
    """View and projection matrices of OpenGL, for column vectors.

    Eye axes are x right, y up, z backwards; clip space has x right, y up and depths −1 to 1; the
    viewport is the whole image, whose top row OpenGL counts last.

    Args:
        camera: a pinhole.
        near: depth of the near plane, metres, above 0.
        far: depth of the far plane, metres.

    Returns:
        View (world → eye) and projection (eye → clip), each 4 4, differentiable in the camera.

    Raises:
        InputError: a lens, or planes that are not 0 < near < far.

    >>> K = torch.tensor([[2.0, 0, 1], [0, 2, 1], [0, 0, 1]])
    >>> camera = Camera(K, torch.eye(3), torch.zeros(3), (2, 2))
    >>> view, projection = camera_to_opengl(camera, 1.0, 3.0)
    >>> (projection @ view @ torch.tensor([0.0, 0, 3, 1])).tolist()
    [0.0, 0.0, 3.0, 3.0]
    """
    _need_pinhole(camera, skew=True)
    if not 0 < near < far:
        raise InputError(f"near, far: expected 0 < near < far, found {near} and {far}; give depths")
    K, (height, width) = camera.K, camera.size
    flip = _flip(K, 1, -1, -1)
    view = torch.cat(
        [torch.cat([camera.R, camera.t[:, None]], 1) * flip[:, None], K.new_zeros(1, 4)]
    )
    view = view + torch.diag(K.new_tensor([0, 0, 0, 1.0]))
    # eye → OpenCV camera → pixels · depth → clip, with y up
    to_clip = K.new_tensor([[2 / width, 0, -1], [0, -2 / height, 1], [0, 0, 1]])
    rows = (to_clip @ K) * flip
    depth = K.new_tensor([0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)])
    projection = torch.cat([rows, K.new_zeros(3, 1)], 1)
    return view, torch.stack([projection[0], projection[1], depth, projection[2]])


def camera_from_opengl(
    view: Float[Tensor, "4 4"], projection: Float[Tensor, "4 4"], size: tuple[int, int]
) -> Camera:
    """Camera of OpenGL's view and projection matrices; see `camera_to_opengl`.

    Args:
        view: world → eye, 4 4.
        projection: eye → clip, perspective, 4 4.
        size: (height, width) of the viewport, pixels.

    Returns:
        The pinhole.

    Raises:
        InputError: a view that is not rigid, or a projection that is not perspective.

    >>> K = torch.tensor([[2.0, 0, 1], [0, 2, 1], [0, 0, 1]])
    >>> matrices = camera_to_opengl(Camera(K, torch.eye(3), torch.zeros(3), (2, 2)), 1.0, 3.0)
    >>> bool((camera_from_opengl(*matrices, (2, 2)).K == K).all())
    True
    """
    check_size(size)
    R, t = _rigid(view, "view")
    last = projection[3].detach()
    if float((last - projection.new_tensor([0, 0, -1, 0])).abs().max()) > 1e-6:
        raise InputError(
            f"projection: expected a perspective with last row (0, 0, -1, 0), found "
            f"{last.tolist()}; transpose it, or use a perspective"
        )
    height, width = size
    rows = projection[[0, 1, 3], :3] * _flip(projection, 1, -1, -1)
    to_pixels = projection.new_tensor(
        [[width / 2, 0, width / 2], [0, -height / 2, height / 2], [0, 0, 1]]
    )
    flip = _flip(projection, 1, -1, -1)
    return Camera(to_pixels @ rows, R * flip[:, None], t * flip, size)


# --- Blender --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class BlenderCamera:
    """A perspective camera as Blender's properties state it, with sensor fit `HORIZONTAL`."""

    matrix_world: Float[Tensor, "4 4"]
    """Camera → world; the camera looks along −z, its y is up."""
    lens: float
    """Focal length, millimetres."""
    sensor_width: float
    """Millimetres."""
    shift_x: float
    """Of the image's width."""
    shift_y: float
    """Of the image's width."""
    pixel_aspect_y: float
    """`render.pixel_aspect_y` where `pixel_aspect_x` is 1. Blender takes no value below 1: set
    `pixel_aspect_x` to the inverse instead."""
    size: tuple[int, int]
    """(height, width), `render.resolution_y` and `resolution_x`, pixels."""


def camera_to_blender(camera: Camera, sensor_width: float = 36.0) -> BlenderCamera:
    """The properties with which Blender shows the same picture.

    Args:
        camera: a pinhole without skew.
        sensor_width: millimetres.

    Returns:
        The properties; set `sensor_fit` to `HORIZONTAL`.

    Raises:
        InputError: a lens, skew, a sensor without width.

    >>> K = torch.tensor([[50.0, 0, 30], [0, 50, 20], [0, 0, 1]])
    >>> made = camera_to_blender(Camera(K, torch.eye(3), torch.zeros(3), (40, 50)))
    >>> made.lens, round(made.shift_x, 6), made.shift_y
    (36.0, -0.1, 0.0)
    """
    _need_pinhole(camera)
    if not sensor_width > 0:
        raise InputError(f"sensor_width: expected millimetres above 0, found {sensor_width}")
    K, (height, width) = camera.K.detach(), camera.size
    fx, fy, cx, cy = (float(K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    aspect = fx / fy
    world = torch.eye(4).to(K)
    world[:3, :3] = camera.R.detach().mT * _flip(K, 1, -1, -1)
    world[:3, 3] = camera.center.detach()
    shift = (width / 2 - cx) / width, (cy - height / 2) * aspect / width
    return BlenderCamera(
        world, fx * sensor_width / width, sensor_width, *shift, aspect, camera.size
    )


def camera_from_blender(blender: BlenderCamera) -> Camera:
    """Camera of Blender's properties.

    Args:
        blender: the properties; the scale of `matrix_world` must be 1.

    Returns:
        The pinhole.

    Raises:
        InputError: a matrix that is not rigid, or a length that is not positive.

    >>> K = torch.tensor([[50.0, 0, 30], [0, 50, 20], [0, 0, 1]])
    >>> made = camera_to_blender(Camera(K, torch.eye(3), torch.zeros(3), (40, 50)))
    >>> bool(torch.allclose(camera_from_blender(made).K, K))
    True
    """
    check_size(blender.size)
    for name in ("lens", "sensor_width", "pixel_aspect_y"):
        if not getattr(blender, name) > 0:
            found = getattr(blender, name)
            raise InputError(f"{name}: expected a number above 0, found {found}; correct it")
    to_world, center = _rigid(blender.matrix_world, "matrix_world")
    height, width = blender.size
    fx = blender.lens * width / blender.sensor_width
    cx = width / 2 - blender.shift_x * width
    cy = height / 2 + blender.shift_y * width / blender.pixel_aspect_y
    K = to_world.new_tensor([[fx, 0, cx], [0, fx / blender.pixel_aspect_y, cy], [0, 0, 1]])
    R = (to_world * _flip(to_world, 1, -1, -1)).mT
    return Camera(K, R, -(R @ center), blender.size)


# --- PyTorch3D ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class PyTorch3DCamera:
    """Arguments of PyTorch3D's `PerspectiveCameras(in_ndc=True)`, one camera without batch axis."""

    R: Float[Tensor, "3 3"]
    """Acts on row vectors: x_view = x_world R + T; view axes x left, y up, z forward."""
    T: Float[Tensor, "3"]
    """Metres."""
    focal_length: Float[Tensor, "2"]
    """In units of half the shorter side."""
    principal_point: Float[Tensor, "2"]
    """In the same units, from the middle of the image, x left, y up."""
    image_size: tuple[int, int]
    """(height, width), pixels."""


def camera_to_pytorch3d(camera: Camera) -> PyTorch3DCamera:
    """The arguments with which PyTorch3D projects to the same place.

    Args:
        camera: a pinhole without skew.

    Returns:
        The arguments, differentiable in the camera.

    Raises:
        InputError: a lens, or skew.

    Reference: PyTorch3D documentation, "Cameras": coordinate systems, and NDC of non-square images.

    >>> K = torch.tensor([[50.0, 0, 30], [0, 50, 20], [0, 0, 1]])
    >>> made = camera_to_pytorch3d(Camera(K, torch.eye(3), torch.zeros(3), (40, 50)))
    >>> made.focal_length.tolist(), made.principal_point.tolist()
    ([2.5, 2.5], [-0.25, 0.0])
    """
    _need_pinhole(camera)
    K, (height, width) = camera.K, camera.size
    flip, unit = _flip(K, -1, -1, 1), min(height, width) / 2
    middle = K.new_tensor([width / 2, height / 2])
    focal = torch.stack([K[0, 0], K[1, 1]]) / unit
    return PyTorch3DCamera(
        camera.R.mT * flip, camera.t * flip, focal, (middle - K[:2, 2]) / unit, camera.size
    )


def camera_from_pytorch3d(pytorch3d: PyTorch3DCamera) -> Camera:
    """Camera of PyTorch3D's arguments.

    Args:
        pytorch3d: the arguments.

    Returns:
        The pinhole, differentiable in them.

    Raises:
        InputError: a matrix that is not a rotation, a focal length that is not positive.

    >>> K = torch.tensor([[50.0, 0, 30], [0, 50, 20], [0, 0, 1]])
    >>> made = camera_to_pytorch3d(Camera(K, torch.eye(3), torch.zeros(3), (40, 50)))
    >>> bool((camera_from_pytorch3d(made).K == K).all())
    True
    """
    check_size(pytorch3d.image_size)
    (height, width), R = pytorch3d.image_size, pytorch3d.R
    flip, unit = _flip(R, -1, -1, 1), min(height, width) / 2
    middle = R.new_tensor([width / 2, height / 2])
    K = torch.diag(torch.cat([pytorch3d.focal_length * unit, R.new_ones(1)]))
    center = torch.cat([middle - pytorch3d.principal_point * unit, R.new_zeros(1)])
    K = K + center[:, None] * R.new_tensor([0, 0, 1])
    return Camera(K, (R * flip).mT, pytorch3d.T * flip, pytorch3d.image_size)
