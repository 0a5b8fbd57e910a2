"""Harmonics of a normal: what they can say of a light, and how they turn."""

import torch

from monopart.fields.irradiance import NUM_IRRADIANCE, ZONAL, irradiance_basis
from monopart.geometry.rotations import axis_angle_to_rotmat

DOUBLE = torch.float64


def normals(count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.nn.functional.normalize(
        torch.randn(count, 3, generator=generator, dtype=DOUBLE), dim=-1
    )


def test_with_a_constant_they_hold_the_light_of_any_distant_lamps() -> None:
    looks, lamps = normals(4000), normals(6)
    strength = torch.tensor([1.0, 0.4, 0.7, 0.2, 0.9, 0.5], dtype=DOUBLE)
    exact = ((looks @ lamps.T).clamp_min(0) * strength).sum(1)
    basis = torch.cat([torch.ones(4000, 1, dtype=DOUBLE), irradiance_basis(looks)], 1)
    fitted = basis @ torch.linalg.lstsq(basis, exact[:, None]).solution
    lost, whole = (fitted[:, 0] - exact).square().mean(), exact.square().mean()
    assert float(lost) < 0.01 * float(whole)
    first_order = basis[:, :4] @ torch.linalg.lstsq(basis[:, :4], exact[:, None]).solution
    assert float((first_order[:, 0] - exact).square().mean()) > 3 * float(lost)


def test_a_turned_normal_stays_in_their_span() -> None:
    looks = normals(200)
    turn = axis_angle_to_rotmat(torch.tensor([0.3, -1.1, 0.8], dtype=DOUBLE))
    plain, turned = irradiance_basis(looks), irradiance_basis(looks @ turn.T)
    fitted = plain @ torch.linalg.lstsq(plain, turned).solution
    torch.testing.assert_close(fitted, turned, atol=1e-12, rtol=0)


def test_turns_about_the_third_axis_leave_two_of_them_alone_and_cancel_the_others() -> None:
    looks, angles = normals(50), torch.arange(12, dtype=DOUBLE) * torch.pi / 6
    turns = axis_angle_to_rotmat(angles[:, None] * torch.tensor([0.0, 0, 1], dtype=DOUBLE))
    turned = irradiance_basis(looks @ turns.mT)
    expected = torch.zeros(50, NUM_IRRADIANCE, dtype=DOUBLE)
    expected[:, ZONAL] = irradiance_basis(looks)[:, ZONAL]
    torch.testing.assert_close(turned.mean(0), expected, atol=1e-12, rtol=0)
    assert float((turned - turned[:1])[..., ZONAL].abs().max()) < 1e-12


def test_shapes_derivatives_and_the_zero_normal() -> None:
    assert irradiance_basis(torch.zeros(0, 3)).shape == (0, NUM_IRRADIANCE)
    assert irradiance_basis(torch.zeros(2, 4, 3)).unique().tolist() == [0.0]
    assert torch.autograd.gradcheck(irradiance_basis, (normals(5).requires_grad_(),))
