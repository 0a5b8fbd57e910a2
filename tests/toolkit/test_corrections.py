"""Corrections of poses: how they are composed, coupled in time, and regularised."""

import dataclasses

import numpy as np
import pytest
import torch

from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.errors import InputError
from monopart.geometry.rotations import axis_angle_to_rotmat
from monopart.toolkit.corrections import (
    ANGLE,
    LENGTH,
    PoseCorrections,
    error_covariance,
    frame_times,
)


def test_corrections_turn_on_top_of_the_given_rotations() -> None:
    generator = torch.Generator().manual_seed(1)
    draw = [torch.randn(s, generator=generator) for s in ((3, 24, 3), (3, 10), (3, 3), (3, 3))]
    poses = BodyPose(*draw)
    fix = PoseCorrections(5, 24, 10)
    for value in fix.parameters():
        torch.nn.init.normal_(value, std=0.2, generator=generator)
    rows = torch.tensor([4, 0, 2])
    found = fix(poses, rows)
    for n, row in enumerate(rows.tolist()):
        for joint in range(25):
            given = poses.pose[n, joint] if joint < 24 else poses.rotation[n]
            turned = found.pose[n, joint] if joint < 24 else found.rotation[n]
            change = fix.rotations[row, joint] * (joint > 0)
            expected = axis_angle_to_rotmat(change) @ axis_angle_to_rotmat(given)
            torch.testing.assert_close(axis_angle_to_rotmat(turned), expected, atol=3e-6, rtol=0)
    assert torch.equal(found.translation, poses.translation + fix.translations[rows])
    assert fix.betas is not None and torch.equal(found.betas, poses.betas + fix.betas)
    short = dataclasses.replace(poses, betas=poses.betas[:, :4])
    assert torch.equal(fix(short, rows).betas[:, 4:], fix.betas[4:].expand(3, -1))
    with pytest.raises(InputError, match="24 joints"):
        fix(dataclasses.replace(poses, pose=poses.pose[:, :20]), rows)
    none = PoseCorrections(5, 24)(poses, rows)
    torch.testing.assert_close(
        axis_angle_to_rotmat(none.pose), axis_angle_to_rotmat(poses.pose), atol=3e-6, rtol=0
    )


def test_regularisers_are_those_of_plain_loops() -> None:
    fix = PoseCorrections(6, 4, 2)
    for value in fix.parameters():
        torch.nn.init.normal_(value, std=0.1, generator=torch.Generator().manual_seed(2))
    frames = (0, 1, 2, 5, 8, 10)  # equal gaps around frames 1 and 5 alone
    angles = fix.rotations.detach().double().numpy() / ANGLE
    shifts = fix.translations.detach().double().numpy() / LENGTH
    size, rough = 0.0, []
    for row in range(6):
        size += (angles[row, 1:] ** 2).sum() / 6 + (shifts[row] ** 2).sum() / 6
    for row in range(1, 5):
        if frames[row + 1] - frames[row] == frames[row] - frames[row - 1]:
            total = 0.0
            for track in (angles[:, 1:], shifts):
                total += ((track[row + 1] - 2 * track[row] + track[row - 1]) ** 2).sum()
            rough.append(total)
    assert fix.betas is not None and len(rough) == 2
    size += (fix.betas.detach().double().numpy() ** 2).sum()
    assert float(fix.size().detach()) == pytest.approx(size, rel=1e-5)
    assert float(fix.roughness(frames).detach()) == pytest.approx(np.mean(rough), rel=1e-5)
    alone = PoseCorrections(2, 4)
    assert (
        float(alone.roughness((0, 1)).detach()) == 0.0
    )  # nothing to compare, and a gradient of zero
    alone.roughness((0, 1)).backward()
    assert alone.rotations.grad is not None and not alone.rotations.grad.any()


def test_the_covariance_is_that_of_smoothed_noise() -> None:
    """Against the sums of a drift that is made: white noise on a fine grid under a Gaussian."""
    times, drift, jitter = torch.tensor([0.0, 0.1, 0.5, 2.0]), 0.4, 0.3
    grid = torch.arange(-4.0, 6.0, 0.01, dtype=torch.float64)
    weight = torch.exp(-(times.double()[:, None] - grid).square() / (2 * drift**2))
    made = weight @ weight.mT
    expected = (1 - jitter) * made / made[0, 0] + jitter * torch.eye(4).double()
    found = error_covariance(times, drift, jitter)
    torch.testing.assert_close(found, expected, atol=1e-9, rtol=0)
    assert torch.equal(error_covariance(times, 0.0, 0.3), torch.eye(4, dtype=torch.float64))
    assert frame_times((0, 5, 20), None).tolist() == [0.0, 0.2, 0.8]
    for wrong in ((-0.1, 0.2), (0.5, 1.1), (float("nan"), 0.2)):
        with pytest.raises(InputError, match=r"refine\.drift"):
            error_covariance(times, *wrong)


def test_coupled_corrections_are_as_large_as_they_are_unlikely() -> None:
    times = frame_times((0, 1, 2, 3, 4, 9, 10), 12.0)
    fix = PoseCorrections(7, 4).double().couple(times, 0.5, 0.25)
    assert fix.mix is not None and "mix" not in fix.state_dict()
    torch.testing.assert_close(fix.mix @ fix.mix, error_covariance(times, 0.5, 0.25))
    for value in fix.parameters():
        torch.nn.init.normal_(value, std=0.02, generator=torch.Generator().manual_seed(5))
    with torch.no_grad():
        fix.rotations[:, 0] = 0.0  # the root joint has no correction
    still = BodyPose(torch.zeros(7, 4, 3), torch.zeros(7, 2), torch.zeros(7, 3), torch.zeros(7, 3))
    posed = fix(still.to(fix.translations), torch.arange(7))
    angles = torch.cat([posed.pose, posed.rotation[:, None]], 1).flatten(1) / ANGLE
    moved = torch.cat([angles, posed.translation / LENGTH], 1).detach()
    inverse = torch.linalg.inv(error_covariance(times, 0.5, 0.25))
    expected = float((moved * (inverse @ moved)).sum()) / 7
    assert float(fix.size().detach()) == pytest.approx(expected, rel=1e-5)
    some = fix(
        BodyPose(*(v[:2] for v in vars(still.to(fix.translations)).values())), torch.tensor([5, 2])
    )
    torch.testing.assert_close(some.pose, posed.pose[[5, 2]])


def test_a_step_moves_neighbours_as_far_as_they_share_the_drift() -> None:
    def moved(drift: float) -> torch.Tensor:
        fix = PoseCorrections(60, 4).double().couple(frame_times(range(60), 12.0), drift, 0.25)
        still = BodyPose.zeros(BodyModel.default(), (1,))
        still = dataclasses.replace(still, pose=still.pose[:, :4]).to(fix.translations)
        fix(still, torch.tensor([30])).translation.sum().backward()
        gradient = fix.translations.grad
        assert gradient is not None
        with torch.no_grad():
            fix.translations.add_(gradient)  # one plain step
        every = BodyPose(*(v.expand(60, *v.shape[1:]) for v in vars(still).values()))
        return fix(every, torch.arange(60)).translation[:, 0].detach()

    alone, shared = moved(0.0), moved(0.5)
    assert alone[30] == 1.0 and not alone[29] and not alone[31]
    expected = error_covariance(frame_times(range(60), 12.0), 0.5, 0.25)[30]
    torch.testing.assert_close(shared, expected)
    assert 0.7 < float(shared[31]) < 0.75 and float(shared[0]) < 0.05
