"""Pose embedding and appearance in the avatar: ablations, leakage, unseen parts, one key pose."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from miniature import write_miniature
from torch import Tensor

from monopart.fields.irradiance import irradiance_basis
from monopart.geometry.body import BodyPose
from monopart.geometry.cameras import Rays
from monopart.geometry.culling import ShellSamples
from monopart.geometry.errors import InputError
from monopart.geometry.posed_parts import PartPairs
from monopart.toolkit.appearance import feature_width
from monopart.toolkit.avatar import Avatar, View, view_of
from monopart.toolkit.captures import read_capture
from monopart.toolkit.captures.doubts import heading_doubts
from monopart.toolkit.checkpoint import load_weights, save_weights
from monopart.toolkit.config import Config
from monopart.toolkit.light import Light
from monopart.toolkit.presets import preset, with_overrides
from monopart.toolkit.render import render_view
from monopart.toolkit.resume import load_state, save_state
from monopart.toolkit.step_inputs import step_inputs
from monopart.toolkit.train import Trainer

ON = {"pose_feature": True, "knots": 16, "channels": 4, "codes": 12}


def config(iterations: int = 4, **appearance: object) -> Config:
    return with_overrides(
        preset("fast"),
        appearance=ON | appearance,
        loss={"lpips": 0.0},
        train={"iterations": iterations, "rays": 128, "log_every": 1},
        field={"log2_size": 9, "levels": 3, "hidden": 16},
        deform={"log2_size": 8, "hidden": 16},
    )


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_miniature(tmp_path_factory.mktemp("captures") / "mini", size=40)


def make(capture: Path, given: Config) -> Avatar:
    torch.manual_seed(0)
    return Avatar.create(read_capture(capture), given)


@pytest.fixture(scope="module")
def trained(capture: Path) -> Avatar:
    avatar = make(capture, config(30))
    Trainer(avatar).loop()
    return avatar


@pytest.mark.parametrize(
    ("change", "width", "pieces"),
    [
        ({}, 16, "bank fusion"),
        ({"density_sees_fusion": True}, 16, "bank fusion"),
        ({"code": 0}, 12, "bank"),
        ({"pose_feature": False}, 8, "codes"),
        ({"fusion": False}, 20, "bank codes"),
        ({"pose_feature": False, "code": 0}, 0, ""),
        ({"light": True}, 16, "bank fusion"),
        ({"pose_feature": False, "code": 0, "light": True}, 0, ""),
    ],
)
def test_each_ablation_trains_every_piece_it_has(
    capture: Path, change: dict, width: int, pieces: str
) -> None:
    given = config(**change)
    avatar = make(capture, given)
    model = avatar.model
    has = {
        "bank": model.appearance.bank is not None,
        "fusion": model.appearance.fusion is not None,
        "codes": model.codes is not None,
    }
    assert [name for name, there in has.items() if there] == pieces.split()
    assert feature_width(given.appearance) == width
    modules = {id(m) for m in model.modules()}
    before = {k: v.clone() for k, v in model.named_parameters()}
    trainer = Trainer(avatar)
    for step in range(3):
        trainer.step(step, 0.0)
    for name, value in model.named_parameters():
        assert value.grad is not None and bool(value.grad.isfinite().all()), name
        if name.startswith(("appearance", "codes")):
            assert not torch.equal(value, before[name]), f"{name} did not learn"
    assert {id(m) for m in model.modules()} == modules, "no module is made in forward"
    assert bool(render_view(avatar, view_of(avatar.record, 0, 0)).color.isfinite().all())


def test_the_density_sees_the_feature_only_where_it_is_asked_to(capture: Path) -> None:
    view = None
    for sees in (False, True):
        avatar = make(capture, config(density_sees_fusion=sees))
        view = view or view_of(avatar.record, 0, 0)
        before = render_view(avatar, view, skip=False).opacity
        with torch.no_grad():
            assert avatar.model.appearance.fusion is not None
            avatar.model.appearance.fusion.codes.mul_(-20.0)
        after = render_view(avatar, view, skip=False).opacity
        assert torch.equal(before, after) != sees


@pytest.mark.parametrize("lit", [False, True])
def test_a_light_stands_still_where_the_colour_sees_it(capture: Path, lit: bool) -> None:
    avatar = make(capture, config(light=lit, pose_feature=False))
    pose = avatar.record.poses[0]
    turned = dataclasses.replace(pose, rotation=pose.rotation + torch.tensor([0.0, 0.8, 0.0]))
    colors = []
    for given in (pose, turned):  # the same rays in the frame of the body
        bodies = avatar.pose_scene(given).parts
        verts = bodies.verts[0]
        target = verts[:: len(verts) // 64]
        back = torch.nn.functional.normalize(target - verts.mean(0), dim=-1)
        inputs = avatar.frame_input(0, given)
        out = avatar.model.render_rays(bodies, inputs, Rays(target + 0.2 * back, -back))
        colors.append(out.color)
        color = avatar.model.field.color_mlp
        out.color.sum().backward()
        assert all(bool(p.grad.isfinite().all()) for p in color.parameters() if p.grad is not None)
    same = torch.allclose(colors[0], colors[1], atol=1e-5)
    assert same != lit


def test_light_is_that_of_the_nearest_way_a_surface_was_seen_to_look(capture: Path) -> None:
    avatar = make(capture, config(light=True, pose_feature=False))
    light, record = avatar.model.light, avatar.record
    assert light is not None
    camera = record.cameras[record.split("train").cameras[0]]
    bodies = avatar.pose_scene(record.poses[0]).parts
    face = torch.arange(0, len(bodies.faces), 5)
    still, bary = torch.zeros_like(face), torch.full((len(face), 2), 1 / 3)
    pairs = PartPairs(face, still, face, bary, (len(face),))
    found = light(bodies, None, still, pairs, torch.arange(len(face)))
    normals = bodies.world_normals()[0].double()
    towards = torch.nn.functional.normalize(camera.center - bodies.translation[0], dim=0).double()
    facing = normals @ towards
    rim = torch.nn.functional.normalize(normals - facing[:, None] * towards, dim=1)
    # bent by a right triangle: what points along the rim stays, along the eye there is 0.2
    angle = torch.atan2(torch.full_like(facing, 0.2), facing.square().neg().add(1).sqrt())
    bent = angle.cos()[:, None] * rim + angle.sin()[:, None] * towards
    usual = torch.where(facing[:, None] > 0.2, normals, bent).float()
    expected = irradiance_basis(usual @ light.axes.mT)[bodies.faces[face]].mean(1)
    facing = facing[bodies.faces[face]]
    known, away = (facing > -0.45).all(1), (facing < -0.95).all(1)
    bends = known & (facing < 0).all(1)
    assert all(bool(some.any()) for some in (bends, away, known & ~bends))
    torch.testing.assert_close(found[known], expected[known], atol=1e-5, rtol=1e-5)
    steep = (normals.float() @ light.axes[2])[bodies.faces[face]]
    around = torch.zeros(len(face), 8)  # what does not depend on the heading
    around[:, 2], around[:, 7] = steep.mean(1), (3 * steep.square() - 1).mean(1)
    torch.testing.assert_close(found[away], around[away], atol=1e-5, rtol=1e-5)
    code = torch.ones(len(face), 3)
    dark = light(bodies, torch.zeros(1), still, pairs, torch.arange(len(face)), code)
    alone = found * torch.tensor([0.0, 0, 1, 0, 0, 0, 0, 1])
    assert torch.equal(dark, torch.cat([code, alone], 1))


def test_light_has_axes_that_stand_as_the_person_does(capture: Path) -> None:
    record = read_capture(capture)
    camera = record.cameras[record.split("train").cameras[0]]

    def standing(turns: list[list[float]]) -> torch.Tensor:
        frames = record.split("train").frames
        poses = dict(record.poses)
        for row, frame in enumerate(frames):
            turn = torch.tensor(turns[row % len(turns)])
            poses[frame] = dataclasses.replace(poses[frame], rotation=turn)
        axes = Light.of(dataclasses.replace(record, poses=poses)).axes
        torch.testing.assert_close(axes @ axes.mT, torch.eye(3), atol=1e-6, rtol=0)
        return axes[2]

    upright, headlong = [math.pi / 2, 0.0, 0.0], [-math.pi / 2, 0.0, 0.0]
    torch.testing.assert_close(standing([upright]), torch.tensor([0.0, 0, 1]))
    torch.testing.assert_close(standing([[0.0, 0, 0]]), torch.tensor([0.0, 1, 0]))
    torch.testing.assert_close(standing([upright, headlong]), -camera.R[1])


def test_a_step_leaves_out_the_light_of_some_frames(capture: Path) -> None:
    for share, least, most in ((0.0, 1.0, 1.0), (0.25, 0.65, 0.85), (1.0, 0.0, 0.0)):
        trainer = Trainer(make(capture, config(light_out=share)))
        drawn = [step_inputs(trainer.avatar, trainer.generator).lit for _ in range(100)]
        mean = sum(1.0 if lit is None else float(lit.mean()) for lit in drawn) / 100
        assert least <= mean <= most
    assert step_inputs(make(capture, config(light=False)), torch.Generator()).lit is None


@pytest.mark.parametrize(("degrees", "said"), [(40.0, True), (80.0, False), (350.0, True)])
def test_a_person_who_hardly_turns_is_doubted(capture: Path, degrees: float, said: bool) -> None:
    record = read_capture(capture)
    last = record.split("train").frames[-1]
    poses = {
        f: dataclasses.replace(
            pose, rotation=torch.tensor([0.0, math.radians(degrees) if f == last else 0.0, 0.0])
        )
        for f, pose in record.poses.items()
    }
    found = heading_doubts(dataclasses.replace(record, poses=poses))
    assert bool(found) == said and (not said or "appearance.light=false" in found[0])
    for lit in (False, True):
        avatar = make(capture, config(light=lit))
        avatar = dataclasses.replace(avatar, record=dataclasses.replace(avatar.record, poses=poses))
        warned = [w for w in Trainer(avatar).result.warnings if "The person turns" in w]
        assert warned == (found if lit else [])


def test_skipping_does_not_change_the_image(trained: Avatar) -> None:
    view = view_of(trained.record, 0, 0)
    fast, dense = render_view(trained, view), render_view(trained, view, skip=False)
    assert float(fast.opacity.max()) > 0.5
    assert float((fast.color - dense.color).abs().max()) <= 1e-4


def test_key_poses_are_training_frames_whatever_is_rendered(trained: Avatar) -> None:
    """Poses of other splits may change at will: what retrieval knows does not."""
    record, memory = trained.record, trained.memory.parts
    assert memory is not None
    train = record.split("train").frames
    assert memory.frames == train and len(memory.rotmats) == len(train)
    held_out = next(f for f in record.poses if f not in train)
    zero = dataclasses.replace(
        record.poses[held_out], pose=torch.full_like(record.poses[held_out].pose, 0.3)
    )
    other = dataclasses.replace(record, poses={**record.poses, held_out: zero})
    again = Avatar.create(other, trained.config).memory.parts
    assert again is not None
    assert torch.equal(memory.rotmats, again.rotmats) and torch.equal(memory.near, again.near)
    inputs = trained.frame_input(held_out, record.poses[held_out])
    assert inputs.rows is not None and int(inputs.rows.max()) < len(train)
    assert inputs.rows.shape[-1] == min(5, len(train))


def test_a_training_frame_is_itself_at_test(trained: Avatar) -> None:
    train = trained.record.split("train").frames
    inputs = trained.frame_input(train[1], trained.record.poses[train[1]])
    assert inputs.rows is not None and inputs.weights is not None
    assert inputs.rows.unique().tolist() == [1] and inputs.weights.unique().tolist() == [1.0]


def test_training_leaves_the_own_frame_out_at_the_rate_that_is_asked_for(capture: Path) -> None:
    own = {}
    for share in (0.0, 0.5, 1.0):
        trainer = Trainer(make(capture, config(leave_out=share)))
        count = len(trainer.scene.frames)
        hits = 0
        for _ in range(100):
            rows = step_inputs(trainer.avatar, trainer.generator).rows
            assert rows is not None
            hits += int((rows[..., 0] == torch.arange(count)[:, None]).all(1).sum())
        own[share] = hits / (100 * count)
    assert own[0.0] == 1.0 and own[1.0] == 0.0 and 0.35 < own[0.5] < 0.65


def perturbed(pose: BodyPose, angle: float) -> BodyPose:
    noise = torch.randn(pose.pose.shape, generator=torch.Generator().manual_seed(3))
    noise[0] = 0.0
    return dataclasses.replace(pose, pose=pose.pose + angle * noise / noise.norm(dim=-1).amax())


def test_colours_are_stable_under_a_changed_pose(trained: Avatar) -> None:
    """The body stays as it is; only the pose that retrieval sees is turned a little."""
    frame = next(f for f in trained.record.poses if f not in trained.memory.frames)
    pose = trained.record.poses[frame]
    view = View(trained.record.cameras[0], pose, None)
    scene = trained.pose_scene(pose)
    exact = render_view(trained, view, scene=scene)
    assert float(exact.opacity.max()) > 0.5
    changes = []
    for angle in (0.01, 0.1):
        other = View(view.camera, perturbed(pose, angle), None)
        changes.append((render_view(trained, other, scene=scene).color - exact.color).abs())
    assert 0 < float(changes[0].max()) < 0.02, "half a degree is seen by nobody"
    assert float(changes[1].max()) < 0.1


def test_one_key_pose(capture: Path) -> None:
    record = read_capture(capture)
    train = record.split("train")
    one = dataclasses.replace(train, frames=train.frames[:1])
    record = dataclasses.replace(record, splits={**record.splits, "train": one})
    avatar = Avatar.create(record, config(2))
    Trainer(avatar).loop()
    for frame in (train.frames[0], train.frames[-1]):
        picture = render_view(avatar, view_of(record, 0, frame))
        assert bool(picture.color.isfinite().all()) and float(picture.opacity.max()) > 0.5


def test_a_part_that_is_never_seen_gives_no_nan(
    capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Training never comes near the head; then everything is rendered."""
    record = read_capture(capture)
    avatar = make(capture, config(6, density_sees_fusion=True))
    trainer = Trainer(avatar)
    shell = trainer.scene.parts.shell
    head = avatar.model.parts.names.index("head")
    sample = shell.sample

    def headless(
        rays: Rays, step: float, body: Tensor | int = 0, jitter: Tensor | None = None
    ) -> ShellSamples:
        samples = sample(rays, step, body, jitter)
        candidates = samples.candidates & ~(1 << head)
        return dataclasses.replace(samples, candidates=candidates)

    monkeypatch.setattr(shell, "sample", headless)
    trainer.loop()
    assert all(bool(p.isfinite().all()) for p in avatar.model.parameters())
    assert bool(render_view(avatar, view_of(record, 0, 0)).color.isfinite().all())


def test_the_time_of_an_unseen_pose(trained: Avatar) -> None:
    frame = next(f for f in trained.record.poses if f not in trained.memory.frames)
    pose = trained.record.poses[frame]
    rows, weights = trained.memory.weights(frame, pose.pose)
    times = trained.memory.time(rows)
    nearest = trained.frame_input(frame, pose).time
    blending = dataclasses.replace(
        trained, config=with_overrides(trained.config, appearance={"blend_time": True})
    )
    assert nearest.tolist() == times[:1].tolist()
    torch.testing.assert_close(blending.frame_input(frame, pose).time[0], (weights * times).sum())


def test_saved_and_resumed(capture: Path, trained: Avatar, tmp_path: Path) -> None:
    save_weights(trained.model, tmp_path)
    again = Avatar.create(trained.record, trained.config)
    load_weights(again.model, tmp_path)
    frame = next(f for f in trained.record.poses if f not in trained.memory.frames)
    view = view_of(trained.record, 1, frame)
    assert torch.equal(render_view(trained, view).color, render_view(again, view).color)

    whole = Trainer(make(capture, config()))
    for step in range(2):
        whole.step(step, 0.0)
    save_state(whole, tmp_path)
    resumed = Trainer(make(capture, config()))
    load_state(resumed, tmp_path)
    for step in range(2, 4):
        whole.step(step, 0.0)
        resumed.step(step, 0.0)
    found, expected = resumed.avatar.model.state_dict(), whole.avatar.model.state_dict()
    assert all(torch.equal(expected[k], found[k]) for k in expected)


def test_frames_without_key_poses_are_named(trained: Avatar) -> None:
    view = view_of(trained.record, 0, 0)
    scene = trained.pose_scene(view.pose)
    rays = scene.local_rays(view.camera.rays(torch.tensor([[20.0, 20.0]])), 0)
    inputs = dataclasses.replace(trained.frame_input(0, view.pose), rows=None)
    with pytest.raises(InputError, match="key poses"):
        trained.model.render_rays(scene.parts, inputs, rays)
