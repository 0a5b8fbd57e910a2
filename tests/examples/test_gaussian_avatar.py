"""The Gaussian avatar: binding, posing, way back, training on the carried capture."""

import contextlib
import json
from pathlib import Path

import cv2
import pytest
import torch
from gaussian_avatar import train as program
from gaussian_avatar.__main__ import run
from gaussian_avatar.avatar import REACH, GaussianAvatar, spread_over
from gaussian_avatar.train import evaluate, train, turntable
from pretend_cuda import DEVICE, HOST, pretend_cuda

from monopart.geometry import PosedBody, SurfaceIndex
from monopart.toolkit.captures import CaptureRecord, read_capture

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def record() -> CaptureRecord:
    return read_capture(ROOT / "examples" / "capture").scaled(0.25)


@pytest.fixture()
def avatar(record: CaptureRecord) -> GaussianAvatar:
    return GaussianAvatar(record.body, record.poses[0].betas, 2000)


def posed_at(record: CaptureRecord, frame: int) -> PosedBody:
    return record.body(record.poses[frame])


def test_the_example_is_small() -> None:
    files = list((ROOT / "examples" / "gaussian_avatar").glob("*.py"))
    assert sum(len(p.read_text().splitlines()) for p in files) < 300


def test_places_are_even() -> None:
    """As many on each half of a square as its area asks for; barycentrics are valid."""
    corners = torch.tensor(
        [[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[1.0, 1, 0], [0, 1, 0], [1, 0, 0]],
         [[0.0, 0, 1], [2, 0, 1], [0, 2, 1]]]
    )  # fmt: skip
    face, bary, area = spread_over(corners, 3000)
    assert torch.bincount(face).tolist() == [500, 500, 2000]
    assert float(area) == 3.0
    assert bary.min() >= 0 and (bary.sum(1) - 1).abs().max() < 1e-6
    flat = (bary * corners[face]).sum(1)[face < 2, :2]
    cells = torch.bincount((flat * 5).long().clamp_max(4) @ torch.tensor([1, 5]), minlength=25)
    assert cells.min() >= 25 and cells.max() <= 55  # 40 are even


def test_untrained_gaussians_lie_flat_on_the_posed_body(
    record: CaptureRecord, avatar: GaussianAvatar
) -> None:
    posed = posed_at(record, 20)
    found = avatar(posed, record.poses[20].pose)
    hit = SurfaceIndex(posed.verts_world, record.body.faces).query(found.points.detach())
    # skinned in the middle of a face, where the skin is the middle of skinned corners
    assert hit.distance.median() < 1e-4 and hit.distance.quantile(0.95) < 2e-3
    assert hit.distance.max() < 0.01
    corners = posed.verts_world[record.body.faces[hit.face]]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    thin = torch.linalg.svd(found.factors.detach()).U[..., 2]
    along = (torch.nn.functional.normalize(normal, dim=-1) * thin).sum(-1).abs()
    assert along.quantile(0.1) > 0.95


def test_the_way_there_and_back(record: CaptureRecord, avatar: GaussianAvatar) -> None:
    """Nothing is lost before training; what the forward residual does, the backward one learns."""
    posed, pose = posed_at(record, 20), record.poses[20].pose
    rows = torch.arange(0, 2000, 4)
    assert avatar.inconsistency(posed, pose, rows, REACH) < REACH + 0.05  # other limbs alone
    with torch.no_grad():
        avatar.residuals[0].last.bias.copy_(torch.tensor([0.4, 0.2, 0.0]))  # two centimetres
    optimizer = torch.optim.Adam(avatar.residuals[1].parameters(), lr=1e-3)
    ways = []
    for _ in range(25):
        loss = avatar.inconsistency(posed, pose, rows, 0.0)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        ways.append(loss.item())
    assert 0.015 < ways[0] < 0.03
    assert ways[-1] < 0.5 * ways[0]


@pytest.mark.slow
def test_training_learns_the_person(record: CaptureRecord) -> None:
    """Held-out cameras at 128 x 128 pixels: what no training reaches, by far."""
    untrained = GaussianAvatar(record.body, record.poses[0].betas, 2000)
    before, _ = evaluate(untrained, record, "novel_view", None)
    trained = train(record, 2000, seconds=120.0, steps=160)
    after, pictures = evaluate(trained, record, "novel_view", None)
    old, new = before["full"], after["full"]
    assert (old["psnr"] or 99) < 23.5
    assert (new["psnr"] or 0) > 26.0
    assert (new["ssim"] or 0) > (old["ssim"] or 1) + 0.04
    assert (after["silhouette"]["psnr"] or 0) > (before["silhouette"]["psnr"] or 99) + 3
    assert len(pictures) == 15 and pictures[0].shape == (256, 128, 3)


def test_a_gpu_gives_the_same(record: CaptureRecord) -> None:
    """On a device that is pretended: all that training and drawing need is there."""
    found = []
    for where, mode in ((HOST, contextlib.nullcontext()), (DEVICE, pretend_cuda())):
        with mode:
            torch.manual_seed(0)
            there = record.to(where)
            avatar = train(there, 500, seconds=120.0, steps=2)
            _, pictures = evaluate(avatar, there, "novel_pose", None)
            found.append(torch.stack([*pictures[:2], *turntable_pairs(avatar, there)]))
    assert (found[0] - found[1]).abs().max() < 0.02
    assert found[0].max() > 0.3


def turntable_pairs(avatar: GaussianAvatar, record: CaptureRecord) -> list[torch.Tensor]:
    views = turntable(avatar, record, views=2)
    return [torch.cat([view, view]) for view in views]


def test_the_command_line(
    record: CaptureRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All that it writes, from small images and without LPIPS."""
    monkeypatch.setattr(program, "read_capture", lambda path: record.scaled(0.125))
    monkeypatch.setattr(program, "load_lpips", lambda: None)
    out = tmp_path / "deep" / "out"
    assert run(["anywhere", "--seconds", "0.5", "--gaussians", "300", "--out", str(out)]) == 0
    scores = json.loads((out / "metrics.json").read_text())
    assert set(scores) == {"novel_view", "novel_pose", "novel_pose_training_camera"}
    assert scores["novel_view"]["strict"]["full"]["psnr"] > 15
    pictures = {p.name: cv2.imread(str(p)) for p in out.glob("*.png")}
    assert set(pictures) == {f"{name}.png" for name in (*scores, "turntable")}
    assert pictures["turntable.png"].shape == (64, 6 * 64, 3)
    assert all(picture.max() > 50 for picture in pictures.values())


def test_bad_input_ends_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([str(tmp_path / "nowhere"), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "nowhere" in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()
