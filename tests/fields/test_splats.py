"""Gaussians to pictures: the oracle, the reference and the kernel; gradients; edges."""

import sys
import types
from typing import Any

import pytest
import torch
from torch import Tensor

from monopart.fields import Gaussians, project_gaussians, render_gaussians
from monopart.fields import splats as room
from monopart.geometry import BackendError, Camera, InputError

NAMES = ("points", "factors", "opacity", "color")


def camera_of(size: tuple[int, int], dtype: torch.dtype = torch.float32) -> Camera:
    eye, up = torch.tensor([0.3, 0.2, 2.5], dtype=dtype), torch.tensor([0.0, 1, 0], dtype=dtype)
    return Camera.look_at(eye, torch.zeros(3, dtype=dtype), up, size, fov=0.5)


def cloud(count: int, size: float = 0.04, dtype: torch.dtype = torch.float64) -> Gaussians:
    factors = size * torch.randn(count, 3, 3, dtype=dtype)
    opacity = torch.rand(count, dtype=dtype).clamp(0.02)
    opacity[::3] = 1.0  # beyond what a splat may cover
    points = 0.4 * torch.randn(count, 3, dtype=dtype)
    return Gaussians(points, factors, opacity, torch.rand(count, 3, dtype=dtype))


def single(gaussians: Gaussians) -> Gaussians:
    return Gaussians(*(getattr(gaussians, n).detach().float().requires_grad_() for n in NAMES))


def oracle(gaussians: Gaussians, camera: Camera) -> Tensor:
    """Pixel by pixel and splat by splat in plain numbers; the covariance by autograd of project."""
    height, width = camera.size
    splats = []
    for i, point in enumerate(gaussians.points):
        slope = torch.autograd.functional.jacobian(lambda p: camera.project(p)[0], point)
        half = slope @ gaussians.factors[i]
        inverse = torch.linalg.inv(half @ half.T + 0.3 * torch.eye(2, dtype=point.dtype))
        pixel, depth = camera.project(point)
        splats.append((float(depth), pixel, inverse, gaussians.opacity[i], gaussians.color[i]))
    image = torch.zeros(height, width, 4, dtype=torch.float64)
    for y in range(height):
        for x in range(width):
            light = 1.0
            for depth, pixel, inverse, opacity, color in sorted(splats, key=lambda s: s[0]):
                d = torch.tensor([x + 0.5, y + 0.5], dtype=torch.float64) - pixel
                alpha = min(0.99, float(opacity * torch.exp(-0.5 * d @ inverse @ d)))
                if depth <= 0.01 or alpha < 1 / 255 or light < 1e-4:
                    continue
                image[y, x, :3] += light * alpha * color
                light *= 1 - alpha
            image[y, x, 3] = 1 - light
    return image


@pytest.mark.parametrize("backend", ["torch", "warp"])
def test_oracle(backend: Any) -> None:
    """Sizes that are no multiple of a tile; one Gaussian behind the camera, one outside."""
    gaussians, camera = cloud(40), camera_of((21, 35), torch.float64)
    gaussians.points[0] = camera.center + camera.center
    gaussians.points[1] = torch.tensor([30.0, 0, 0])
    given = gaussians if backend == "torch" else single(gaussians)
    found = render_gaussians(given, camera, backend).detach().double()
    true = oracle(gaussians, camera)
    error = (found - true).abs()
    assert true[..., 3].max() > 0.9 and true[..., 3].min() == 0
    assert error.max() < (1e-12 if backend == "torch" else 2e-5)


def test_the_kernel_knows_the_same_constants() -> None:
    from monopart.fields.kernels import splats as kernels

    for name in ("TILE", "FAINT", "DENSE", "SPENT"):
        assert getattr(kernels, name) == getattr(room, name), name


@pytest.mark.parametrize("count", [1, 30, 600])
def test_kernel_equals_the_reference(count: int) -> None:
    """Value and gradient; 600 large ones finish pixels early, in many tiles."""
    exact, camera = cloud(count, 0.08), camera_of((50, 40))
    target = torch.rand(50, 40, 4)
    grads = []
    for backend in ("torch", "warp"):
        given = single(exact)
        image = render_gaussians(given, camera, backend)
        (image - target).square().sum().backward()
        grads.append((image.detach(), *(getattr(given, n).grad for n in NAMES)))
    for slow, fast, name in zip(*grads, ("image", *NAMES), strict=True):
        scale = slow.abs().max()
        assert scale > 0
        # a pixel where a splat is all but faint may fall on either side of the limit
        far = ((slow - fast).abs() > 1e-3 * scale).double().mean()
        assert far <= 2e-3, (name, float(far), float((slow - fast).abs().max() / scale))


def test_gradcheck_of_the_reference() -> None:
    camera = camera_of((5, 4), torch.float64)
    factors = 0.5 * torch.eye(3, dtype=torch.float64) + 0.05 * torch.randn(3, 3, 3).double()
    points = torch.tensor([[0.0, 0.1, 0.2], [0.1, 0, 0], [0, 0, -0.3]], dtype=torch.float64)
    opacity = torch.tensor([0.5, 0.3, 0.8], dtype=torch.float64)  # faint and dense are kinks
    values = [points, factors, opacity, torch.rand(3, 3, dtype=torch.float64)]
    values = [v.requires_grad_() for v in values]

    def draw(*tensors: Tensor) -> Tensor:
        return render_gaussians(Gaussians(*tensors), camera, "torch")

    assert torch.autograd.gradcheck(draw, values)


def test_an_axis_aligned_gaussian_by_hand() -> None:
    K = torch.tensor([[100.0, 0, 10], [0, 100, 10], [0, 0, 1]])
    camera = Camera(K, torch.eye(3), torch.zeros(3), (20, 20))
    one = Gaussians(
        torch.tensor([[0.0, 0, 4]]),
        torch.diag(torch.tensor([0.2, 0.08, 0.3]))[None],
        torch.ones(1),
        torch.ones(1, 3),
    )
    splats = project_gaussians(one, camera)
    assert torch.allclose(splats.means, torch.tensor([[10.0, 10]]))
    # 100 px * 0.2 m / 4 m = 5 px, and 2 px
    assert torch.allclose(splats.covariances, torch.tensor([[25.3, 0, 4.3]]))


@pytest.mark.parametrize("backend", ["torch", "warp"])
@pytest.mark.parametrize("case", ["none", "behind", "faint", "outside"])
def test_nothing_to_see(case: str, backend: Any) -> None:
    gaussians, camera = single(cloud(0 if case == "none" else 5)), camera_of((8, 9))
    with torch.no_grad():
        if case == "behind":
            gaussians.points.add_(2 * camera.center)
        elif case == "faint":
            gaussians.opacity.fill_(0.003)
        elif case == "outside":
            gaussians.points[:, 0] += 40.0
    image = render_gaussians(gaussians, camera, backend)
    assert image.shape == (8, 9, 4) and not image.any()
    image.sum().backward()
    assert all(not getattr(gaussians, n).grad.any() for n in NAMES)


def test_a_needle_and_a_giant_stay_finite() -> None:
    gaussians, camera = single(cloud(4)), camera_of((30, 30))
    with torch.no_grad():
        gaussians.factors[0] = torch.diag(torch.tensor([1e-9, 1e-9, 1e-9]))
        gaussians.factors[1] = 50 * torch.eye(3)
        gaussians.points[2] = camera.center + torch.tensor([0.0, 0, -0.011])  # next to the lens
    image = render_gaussians(gaussians, camera, "warp")
    image.square().sum().backward()
    assert image.isfinite().all() and image[..., 3].max() <= 1
    assert all(getattr(gaussians, n).grad.isfinite().all() for n in NAMES)


def test_wrong_input() -> None:
    gaussians, camera = single(cloud(2)), camera_of((8, 8))
    bent = Camera(camera.K, camera.R, camera.t, camera.size, torch.tensor([0.1, 0, 0, 0]))
    with pytest.raises(InputError, match="camera: expected a pinhole"):
        render_gaussians(gaussians, bent)
    with pytest.raises(BackendError, match="gsplat"):
        render_gaussians(gaussians, camera, "gsplat")
    with pytest.raises(BackendError, match="warp"):
        render_gaussians(cloud(2), camera_of((8, 8), torch.float64), "warp")


def test_what_gsplat_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its arguments, in its own conventions, describe the picture that the reference draws."""

    def rasterization(
        means: Tensor,
        quats: None,
        scales: None,
        opacities: Tensor,
        colors: Tensor,
        *view: Any,
        **how: Any,
    ) -> tuple[Tensor, Tensor, dict[str, Any]]:
        viewmats, Ks, width, height = view
        assert quats is None and scales is None and how["packed"] is False
        assert (how["near_plane"], how["eps2d"]) == (0.01, 0.3)
        seen = Camera(Ks[0], viewmats[0, :3, :3], viewmats[0, :3, 3], (height, width))
        factors = torch.linalg.cholesky(how["covars"])
        image = render_gaussians(Gaussians(means, factors, opacities, colors), seen, "torch")
        return image[None, ..., :3], image[None, ..., 3:], {}

    module: Any = types.ModuleType("gsplat")
    module.rasterization = rasterization
    monkeypatch.setitem(sys.modules, "gsplat", module)
    gaussians, camera = cloud(10, 0.1), camera_of((12, 16), torch.float64)
    found = room._render_gsplat(gaussians, camera)
    assert torch.allclose(found, render_gaussians(gaussians, camera, "torch"), atol=1e-9)


@pytest.mark.gpu
def test_gsplat_and_cuda_agree_with_the_reference() -> None:
    gaussians = single(cloud(200))
    there = Gaussians(*(getattr(gaussians, n).detach().to("cuda") for n in NAMES))
    camera = camera_of((40, 50))
    true = render_gaussians(gaussians, camera, "torch")
    on_cuda = camera.to(there.points)
    assert (render_gaussians(there, on_cuda, "warp").cpu() - true).abs().max() < 1e-2
    pytest.importorskip("gsplat")
    assert (render_gaussians(there, on_cuda, "gsplat").cpu() - true).abs().max() < 2e-2


def test_needles_of_any_length_keep_their_width() -> None:
    """In float32 the determinant of the covariance of a long needle across the axes cancels."""
    turn = torch.linalg.qr(torch.ones(3, 3) + torch.eye(3).double().flip(0).float())[0]
    factors = (turn * torch.tensor([300.0, 1e-5, 1e-5]))[None]
    needle = Gaussians(torch.zeros(1, 3), factors, torch.ones(1) * 0.5, torch.ones(1, 3))
    exact = Gaussians(*(getattr(needle, n).double() for n in NAMES))
    wanted = render_gaussians(exact, camera_of((16, 16), torch.float64), "torch")
    assert 0.03 < float(wanted[..., 3].mean()) < 0.1, "a line through the picture"
    for backend in ("torch", "warp"):
        found = render_gaussians(needle, camera_of((16, 16)), backend)  # pyright: ignore[reportArgumentType]
        assert float((found - wanted).abs().max()) < 1e-3
