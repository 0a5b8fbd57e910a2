"""Alignment of poses: against pictures whose poses are known, and its linear system."""

import dataclasses
from itertools import pairwise
from pathlib import Path

import noisy_track
import pytest
import torch
from miniature import write_miniature
from torch import Tensor

from monopart.geometry.body import BodyPose
from monopart.geometry.cameras import Camera
from monopart.toolkit.alignment_schedule import align_when_due, passed
from monopart.toolkit.avatar import Avatar, View
from monopart.toolkit.captures import read_capture
from monopart.toolkit.config import RefineConfig
from monopart.toolkit.corrections import PoseCorrections, frame_times
from monopart.toolkit.pose_alignment import (
    Shots,
    _filled,
    _shrunk,
    _solve,
    align_poses,
)
from monopart.toolkit.presets import preset, with_overrides
from monopart.toolkit.refine import RefinedPoses
from monopart.toolkit.render import render_view
from monopart.toolkit.train import Trainer

SMALL = with_overrides(
    preset("fast"),
    loss={"lpips": 0.0},
    appearance={"light": False},
    train={"iterations": 8, "rays": 256},
    field={"log2_size": 9, "levels": 3, "hidden": 16},
    deform={"log2_size": 8, "hidden": 16},
    refine={"poses": True, "frames": 2, "evidence": 1e4},
)
FRAMES = (0, 1, 2)


@pytest.fixture(scope="module")
def avatar(tmp_path_factory: pytest.TempPathFactory) -> Avatar:
    root = write_miniature(tmp_path_factory.mktemp("captures") / "one", size=96)
    torch.manual_seed(0)
    made = Avatar.create(read_capture(root), SMALL)
    made.model.eval()
    return made


def refined(avatar: Avatar, spec: RefineConfig | None = None) -> RefinedPoses:
    if spec is not None:
        config = dataclasses.replace(avatar.config, refine=spec)
        avatar = dataclasses.replace(avatar, config=config)
    fix = PoseCorrections(len(FRAMES), avatar.record.body.num_joints)
    used = avatar.config.refine
    fix.couple(frame_times(FRAMES, avatar.record.fps), used.drift, used.jitter)
    return RefinedPoses(avatar, FRAMES, fix)


def pictures(avatar: Avatar, poses: dict[int, BodyPose], cameras: int = 1) -> Shots:
    """What the avatar looks like: pictures that were taken of it at known poses."""
    images, masks, seen, rows = [], [], [], []
    for camera in range(cameras):
        for row, frame in enumerate(FRAMES):
            one = avatar.record.cameras[camera]
            picture = render_view(avatar, View(camera=one, pose=poses[frame], frame=frame))
            images.append((picture.color * 255.0).round().to(torch.uint8))
            masks.append(picture.opacity > 0.5)
            seen.append(one)
            rows.append(row)
    return Shots(torch.stack(images), torch.stack(masks), seen, rows)


def wrong(fix: PoseCorrections, size: float, seed: int) -> tuple[Tensor, Tensor]:
    """Corrections as a tracker errs, and the joints that they move."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        fix.rotations.copy_(size * torch.randn(fix.rotations.shape, generator=generator) * fix.free)
        fix.translations.copy_(0.3 * size * torch.randn(len(FRAMES), 3, generator=generator))
    return fix.rotations.detach().clone(), fix.translations.detach().clone()


def joints(poses: RefinedPoses) -> Tensor:
    with torch.no_grad():
        posed = poses.avatar.record.body(poses.poses(torch.arange(len(FRAMES))))
        return posed.to_world(posed.joints)


def test_finds_the_poses_of_its_own_pictures(avatar: Avatar) -> None:
    """From two sides whole, by silhouettes alone: the colours of this avatar are still flat."""
    poses = refined(avatar)
    exact = joints(poses)
    shots = pictures(avatar, avatar.record.poses, 2)
    wrong(poses.corrections, 0.012, 1)
    before = (joints(poses) - exact).norm(dim=-1).mean()
    found = [align_poses(poses, shots) for _ in range(4)]
    after = (joints(poses) - exact).norm(dim=-1).mean()
    assert before > 0.01 and after < 0.4 * before
    assert found[-1]["rms"] < 0.4 * found[0]["rms"]
    assert found[-1]["radians"] < found[0]["radians"]
    assert not (poses.corrections.rotations * (1 - poses.corrections.free)).any()


def test_one_camera_finds_what_it_sees_and_keeps_its_depth(avatar: Avatar) -> None:
    poses = refined(avatar, dataclasses.replace(SMALL.refine, evidence=10.0))
    exact = joints(poses)
    shots = pictures(avatar, avatar.record.poses)
    wrong(poses.corrections, 0.02, 1)

    def errors() -> tuple[float, float]:
        seen = (joints(poses) - exact) @ avatar.record.cameras[0].R.T
        return float(seen[..., :2].norm(dim=-1).mean()), float(seen[..., 2].abs().mean())

    before = errors()
    for _ in range(4):
        align_poses(poses, shots)
    after = errors()
    assert after[0] < 0.5 * before[0] and after[1] < 1.1 * before[1]


def test_what_pictures_do_not_say_is_left_to_the_prior(avatar: Avatar) -> None:
    poses = refined(avatar, dataclasses.replace(SMALL.refine, evidence=0.0))
    shots = pictures(avatar, avatar.record.poses)
    wrong(poses.corrections, 0.03, 2)
    align_poses(poses, shots)
    assert float(poses.corrections.rotations.detach().abs().max()) < 1e-8
    assert float(poses.corrections.translations.detach().abs().max()) < 1e-8


def test_a_frame_that_shows_nobody_follows_its_neighbours(avatar: Avatar) -> None:
    """A mask without a pixel leaves numbers finite, and the drift ties its frame to the others."""
    poses = refined(avatar)
    shots = pictures(avatar, avatar.record.poses)
    away = avatar.record.cameras[0]
    away = dataclasses.replace(away, t=away.t + torch.tensor([50.0, 0.0, 0.0]).to(away.t))
    masks = shots.masks.clone()
    masks[1] = False
    cameras = [shots.cameras[0], away, shots.cameras[2]]
    wrong(poses.corrections, 0.02, 3)
    facts = align_poses(poses, Shots(shots.images, masks, cameras, shots.rows))
    assert all(torch.isfinite(torch.tensor(v)) for v in facts.values())
    assert bool(poses.corrections.rotations.isfinite().all())


def test_the_linear_system_is_solved() -> None:
    torch.manual_seed(0)
    half = torch.randn(4, 5, 9, dtype=torch.float64)
    square = half.mT @ half * torch.logspace(-2, 1, 4, dtype=torch.float64)[:, None, None]
    mix = torch.randn(4, 4, dtype=torch.float64)
    mix = mix @ mix.T
    right = torch.randn(4, 9, dtype=torch.float64)
    whole = torch.kron(mix, torch.eye(9, dtype=torch.float64))
    dense = torch.eye(36, dtype=torch.float64) + whole @ torch.block_diag(*square) @ whole
    expected = torch.linalg.solve(dense, right.flatten()).view(4, 9)
    torch.testing.assert_close(_solve(square, mix, right), expected, rtol=1e-4, atol=1e-5)
    assert not _solve(square, mix, torch.zeros_like(right)).any()


def test_depths_are_carried_over_the_edge_alone() -> None:
    depth, known = torch.zeros(1, 12), torch.zeros(1, 12, dtype=torch.bool)
    depth[0, :3], known[0, :3] = 2.0, True
    assert _filled(depth, known)[0].tolist() == pytest.approx([2.0] * 7 + [0.0] * 5)


def test_pictures_are_never_enlarged() -> None:
    camera = Camera(torch.eye(3), torch.eye(3), torch.zeros(3), (48, 64))
    assert _shrunk(camera, 256).size == (48, 64)
    assert _shrunk(dataclasses.replace(camera, size=(1024, 512)), 256).size == (256, 128)


def test_each_alignment_is_due_once() -> None:
    spec = RefineConfig(align=5, align_start=0.16, align_end=0.5)
    due = [passed(spec, done / 100) for done in range(100)]
    assert due[15] == 0 and due[16] == 1 and due[50] == 5 and due[99] == 5
    assert sorted(due) == due and passed(dataclasses.replace(spec, align=0), 1.0) == 0


def test_a_training_aligns_and_then_holds_its_poses(tmp_path: Path) -> None:
    root = write_miniature(tmp_path / "two", size=48)
    spec = {"align": 2, "align_start": 0.25, "align_end": 0.5, "start": 0.0, "align_size": 32}
    config = with_overrides(SMALL, refine=spec)
    torch.manual_seed(0)
    trained = Trainer(Avatar.create(read_capture(root), config))
    assert trained.refined is not None
    fix = trained.refined.corrections
    seen: list[Tensor] = []
    step = trained.step

    def watched(number: int, done: float) -> dict[str, float]:
        seen.append(fix.rotations.detach().clone())
        return step(number, done)

    trained.step = watched  # type: ignore[method-assign]
    trained.loop()
    assert [fact["done"] for fact in trained.result.alignments] == [0.25, 0.5]
    changed = [not torch.equal(a, b) for a, b in pairwise(seen)]
    assert changed == [True, True, False, True, False, False, False]
    assert torch.equal(fix.rotations, seen[-1]), "the average holds the aligned poses too"


def test_alignment_leaves_the_weights_alone(tmp_path: Path) -> None:
    root = write_miniature(tmp_path / "three", size=48)
    config = with_overrides(SMALL, refine={"align": 1, "align_start": 0.0, "start": 0.0})
    torch.manual_seed(0)
    trained = Trainer(Avatar.create(read_capture(root), config))
    before = {k: v.clone() for k, v in trained.avatar.model.state_dict().items()}
    align_when_due(trained, 0.0)
    after = trained.avatar.model.state_dict()
    changed = {k for k, v in before.items() if not torch.equal(v, after[k])}
    assert changed <= {"corrections.rotations", "corrections.translations"} and changed
    align_when_due(trained, 0.5)
    assert len(trained.result.alignments) == 1


def test_the_track_that_errs_errs_as_it_says(tmp_path: Path) -> None:
    root = write_miniature(tmp_path / "four", size=32)
    noisy_track.main(root, tmp_path / "noisy", seed=1)
    exact, noisy = read_capture(root), read_capture(tmp_path / "noisy", params=noisy_track.NOISY)
    frames = exact.split("train").frames
    off = torch.stack([noisy.poses[f].pose - exact.poses[f].pose for f in frames])
    assert not off[:, 0].any() and 0.01 < float(off[:, 1:].std()) < 0.04
    shift = torch.stack([noisy.poses[f].translation - exact.poses[f].translation for f in frames])
    assert 0.001 < float(shift.std()) < 0.02
    assert torch.equal(noisy.poses[0].betas, exact.poses[0].betas)
