"""Skinning against float64 loops, its inverse, and its gradients."""

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from monopart.geometry import backend as backends
from monopart.geometry.errors import BackendError, InputError
from monopart.geometry.rigid import rigid
from monopart.geometry.rotations import axis_angle_to_rotmat
from monopart.geometry.skinning import SkinWeights, blend_skin, blend_transforms, skin, unskin


def random_weights(num_points: int, num_joints: int) -> torch.Tensor:
    weights = torch.rand(num_points, num_joints, dtype=torch.float64)
    return weights / weights.sum(-1, keepdim=True)


def random_transforms(*batch: int, spread: float = 1.0) -> torch.Tensor:
    axis_angle = spread * torch.randn(*batch, 3, dtype=torch.float64)
    return rigid(axis_angle_to_rotmat(axis_angle), torch.randn(*batch, 3, dtype=torch.float64))


@pytest.mark.parametrize("batch", [(), (2,), (2, 3), (0,)])
def test_against_the_loop(batch: tuple[int, ...]) -> None:
    weights, transforms = random_weights(6, 4), random_transforms(*batch, 4)
    points = torch.randn(*batch, 6, 3, dtype=torch.float64)
    blended = blend_transforms(transforms, weights)
    assert blended.shape == (*batch, 6, 4, 4)
    posed = skin(points, blended)
    cases = (posed.reshape(-1, 6, 3), points.reshape(-1, 6, 3), transforms.reshape(-1, 4, 4, 4))
    for found, p, t in zip(*cases, strict=True):
        expected = oracles.linear_blend_skinning(p.numpy(), weights.numpy(), t.numpy())
        np.testing.assert_allclose(found.numpy(), expected, atol=1e-13)


def test_blend_is_the_weighted_sum() -> None:
    weights, transforms = random_weights(6, 4), random_transforms(4)
    expected = torch.einsum("nj,jrc->nrc", weights, transforms)
    torch.testing.assert_close(blend_transforms(transforms, weights), expected)


def test_no_points() -> None:
    blended = blend_transforms(random_transforms(2, 4), torch.zeros(0, 4, dtype=torch.float64))
    points, valid = unskin(torch.zeros(2, 0, 3, dtype=torch.float64), blended)
    assert points.shape == (2, 0, 3) and valid.shape == (2, 0)


@given(st.integers(0, 10_000))
def test_unskin_undoes_skin(seed: int) -> None:
    torch.manual_seed(seed)
    blended = blend_transforms(random_transforms(3, 4, spread=0.6), random_weights(6, 4))
    points = torch.randn(3, 6, 3, dtype=torch.float64)
    back, valid = unskin(skin(points, blended), blended)
    torch.testing.assert_close(back[valid], points[valid], atol=1e-11, rtol=0)
    assert torch.equal(valid, torch.linalg.det(blended[..., :3, :3]).abs() > 1e-2)


def test_unskin_keeps_its_digits_far_from_the_origin() -> None:
    transforms = random_transforms(500).float()
    points = torch.randn(500, 3)
    transforms[:, :3, 3] *= 100
    posed = skin(points, transforms)
    back, valid = unskin(posed, transforms)
    exact = (posed.double() - transforms[:, :3, 3].double())[:, None] @ transforms[
        :, :3, :3
    ].double()
    assert valid.all()
    assert (back.double() - exact[:, 0]).abs().max() < 2e-6 + 1e-6  # no term of the size of t · eps


def test_opposite_rotations_blend_to_a_masked_singular_map() -> None:
    half_turn = rigid(torch.diag(torch.tensor([-1.0, -1.0, 1.0])), torch.ones(3))
    transforms = torch.stack((rigid(torch.eye(3), torch.ones(3)), half_turn)).requires_grad_()
    weights = torch.tensor([[0.5, 0.5], [1.0, 0.0]], requires_grad=True)
    points = torch.ones(2, 3, requires_grad=True)
    rest, valid = unskin(points, blend_transforms(transforms, weights))
    assert valid.tolist() == [False, True]
    assert rest.isfinite().all()
    rest.square().sum().backward()
    for tensor in (transforms, weights, points):
        assert tensor.grad is not None and tensor.grad.isfinite().all()


def test_transform_that_is_not_finite_is_masked() -> None:
    blended = random_transforms(2)
    blended[0, 1, 3] = float("nan")
    rest, valid = unskin(torch.ones(2, 3, dtype=torch.float64), blended)
    assert valid.tolist() == [False, True] and rest.isfinite().all()


def test_gradients() -> None:
    transforms = random_transforms(3, spread=0.5).requires_grad_()
    weights = random_weights(3, 3).requires_grad_()
    points = torch.randn(3, 3, dtype=torch.float64, requires_grad=True)

    def forward(t: torch.Tensor, w: torch.Tensor, p: torch.Tensor) -> torch.Tensor:
        return skin(p, blend_transforms(t, w))

    def backward(t: torch.Tensor, w: torch.Tensor, p: torch.Tensor) -> torch.Tensor:
        return unskin(p, blend_transforms(t, w))[0]

    assert torch.autograd.gradcheck(forward, (transforms, weights, points))
    assert torch.autograd.gradcheck(backward, (transforms, weights, points))


# --- skinning in one step, on the kernels ---------------------------------------------------------


def sparse_weights(num_points: int, num_joints: int, kept: int = 2) -> torch.Tensor:
    """Rows with about ``kept`` weights that are not zero, at least one each."""
    weights = random_weights(num_points, num_joints)
    share = torch.rand(num_points, num_joints, dtype=torch.float64)
    share[:, 0] *= 0.2
    weights = torch.where(share <= kept / num_joints, weights, 0.0) + 1e-3 * (share < 0.02)
    weights[:, 0] += weights.sum(-1) == 0
    return weights / weights.sum(-1, keepdim=True)


def posed_and_gradients(
    points: torch.Tensor, transforms: torch.Tensor, weights: torch.Tensor, backend: str
) -> list[torch.Tensor]:
    points, transforms = (t.detach().clone().requires_grad_() for t in (points, transforms))
    posed = blend_skin(points, transforms, SkinWeights(weights), backend)
    pull = torch.linspace(-1, 1, posed.numel(), dtype=posed.dtype).view_as(posed)
    gradients = torch.autograd.grad((pull * posed).sum(), (points, transforms))
    return [posed.detach(), *gradients]


@pytest.mark.parametrize("batch", [(), (1,), (2,), (2, 3), (0,)])
@pytest.mark.parametrize(
    ("num_points", "num_joints", "kept"),
    [(1, 1, 1), (300, 1, 1), (1, 4, 4), (50, 5, 2), (700, 24, 3), (200, 24, 24), (0, 3, 3)],
)
def test_kernels_equal_their_twin(
    batch: tuple[int, ...], num_points: int, num_joints: int, kept: int
) -> None:
    torch.manual_seed(num_points)
    weights = sparse_weights(num_points, num_joints, kept).float()
    points = torch.randn(*batch, num_points, 3)
    transforms = random_transforms(*batch, num_joints).float()
    exact = posed_and_gradients(points.double(), transforms.double(), weights.double(), "torch")
    found = posed_and_gradients(points, transforms, weights, "warp")
    twin = posed_and_gradients(points, transforms, weights, "torch")
    automatic = posed_and_gradients(points, transforms, weights, "auto")
    for have, other, same, want in zip(found, twin, automatic, exact, strict=True):
        assert have.dtype == torch.float32 and have.shape == want.shape
        assert torch.equal(have, same)
        if want.numel() > 0:
            scale = want.abs().max() + 1
            assert (have.double() - want).abs().max() / scale < 2e-6
            torch.testing.assert_close(have, other, atol=float(4e-6 * scale), rtol=0)


def test_kernels_against_the_loop() -> None:
    weights, transforms = sparse_weights(40, 6), random_transforms(6)
    points = torch.randn(40, 3, dtype=torch.float64)
    found = blend_skin(points.float(), transforms.float(), SkinWeights(weights.float()), "warp")
    expected = oracles.linear_blend_skinning(points.numpy(), weights.numpy(), transforms.numpy())
    np.testing.assert_allclose(found.numpy(), expected, atol=3e-6)


@pytest.mark.parametrize("backend", ["warp", "torch"])
def test_points_and_transforms_broadcast_and_may_be_strided(backend: str) -> None:
    weights = sparse_weights(30, 4).float()
    points, transforms = torch.randn(3, 30).mT, random_transforms(2, 4).float()
    whole = posed_and_gradients(points.expand(2, 30, 3), transforms, weights, backend)
    found = posed_and_gradients(points, transforms, weights, backend)
    whole[1] = whole[1].sum(0)
    torch.testing.assert_close(found, whole)


def test_kernels_give_the_same_bits_on_any_number_of_threads() -> None:
    weights = sparse_weights(3000, 24, 3).float()
    points, transforms = torch.randn(4, 3000, 3), random_transforms(4, 24).float()
    before = torch.get_num_threads()
    runs = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        try:
            runs.append(posed_and_gradients(points, transforms, weights, "warp"))
        finally:
            torch.set_num_threads(before)
    for other in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(runs[0], other, strict=True))


def test_gradients_of_the_twin() -> None:
    weights = sparse_weights(4, 3).requires_grad_()
    points = torch.randn(2, 4, 3, dtype=torch.float64, requires_grad=True)
    transforms = random_transforms(2, 3, spread=0.5).requires_grad_()

    def run(p: torch.Tensor, t: torch.Tensor, w: torch.Tensor) -> torch.Tensor:
        return blend_skin(p, t, SkinWeights(w), "torch")

    assert torch.autograd.gradcheck(run, (points, transforms, weights))
    assert torch.autograd.gradgradcheck(run, (points, transforms, weights))


def test_what_the_kernels_cannot_do(monkeypatch: pytest.MonkeyPatch) -> None:
    fixed = sparse_weights(5, 2).float()
    points, transforms = torch.randn(5, 3), random_transforms(2).float()
    with pytest.raises(BackendError, match="expected float32"):
        blend_skin(points.double(), transforms.double(), SkinWeights(fixed.double()), "warp")
    fitted = SkinWeights(fixed.clone().requires_grad_())
    with pytest.raises(BackendError, match="no gradient in the weights"):
        blend_skin(points, transforms, fitted, "warp")
    blend_skin(points, transforms, fitted).sum().backward()
    assert fitted.dense.grad is not None and fitted.dense.grad.any()
    points.requires_grad_()
    posed = blend_skin(points, transforms, SkinWeights(fixed), "warp")
    with pytest.raises(BackendError, match=r"second derivative .*backend='torch'"):
        torch.autograd.grad(posed.sum(), points, create_graph=True)
    monkeypatch.setattr(backends, "warp_is_installed", lambda: False)
    with pytest.raises(BackendError, match="pip install"):
        blend_skin(points, transforms, SkinWeights(fixed), "warp")
    assert torch.allclose(blend_skin(points, transforms, SkinWeights(fixed)), posed, atol=1e-5)


def test_arrays_that_do_not_fit_the_weights_are_refused() -> None:
    weights, transforms = SkinWeights(sparse_weights(5, 2).float()), random_transforms(2).float()
    for bad in (torch.zeros(4, 3), torch.zeros(5, 3, dtype=torch.float64)):
        with pytest.raises(InputError, match=r"expected \(5, 2\) points and transforms"):
            blend_skin(bad, transforms, weights)
