"""Learned body poses: gradients, regularisers, recovery, off as before, resume, scores."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from miniature import write_miniature

from monopart.geometry.body import BodyPose
from monopart.geometry.errors import InputError
from monopart.geometry.rotations import axis_angle_to_rotmat
from monopart.toolkit.avatar import Avatar, view_of
from monopart.toolkit.captures import read_capture
from monopart.toolkit.captures.patches import PixelSampler
from monopart.toolkit.cli import main
from monopart.toolkit.corrections import error_covariance, frame_times
from monopart.toolkit.pose_errors import joint_error_table, joint_errors
from monopart.toolkit.presets import preset, with_overrides
from monopart.toolkit.refine import as_given, with_corrections, with_poses
from monopart.toolkit.refit import column_of, fit_camera
from monopart.toolkit.render import render_view
from monopart.toolkit.resume import load_state
from monopart.toolkit.runs import open_run
from monopart.toolkit.train import Trainer

NOISY = "new_params_noisy"
SMALL = with_overrides(
    preset("fast"),
    loss={"lpips": 0.0},
    train={"iterations": 8, "rays": 256, "log_every": 1},
    field={"log2_size": 9, "levels": 3, "hidden": 16},
    deform={"log2_size": 8, "hidden": 16},
    refine={
        "poses": True,
        "frames": 2,
        "start": 0.0,
        "rigid": 0.5,
        "refit_steps": 3,
        "align": 0,
        "smooth": 1e-5,
    },
)


def add_noise(root: Path, frames: int) -> None:
    """A second body track, wrong by about three degrees and two centimetres."""
    rng = np.random.default_rng(3)
    shutil.copytree(root / "new_params", root / NOISY)
    for frame in range(frames):
        path = root / NOISY / f"{frame}.npy"
        stored = np.load(path, allow_pickle=True).item()
        stored["poses"] = stored["poses"] + rng.normal(0, 0.05, (1, 72)).astype(np.float32)
        stored["poses"][:, :3] = 0
        stored["Rh"] = stored["Rh"] + rng.normal(0, 0.05, (1, 3)).astype(np.float32)
        stored["Th"] = stored["Th"] + rng.normal(0, 0.02, (1, 3)).astype(np.float32)
        np.save(path, np.array(stored, dtype=object), allow_pickle=True)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = write_miniature(tmp_path_factory.mktemp("captures") / "noisy", size=48)
    add_noise(root, 4)
    return root


def trainer(capture: Path, run: Path | None = None, **refine: float | bool) -> Trainer:
    torch.manual_seed(0)
    config = with_overrides(SMALL, refine=refine)
    if run is not None:
        run.mkdir(exist_ok=True)
    return Trainer(Avatar.create(read_capture(capture, params=NOISY), config), run)


def test_joint_errors_tell_depth_from_the_image_plane(capture: Path) -> None:
    avatar = Avatar.create(read_capture(capture), SMALL)
    truth, camera = avatar.record, avatar.record.cameras[0]
    frames = avatar.memory.frames
    along = camera.R[2] * 0.03
    across = camera.R[0] * 0.04

    def shifted(shift: torch.Tensor) -> dict[int, BodyPose]:
        poses = truth.poses
        return {
            f: dataclasses.replace(poses[f], translation=poses[f].translation + shift)
            for f in frames
        }

    for shift, plane, depth in (
        (along, 0.0, 0.03),
        (across, 0.04, 0.0),
        (along + across, 0.04, 0.03),
    ):
        given, learned = joint_errors(with_poses(avatar, shifted(shift)), truth)
        assert given.mean == pytest.approx(0.0, abs=1e-6)
        assert learned.mean == pytest.approx(float(shift.norm()), rel=1e-3)
        assert learned.across == pytest.approx(plane, abs=1e-5)
        assert learned.depth == pytest.approx(depth, abs=1e-5)
    # what turns with the body is constant, whichever way the body faces
    with torch.no_grad():
        turned = {
            f: dataclasses.replace(
                truth.poses[f],
                translation=truth.poses[f].translation
                + axis_angle_to_rotmat(truth.poses[f].rotation) @ torch.tensor([0.0, 0.02, 0.0]),
            )
            for f in frames
        }
    assert joint_errors(with_poses(avatar, turned), truth)[1].constant == pytest.approx(
        0.02, rel=1e-3
    )


def test_few_images_a_step_and_every_pixel_of_theirs() -> None:
    masks = torch.zeros(5, 16, 16, dtype=torch.bool)
    for image in range(5):
        masks[image, 4 : 6 + image, 4:8] = True
    sampler = PixelSampler(torch.zeros(5, 16, 16, 3, dtype=torch.uint8), masks, 1)
    generator = torch.Generator().manual_seed(0)
    seen = set()
    for _ in range(10):
        batch = sampler.random(4000, generator, 2)
        assert len(batch.image.unique()) == 2 and bool((batch.image.diff() >= 0).all())
        whole = sampler.random(40000, generator)
        for image in batch.image.unique().tolist():
            seen.add(image)
            found = {tuple(p) for p in batch.pixels[batch.image == image].tolist()}
            assert found == {tuple(p) for p in whole.pixels[whole.image == image].tolist()}
    assert seen == set(range(5))
    same = torch.Generator().manual_seed(4), torch.Generator().manual_seed(4)
    assert torch.equal(sampler.random(9, same[0], 5).pixels, sampler.random(9, same[1]).pixels)


def test_the_gradient_of_the_colours_is_that_of_differences(capture: Path) -> None:
    trained = trainer(capture)
    assert trained.refined is not None
    fix, model = trained.refined.corrections, trained.avatar.model.eval()
    generator = torch.Generator().manual_seed(6)
    batch = trained.sampler.random(400, generator)
    rows = trained.body_of_image[batch.image].unique()
    weight = torch.randn(400, 3, generator=generator)

    def colour() -> torch.Tensor:
        assert trained.refined is not None
        trained.posing = trained.refined.posing(rows, trained.avatar.training_input())
        rays, body = trained.rays(batch)
        out = model.render_rays(trained.posing.scene.parts, trained.posing.inputs, rays, body)
        return (weight * out.color).double().sum() + 5.0 * out.opacity.double().sum()

    colour().backward()
    for name, eps in (("rotations", 2e-3), ("translations", 1e-3)):
        value = getattr(fix, name)
        assert value.grad is not None and bool(value.grad[rows].flatten(1).any(1).all())
        along = value.grad / value.grad.norm()
        with torch.no_grad():
            value += eps * along
            above = colour()
            value -= 2 * eps * along
            below = colour()
            value += eps * along
        expected = float(above - below) / (2 * eps)
        assert float(value.grad.norm()) == pytest.approx(expected, rel=0.1)


def test_off_is_the_training_of_before(capture: Path) -> None:
    """Everything that refinement added is left out: one more draw would change all that follows."""
    off = trainer(capture, poses=False)
    assert off.refined is None and off.avatar.model.corrections is None
    assert not any("corrections" in name for name in off.avatar.model.state_dict())
    assert len(off.optimizer.param_groups) == 2
    off.loop()
    late = trainer(capture, start=1.0, rigid=0.0)  # has corrections and never uses them
    late.loop()
    assert late.avatar.given is not None and off.avatar.given is None
    expected, found = off.avatar.model.state_dict(), late.avatar.model.state_dict()
    assert all(torch.equal(found[name], value) for name, value in expected.items())
    assert not found["corrections.rotations"].any()


@pytest.mark.slow
def test_wrong_poses_become_better_ones(tmp_path: Path) -> None:
    root = write_miniature(tmp_path / "six", frames=6, size=64)
    add_noise(root, 6)
    record = read_capture(root, params=NOISY)
    alone = {"frames": 4, "drift": 0.0, "lr": 2e-3, "prior": 5e-6}  # as this noise is made
    config = with_overrides(SMALL, train={"iterations": 100, "rays": 384}, refine=alone)
    torch.manual_seed(0)
    trained = Trainer(Avatar.create(record, config))
    trained.loop()
    before, after = joint_errors(trained.avatar, read_capture(root))
    assert before.mean > 0.02 and after.mean < 0.85 * before.mean
    assert joint_errors(as_given(trained.avatar), read_capture(root)) == (before, before)


class _Died(Exception):
    pass


@pytest.mark.parametrize("align", [0, 2])
def test_a_resumed_refinement_equals_an_unbroken_one(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, align: int
) -> None:
    whole = trainer(capture, tmp_path / "whole", align=align)
    whole.loop()
    broken = trainer(capture, tmp_path / "broken", align=align)
    step = broken.step

    def dying(number: int, done: float) -> dict[str, float]:
        if number == 5:
            raise _Died
        if number == 4:
            broken.checkpoint()
        return step(number, done)

    monkeypatch.setattr(broken, "step", dying)
    with pytest.raises(_Died):
        broken.loop()
    again = trainer(capture, tmp_path / "broken", align=align)
    load_state(again, tmp_path / "broken")
    again.loop()
    expected, found = whole.avatar.model.state_dict(), again.avatar.model.state_dict()
    assert all(torch.equal(expected[k], found[k]) for k in expected)
    assert bool(found["corrections.rotations"].any())
    lines = (tmp_path / "whole" / "train.jsonl").read_text().splitlines()
    assert {"pose_size", "pose_roughness"} <= set(json.loads(lines[0])["losses"])
    assert len(whole.result.alignments) == len(again.result.alignments) == align


def test_two_threads_repeat_a_refinement(capture: Path) -> None:
    def run() -> dict[str, torch.Tensor]:
        torch.manual_seed(0)
        config = with_overrides(SMALL, train={"iterations": 3, "rays": 2048})
        trained = Trainer(Avatar.create(read_capture(capture, params=NOISY), config))
        trained.loop()
        return trained.avatar.model.state_dict()

    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        first, second = run(), run()
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_a_shell_is_kept_until_the_body_leaves_it(capture: Path) -> None:
    """The picture of a step does not depend on where the shell was built."""
    trained = trainer(capture, drift=0.0)
    refined, rows = trained.refined, torch.tensor([0, 2])
    assert refined is not None
    inputs = trained.avatar.training_input()
    first = refined.posing(rows, inputs)
    shells = [refined._shells[row][1] for row in (0, 2)]
    with torch.no_grad():
        refined.corrections.rotations[0, 16] += 0.01  # millimetres at the hand
        refined.corrections.rotations[2, 16] += 0.5
    second = refined.posing(rows, inputs)
    assert refined._shells[0][1] is shells[0] and refined._shells[2][1] is not shells[1]
    assert torch.equal(second.place, torch.tensor([0, 0, 1]))
    assert second.scene.frames == (0, 2) and first.scene.posed.verts.requires_grad
    camera = trained.avatar.record.cameras[0]
    pixels = torch.rand(500, 2, generator=torch.Generator().manual_seed(0)) * 48

    def picture() -> torch.Tensor:
        posing = refined.posing(rows, inputs)
        rays = posing.scene.local_rays(camera.rays(pixels), 0)
        model = trained.avatar.model.eval()
        return model.render_rays(posing.scene.parts, posing.inputs, rays).color.detach()

    kept = picture()
    refined._shells.clear()
    assert torch.equal(kept, picture()) and bool(kept.any())


def test_runs_carry_their_poses_and_scores_have_two_columns(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], short_strip: None
) -> None:
    run = tmp_path / "run"
    settings = ["refine.poses=true", "refine.start=0", "refine.refit_steps=2", "loss.lpips=0"]
    settings += ["train.rays=128", "field.log2_size=8", "deform.log2_size=8", "refine.shape=true"]
    command = ["train", str(capture), "--out", str(run), "--params", NOISY, "--iterations", "4"]
    assert main([*command, "--set", *settings]) is None
    printed = capsys.readouterr().out
    for column in ("refit (learned)", "refit (training camera)", "refit (uses the test image)"):
        assert printed.count(f"| {column} ") >= 1 and "as given" in printed
    rows = json.loads((run / "refit.json").read_text())["rows"]
    assert [(r["split"], r["images"]) for r in rows] == [
        ("novel_view", 2),
        ("novel_pose", 1),
        ("novel_pose_training_camera", 1),
    ]
    assert all(r["given"]["full"]["psnr"] != r["refit"]["full"]["psnr"] for r in rows)

    avatar = open_run(run)
    assert avatar.given is not None and as_given(avatar).record.poses == avatar.given
    assert with_corrections(avatar) is avatar
    fix = avatar.model.corrections
    assert fix is not None and fix.betas is not None
    moved = avatar.record.poses[1].translation - avatar.given[1].translation
    assert fix.mix is not None
    coupled = error_covariance(frame_times(avatar.memory.frames, avatar.record.fps), 0.5, 0.25)
    torch.testing.assert_close(fix.mix @ fix.mix, coupled.float())
    shift = (fix.mix @ fix.translations.detach())[1]
    torch.testing.assert_close(moved, shift, atol=1e-6, rtol=0)
    unseen = avatar.record.poses[3]
    assert torch.equal(unseen.pose, avatar.given[3].pose), "only its shape is the learned one"
    assert torch.equal(unseen.betas, fix.shape(avatar.given[3].betas).detach())
    learned = render_view(avatar, view_of(avatar.record, 1, 1)).color
    given = as_given(avatar)
    assert not torch.equal(learned, render_view(given, view_of(given.record, 1, 1)).color)
    assert column_of(avatar, 1, 0) == "refit (learned)"
    assert fit_camera(avatar.record, 1, 3) == 0
    only = dataclasses.replace(
        avatar.record, frames={k: v for k, v in avatar.record.frames.items() if k != (0, 3)}
    )
    lonely = dataclasses.replace(avatar, record=only)
    assert column_of(lonely, 1, 3) == "refit (uses the test image)"

    assert main(["eval", str(run), "--split", "novel_view", "--truth", "new_params"]) is None
    table = joint_error_table(*joint_errors(open_run(run), read_capture(capture)))
    assert table in capsys.readouterr().out
    assert main(["eval", str(run), "--split", "novel_view", "--truth", "none"]) == 2
    error = joint_errors(avatar, read_capture(capture))
    assert error[0] != error[1] and error[1].mean > 0
    partial = dataclasses.replace(only, poses={0: only.poses[0]})
    with pytest.raises(InputError, match="frame 1"):
        joint_errors(avatar, partial)
