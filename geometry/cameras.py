"""Pinhole cameras with lens distortion; pixel centres at +½, OpenCV axes, world→camera R x + t."""

import dataclasses
import math
from dataclasses import dataclass, field
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from .camera_checks import check_camera, check_size, intrinsics_from_fov, look_at_rotation
from .errors import InputError
from .lenses import is_bent, lens_distort, lens_fold_radius, lens_undistort

MIN_DEPTH = 1e-6
"""Metres in front of the camera below which a point counts as behind it."""


@dataclass(frozen=True, eq=False)
class Rays:
    """Half lines of the world: origin + distance · direction."""

    origins: Float[Tensor, "*b 3"]
    """World metres."""
    directions: Float[Tensor, "*b 3"]
    """Unit length, world axes."""

    def at(self, distances: Float[Tensor, "*b"]) -> Float[Tensor, "*b 3"]:
        """Points at given distances.

        Args:
            distances: metres along the rays, *b.

        Returns:
            World points, *b 3, differentiable in everything.

        >>> Rays(torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])).at(torch.tensor(2.0)).tolist()
        [0.0, 0.0, 2.0]
        """
        return self.origins + distances[..., None] * self.directions


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera: world x → R x + t → divide by depth → distort → K → pixels.

    The centre of the pixel in row i, column j is (j + ½, i + ½); (0, 0) is the outer corner of the
    top-left pixel. Camera axes: x right, y down, z forward. Lengths in metres. Methods work in the
    dtype and on the device of the points or pixels given to them.

    Raises:
        InputError: wrong shapes, values not finite, R not a rotation within 1e-3, K not an upper
            triangular intrinsic matrix, size not positive, an unsupported number of coefficients.

    Reference: Hartley and Zisserman, "Multiple View Geometry", chapter 6; Brown 1966.

    >>> camera = Camera(torch.tensor([[8.0, 0, 4], [0, 8, 3], [0, 0, 1]]), torch.eye(3),
    ...                 torch.zeros(3), (6, 8))
    >>> pixels, depth = camera.project(torch.tensor([0.0, 0.0, 2.0]))
    >>> pixels.tolist(), float(depth)
    ([4.0, 3.0], 2.0)
    """

    # shapes left open to the type checker: `check_camera` refuses wrong ones with an InputError
    K: Shaped[Tensor, "..."]
    """3 3: Intrinsics in pixels, for pixel centres at +½."""
    R: Shaped[Tensor, "..."]
    """3 3: Rotation world → camera."""
    t: Shaped[Tensor, "..."]
    """3: Translation world → camera, metres."""
    size: tuple[int, int]
    """(height, width) in pixels."""
    distortion: Shaped[Tensor, "..."] = field(default_factory=lambda: torch.zeros(0))
    """d: OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [τx τy]]]], or empty; k1 k2 k3 k4 of a
    fisheye."""
    lens: str = "brown"
    """`brown` or `fisheye`: what the coefficients mean."""

    def __post_init__(self) -> None:
        check_camera(self.K, self.R, self.t, self.size, self.distortion, self.lens)
        if self.distortion.numel() == 0:
            object.__setattr__(self, "distortion", self.K.new_zeros(0))

    @classmethod
    def from_legacy_pixels(
        cls,
        K: Shaped[Tensor, "..."],
        R: Shaped[Tensor, "..."],
        t: Shaped[Tensor, "..."],
        size: tuple[int, int],
        distortion: Shaped[Tensor, "..."] | None = None,
        lens: str = "brown",
    ) -> "Camera":
        """Camera from intrinsics that put pixel centres at whole numbers (OpenCV, ZJU-MoCap).

        Args:
            K: intrinsics, integer centres, 3 3.
            R: rotation world → camera, 3 3.
            t: translation world → camera, metres, 3.
            size: (height, width) in pixels.
            distortion: coefficients in OpenCV's order, d; none when left out.
            lens: kind of lens.

        Returns:
            The same camera with ½ added to cx and cy.

        Raises:
            InputError: as the class.
        """
        if tuple(K.shape) != (3, 3):
            raise InputError(f"K: expected shape (3, 3), found {tuple(K.shape)}; pass one matrix")
        shift = K.new_zeros(3, 3)
        shift[:2, 2] = 0.5
        coefficients = K.new_zeros(0) if distortion is None else distortion
        return cls(K + shift, R, t, size, coefficients, lens)

    @classmethod
    def look_at(
        cls,
        eye: Float[Tensor, "3"],
        target: Float[Tensor, "3"],
        up: Float[Tensor, "3"],
        size: tuple[int, int],
        *,
        fov: float | None = None,
        K: Float[Tensor, "3 3"] | None = None,
    ) -> "Camera":
        """Camera at a point, looking at another, with a given direction upwards in the image.

        Args:
            eye: camera centre, world metres, 3.
            target: point seen along the optical axis, world metres, 3.
            up: direction that points up in the image, world axes, any length, 3.
            size: (height, width) in pixels.
            fov: vertical field of view, radians; square pixels, centred. Give this or K.
            K: intrinsics, 3 3.

        Returns:
            The camera, without distortion.

        Raises:
            InputError: both or none of fov and K, a target at the eye, up along the view.
        """
        if (fov is None) == (K is None):
            raise InputError("look_at: expected exactly one of fov and K; leave the other out")
        R = look_at_rotation(eye, target, up)
        if K is None:
            K = intrinsics_from_fov(eye, size, float(fov or 0.0))
        return cls(K, R, -(R @ eye), size)

    @property
    def center(self) -> Float[Tensor, "3"]:
        """Position of the camera, world metres, 3."""
        return -(self.R.mT @ self.t)

    @cached_property
    def is_distorted(self) -> bool:
        """Whether the lens differs from a pinhole: a fisheye, or a coefficient that is not zero."""
        return is_bent(self.lens, self.distortion)

    @cached_property
    def fold_radius(self) -> float:
        """Radius |(x, y)|/z up to which the lens is one-to-one; infinite for a pinhole."""
        return lens_fold_radius(self.lens, self.distortion) if self.is_distorted else math.inf

    def to(self, ref: Tensor) -> "Camera":
        """Same camera on the device and in the float dtype of a tensor.

        Args:
            ref: any tensor of a float dtype.

        Returns:
            The camera; itself where nothing changes.
        """
        if self.K.dtype == ref.dtype and self.K.device == ref.device:
            return self
        K, R, t, d = (x.to(ref) for x in (self.K, self.R, self.t, self.distortion))
        return dataclasses.replace(self, K=K, R=R, t=t, distortion=d)

    def to_camera(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """World points in camera axes.

        Args:
            points: world metres, *b 3.

        Returns:
            R x + t, metres, *b 3.
        """
        return points @ self.R.to(points).mT + self.t.to(points)

    def project(
        self, points: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b 2"], Float[Tensor, "*b"]]:
        """Where points appear in the image.

        Points closer than `MIN_DEPTH` or behind the camera get the pixel (−width, −height), with
        zero gradient; points beyond the fold of the lens are continued outwards. Mask with
        depth > 0, or with `visible`.

        Args:
            points: world metres, *b 3.

        Returns:
            Pixels (x right, y down), *b 2, and depth along the optical axis, metres, *b. Both
            finite, differentiable in the points and in the camera.
        """
        local = self.to_camera(points)
        depth = local[..., 2]
        front = (depth > MIN_DEPTH)[..., None]
        plane = local[..., :2] / torch.where(front, depth[..., None], 1.0)
        pixels = self._plane_to_pixels(torch.where(front, plane, 0.0))
        outside = pixels.new_tensor([-self.size[1], -self.size[0]])
        return torch.where(front, pixels, outside), depth

    def pixel_slopes(
        self, points: Float[Tensor, "*b 3"], nearest: float = MIN_DEPTH
    ) -> Float[Tensor, "*b 2 3"]:
        """How pixels of points move with the points, to first order: the Jacobian of `project`.

        Args:
            points: world metres, *b 3.
            nearest: depth that nearer points and those behind count with, metres; slopes are finite
                there and mean nothing.

        Returns:
            ∂(x, y)/∂(point), pixels per metre, differentiable in the points and the camera.

        Raises:
            InputError: the camera has a lens.
        """
        if self.is_distorted:
            raise InputError(
                "camera: expected a pinhole, found a lens with distortion; undistort the image and "
                "take camera.without_lens()"
            )
        x, y, z = self.to_camera(points).unbind(-1)
        z, zero = z.clamp_min(nearest), torch.zeros_like(z)
        x, y, one = x / z, y / z, 1 / z
        plane = torch.stack([one, zero, -x * one, zero, one, -y * one], -1).unflatten(-1, (2, 3))
        return self.K.to(points)[:2, :2] @ plane @ self.R.to(points)

    def visible(self, points: Float[Tensor, "*b 3"]) -> Bool[Tensor, "*b"]:
        """Which points fall into the image: in front, inside the frame and inside the lens's fold.

        Args:
            points: world metres, *b 3.

        Returns:
            Mask *b. Occlusion is not considered.
        """
        local = self.to_camera(points.detach())
        pixels, depth = self.project(points.detach())
        inside = (pixels >= 0).all(-1) & (pixels[..., 0] < self.size[1])
        inside &= pixels[..., 1] < self.size[0]
        seen = (depth > MIN_DEPTH) & inside
        if math.isfinite(self.fold_radius):
            seen &= local[..., :2].norm(dim=-1) < self.fold_radius * depth
        return seen

    def rays(self, pixels: Float[Tensor, "*b 2"]) -> Rays:
        """Rays through pixels.

        Args:
            pixels: (x right, y down) in pixels, *b 2.

        Returns:
            Rays from the camera centre, unit directions, *b 3, differentiable in the pixels and
            the camera. Finite, but meaningless where `valid_pixels` is False.
        """
        return self.rays_with_mask(pixels)[0]

    def rays_with_mask(self, pixels: Float[Tensor, "*b 2"]) -> tuple[Rays, Bool[Tensor, "*b"]]:
        """Rays through pixels, and which of them the lens can see.

        Args:
            pixels: (x right, y down) in pixels, *b 2.

        Returns:
            As `rays`, and a mask *b, False where no ray inside the fold reaches the pixel.
        """
        plane, valid = self._pixels_to_plane(pixels)
        local = torch.cat([plane, torch.ones_like(plane[..., :1])], -1)
        directions = local @ self.R.to(pixels)
        directions = directions / directions.norm(dim=-1, keepdim=True)
        return Rays(self.center.to(pixels).expand_as(directions), directions), valid

    def valid_pixels(self, pixels: Float[Tensor, "*b 2"]) -> Bool[Tensor, "*b"]:
        """Pixels that have a ray: everywhere for a pinhole, inside the fold for a lens.

        Args:
            pixels: (x right, y down) in pixels, *b 2.

        Returns:
            Mask *b.
        """
        return self._pixels_to_plane(pixels.detach())[1]

    def pixel_grid(self) -> Float[Tensor, "h w 2"]:
        """Centres of all pixels, (j + ½, i + ½) in row i, column j.

        Returns:
            Pixels, height width 2, in the dtype and on the device of K.
        """
        height, width = self.size
        y = torch.arange(height, dtype=self.K.dtype, device=self.K.device) + 0.5
        x = torch.arange(width, dtype=self.K.dtype, device=self.K.device) + 0.5
        return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)

    def resized(self, scale: float | tuple[int, int]) -> "Camera":
        """Camera of the resized image, exact because pixel centres are at +½.

        Args:
            scale: factor (the size is rounded to whole pixels), or the new (height, width).

        Returns:
            The camera whose pixels are the old ones times new size / old size.

        Raises:
            InputError: a size that is not positive.
        """
        height, width = self.size
        if isinstance(scale, tuple):
            new = scale
        elif math.isfinite(scale) and scale > 0:
            new = (round(height * scale), round(width * scale))
        else:
            raise InputError(f"scale: expected a positive factor, found {scale}; pass e.g. 0.5")
        check_size(new)
        ratio = self.K.new_tensor([new[1] / width, new[0] / height, 1.0])
        return dataclasses.replace(self, K=ratio[:, None] * self.K, size=new)

    def cropped(self, box: tuple[int, int, int, int]) -> "Camera":
        """Camera of a crop of the image; the box may reach beyond the image.

        Args:
            box: (x0, y0, x1, y1) in pixels, x1 and y1 excluded.

        Returns:
            The camera with its principal point moved by (−x0, −y0).

        Raises:
            InputError: an empty box.
        """
        x0, y0, x1, y1 = box
        if x1 <= x0 or y1 <= y0:
            raise InputError(f"box: expected x0 < x1 and y0 < y1, found {box}; swap the corners")
        shift = torch.zeros_like(self.K)
        shift[0, 2], shift[1, 2] = x0, y0
        return dataclasses.replace(self, K=self.K - shift, size=(y1 - y0, x1 - x0))

    def without_lens(self) -> "Camera":
        """Pinhole camera with the same K; itself where there is no distortion.

        Returns:
            The camera.
        """
        if not self.is_distorted:
            return self
        return dataclasses.replace(self, distortion=self.K.new_zeros(0), lens="brown")

    def undistorted(self) -> tuple["Camera", Float[Tensor, "h w 2"]]:
        """Pinhole camera with the same K, and where each of its pixels lies in the distorted image.

        Returns:
            The camera (this one where it has no distortion) and the map, height width 2, source
            pixels with centres at +½; `cv2.remap` wants this map minus ½. Without distortion the
            map is `pixel_grid()` exactly.
        """
        grid = self.pixel_grid()
        if not self.is_distorted:
            return self, grid
        ideal = self.without_lens()
        plane, _ = ideal._pixels_to_plane(grid)
        return ideal, self._plane_to_pixels(plane)

    def _plane_to_pixels(self, plane: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        """Lens and intrinsics: ideal points on the plane z = 1 → pixels."""
        K = self.K.to(plane)
        if self.is_distorted:
            coefficients = self.distortion.to(plane)
            plane = lens_distort(self.lens, plane, coefficients, self.fold_radius)
        return plane @ K[:2, :2].mT + K[:2, 2]

    def _pixels_to_plane(
        self, pixels: Float[Tensor, "*b 2"]
    ) -> tuple[Float[Tensor, "*b 2"], Bool[Tensor, "*b"]]:
        """Pixels → ideal points on the plane z = 1, and which of them exist."""
        K = self.K.to(pixels)
        y = (pixels[..., 1] - K[1, 2]) / K[1, 1]
        x = (pixels[..., 0] - K[0, 2] - K[0, 1] * y) / K[0, 0]
        plane = torch.stack([x, y], -1)
        if not self.is_distorted:
            return plane, torch.ones_like(x, dtype=torch.bool)
        return lens_undistort(self.lens, plane, self.distortion.to(pixels), self.fold_radius)
