"""Pictures of 3D Gaussians: projected, sorted into tiles, blended front to back.

Three back ends draw one picture: plain torch (all Gaussians at all pixels, the reference), a Warp
kernel with a thread for each tile, and gsplat, where there is CUDA and the package is installed.
Reference: Kerbl et al., 3D Gaussian Splatting, 2023; Zwicker et al., EWA Splatting, 2002.
"""

import importlib.util
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from monopart.geometry.cameras import Camera
from monopart.geometry.errors import BackendError

from .backend import choose_backend

SplatBackend = Literal["auto", "torch", "warp", "gsplat"]
BLUR = 0.3
"""Variance added to every splat, square pixels: none falls between the pixels."""
NEAREST = 0.01
"""Metres in front of the camera from which a Gaussian is seen."""
FAINT = 1 / 255
"""Where a splat's opacity is lower it counts as nothing."""
DENSE = 0.99
"""Highest opacity of a splat: light remains that tells of what lies behind."""
SPENT = 1e-4
"""A pixel is finished when less than this of its light is left."""
TILE = 16
"""Pixels along the side of a tile."""


@dataclass(frozen=True)
class Gaussians:
    """Gaussians in the world."""

    points: Float[Tensor, "n 3"]
    """Middles, metres."""
    factors: Float[Tensor, "n 3 3"]
    """Matrices F of the covariances F Fᵀ, metres: a rotation times sizes, then any linear map."""
    opacity: Float[Tensor, "n"]
    """In [0, 1]."""
    color: Float[Tensor, "n 3"]
    """In [0, 1]."""


@dataclass(frozen=True)
class Splats:
    """Gaussians as a camera sees them."""

    means: Float[Tensor, "n 2"]
    """Middles, pixels (x right, y down)."""
    covariances: Float[Tensor, "n 3"]
    """Entries xx, xy, yy, square pixels, widened by `BLUR`."""
    determinant: Float[Tensor, "n"]
    """Of the covariances: of needles it cannot be told from their entries in float32."""
    depth: Float[Tensor, "n"]
    """Along the optical axis, metres."""


def project_gaussians(gaussians: Gaussians, camera: Camera) -> Splats:
    """Splats of Gaussians: the perspective map is taken as linear around each middle.

    Args:
        gaussians: in the world.
        camera: without lens distortion.

    Returns:
        The splats; those nearer than `NEAREST` mean nothing. Differentiable in the Gaussians and
        in the camera.

    Raises:
        InputError: the camera has a lens.

    Reference: Zwicker et al., 2002, eq. (31): J W Σ Wᵀ Jᵀ.
    """
    slopes = camera.pixel_slopes(gaussians.points, NEAREST)
    means, depth = camera.project(gaussians.points)
    flat = slopes @ gaussians.factors
    u, v = flat.unbind(1)
    uu, uv, vv = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    # Cauchy-Binet: a sum of squares, where uu vv - uv² cancels.
    areas = torch.linalg.cross(u, v)
    determinant = (areas * areas).sum(-1) + BLUR * (uu + vv) + BLUR**2
    return Splats(means, torch.stack([uu + BLUR, uv, vv + BLUR], -1), determinant, depth)


def render_gaussians(
    gaussians: Gaussians, camera: Camera, backend: SplatBackend = "auto"
) -> Float[Tensor, "h w 4"]:
    """Picture of Gaussians over black.

    Args:
        gaussians: in the world.
        camera: without lens distortion; its size is that of the picture.
        backend: ``torch`` (any dtype, for few Gaussians), ``warp`` (float32, one derivative),
            ``gsplat`` (CUDA), ``auto``: gsplat on CUDA where it is installed, else Warp in
            float32, else torch.

    Returns:
        Colour times opacity, and opacity; differentiable in the Gaussians.

    Raises:
        InputError: the camera has a lens, or the back end is unknown.
        BackendError: a back end that was asked for by name cannot run.

    >>> one = Gaussians(torch.tensor([[0.0, 0, 2]]), torch.eye(3)[None], torch.ones(1) * 0.5,
    ...                 torch.ones(1, 3))
    >>> K = torch.tensor([[9.0, 0, 1.5], [0, 9, 1.5], [0, 0, 1]])
    >>> camera = Camera(K, torch.eye(3), torch.zeros(3), (3, 3))
    >>> render_gaussians(one, camera)[1, 1]
    tensor([0.5000, 0.5000, 0.5000, 0.5000])
    """
    chosen = _choose(gaussians.points, backend)
    if chosen == "gsplat":
        return _render_gsplat(gaussians, camera)
    splats = project_gaussians(gaussians, camera)
    xx, xy, yy = splats.covariances.unbind(-1)
    det = splats.determinant
    shapes = torch.stack([yy / det, -xy / det, xx / det, gaussians.opacity], -1)
    if chosen == "torch":
        return _blend_torch(splats, shapes, gaussians.color, camera.size)
    with torch.no_grad():
        starts, owner = assign_tiles(splats, gaussians.opacity, camera.size)
    return _Blend.apply(splats.means, shapes, gaussians.color, starts, owner, camera.size)


def _choose(points: Tensor, backend: SplatBackend) -> str:
    if backend not in ("auto", "gsplat"):
        return choose_backend(backend, points)
    able = points.is_cuda and importlib.util.find_spec("gsplat") is not None
    if backend == "gsplat" and not able:
        raise BackendError(
            f"backend 'gsplat': expected tensors on CUDA and the package, found {points.device}; "
            "pip install gsplat, or ask for 'warp'"
        )
    return "gsplat" if able else choose_backend("auto", points)


def assign_tiles(
    splats: Splats, opacity: Float[Tensor, "n"], size: tuple[int, int]
) -> tuple[Int[Tensor, "t1"], Int[Tensor, "p"]]:
    """List the splats that reach into each tile of `TILE` by `TILE` pixels, front to back.

    Args:
        splats: of one camera.
        opacity: of each, in [0, 1].
        size: (height, width) of the picture.

    Returns:
        Where the list of each tile starts in all lists, tiles row by row, one entry more than
        tiles; and the splats of the lists; both int32.
    """
    columns, rows = -(-size[1] // TILE), -(-size[0] // TILE)
    limit = opacity.new_tensor([columns, rows])
    reach = (2 * (opacity / FAINT).log().clamp_min(0)).sqrt()[:, None]
    reach = reach * splats.covariances[:, ::2].sqrt()
    low = ((splats.means - reach) / TILE).floor().clamp_min(0).minimum(limit).long()
    high = ((splats.means + reach) / TILE).floor().add(1).clamp_min(0).minimum(limit).long()
    seen = (splats.depth > NEAREST) & (reach > 0).all(-1)
    wide = torch.where(seen[:, None], high - low, 0)
    order = splats.depth.argsort(stable=True)
    count = wide[order].prod(-1)
    owner = torch.repeat_interleave(order, count)
    rank = torch.arange(len(owner), device=owner.device)
    rank = rank - torch.repeat_interleave(count.cumsum(0) - count, count)
    row, column = low[owner, 1] + rank // wide[owner, 0], low[owner, 0] + rank % wide[owner, 0]
    tiles, by_tile = (row * columns + column).sort(stable=True)
    every = torch.arange(columns * rows + 1, device=owner.device)
    return torch.searchsorted(tiles, every, out_int32=True), owner[by_tile].int()


def _blend_torch(splats: Splats, shapes: Tensor, color: Tensor, size: tuple[int, int]) -> Tensor:
    """The reference: all splats at all pixels, [N, H, W] at once."""
    order = splats.depth.detach().argsort(stable=True)
    order = order[splats.depth.detach()[order] > NEAREST]
    a, b, c, opacity = shapes[order, :, None, None].unbind(1)
    y = torch.arange(size[0], device=color.device, dtype=color.dtype)[:, None] + 0.5
    x = torch.arange(size[1], device=color.device, dtype=color.dtype) + 0.5
    dx, dy = (p - m[:, None, None] for p, m in zip((x, y), splats.means[order].T, strict=True))
    alpha = opacity * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = torch.where(alpha >= FAINT, alpha.clamp_max(DENSE), 0.0)
    light = torch.cat([torch.ones_like(alpha[:1]), (1 - alpha).cumprod(0)])[:-1]
    weights = torch.where(light >= SPENT, light * alpha, 0.0)
    painted = torch.cat([color[order], torch.ones_like(color[order, :1])], -1)
    return torch.einsum("nhw,nc->hwc", weights, painted)


class _Blend(torch.autograd.Function):
    """Means, shapes (inverse covariance and opacity), colours, tile lists, size to the picture."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        splats = [x.detach().float().contiguous() for x in inputs[:3]]
        starts, owner, size = inputs[3:]
        none = splats[0].new_zeros(0, 4)
        image, _ = _launch(splats, starts, owner, size, none, none[:, 0].contiguous())
        ctx.save_for_backward(*splats, starts, owner, image)
        return image.view(*size, 4)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        *splats, starts, owner, image = ctx.saved_tensors
        grad, size = grads[0].reshape(-1, 4).contiguous(), tuple(grads[0].shape[:2])
        _, pairs = _launch(splats, starts, owner, size, grad, (grad * image).sum(-1))
        both = zip(splats, pairs, strict=True)
        return *(torch.zeros_like(x).index_add_(0, owner, p) for x, p in both), None, None, None


def _launch(
    splats: list[Tensor], starts: Tensor, owner: Tensor, size: Any, grad: Tensor, total: Tensor
) -> tuple[Tensor, list[Tensor]]:
    """Colour and opacity of the pixels, and gradients of the pairs where ``grad`` is not empty."""
    from monopart.geometry.kernels.launch import launch, view

    from .kernels.splats import blend

    image = grad.new_tensor([0.0, 0, 0, 1]).repeat(size[0] * size[1], 1)
    pairs = [x.new_zeros(len(owner) if len(grad) else 0, x.shape[1]) for x in splats]
    args = [view(starts), view(owner), *(view(x, x.shape[1]) for x in splats), *size]
    args += [view(image, 4), view(grad, 4), view(total), *(view(x, x.shape[1]) for x in pairs)]
    launch(blend, len(starts) - 1, args, image, smallest=2)
    image[:, 3] = 1 - image[:, 3]
    return image, pairs


def _render_gsplat(gaussians: Gaussians, camera: Camera) -> Tensor:
    from gsplat import rasterization  # pyright: ignore[reportMissingImports]

    points, factors = gaussians.points, gaussians.factors
    view = torch.eye(4).to(points)
    view[:3, :3], view[:3, 3] = camera.R, camera.t
    color, opacity, _ = rasterization(
        points,
        None,  # quaternions and sizes: covariances are given
        None,
        gaussians.opacity,
        gaussians.color,
        view[None],
        camera.K.to(points)[None],
        camera.size[1],
        camera.size[0],
        near_plane=NEAREST,
        eps2d=BLUR,
        covars=factors @ factors.mT,
        packed=False,
    )
    return torch.cat([color[0], opacity[0]], -1)
