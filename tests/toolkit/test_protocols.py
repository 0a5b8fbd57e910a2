"""Which images are compared, in which box, and how the shape is scored."""

import csv
import io
import json

import cv2
import numpy as np
import pytest
import torch
from miniature import pose_body, read_default_body, write_miniature
from skimage.metrics import structural_similarity

from monopart.geometry.errors import InputError
from monopart.toolkit import cli
from monopart.toolkit.avatar import view_of
from monopart.toolkit.captures import read_capture
from monopart.toolkit.captures.depth import true_depth
from monopart.toolkit.evaluate import evaluate_split, images_csv
from monopart.toolkit.metrics import mask_box, psnr, score_image
from monopart.toolkit.protocols import SPLITS, body_box_mask, held_out_pairs, shape_scores
from monopart.toolkit.render import Picture, render_view
from monopart.toolkit.report_worst import (
    contact_sheet,
    shape_section,
    worst_frames,
    worst_section,
)
from monopart.toolkit.runs import open_run


def _restate(root, **splits):
    path = root / "splits.json"
    stored = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({k: v for k, v in (stored | splits).items() if v is not None}))
    return read_capture(root)


def test_the_training_camera_is_a_split_of_its_own(small_capture, tmp_path):
    pairs = held_out_pairs(read_capture(small_capture))
    assert list(pairs) == list(SPLITS)
    assert pairs["novel_view"] == [(1, 0), (1, 2)]
    assert pairs["novel_pose"] == [(1, 3)] and pairs["novel_pose_training_camera"] == [(0, 3)]
    root = write_miniature(tmp_path / "c")
    habit = {"cameras": [0], "frames": [3]}
    found = held_out_pairs(_restate(root, novel_pose_training_camera=habit))
    assert found["novel_pose_training_camera"] == [(0, 3)]  # stated twice, counted once
    assert held_out_pairs(_restate(root, novel_pose=habit, novel_view=None)) == {
        "novel_pose_training_camera": [(0, 3)]
    }
    nothing = {"novel_pose": None, "novel_view": None, "novel_pose_training_camera": None}
    assert held_out_pairs(_restate(root, **nothing)) == {}


def test_a_training_image_is_not_held_out(tmp_path):
    root = write_miniature(tmp_path / "c")
    record = _restate(root, novel_view={"cameras": [0, 1], "frames": [1]})
    with pytest.raises(InputError, match="found camera 0 at frame 1, which trains; take it out"):
        held_out_pairs(record)


def test_the_box_of_the_body(small_capture):
    """Against eight corners projected by OpenCV: their hull is the mask."""
    record = read_capture(small_capture)
    camera = record.cameras[1]
    mask = body_box_mask(record.body, record.poses[2], camera).numpy()
    stored = np.load(small_capture / "new_params" / "2.npy", allow_pickle=True).item()
    verts = pose_body(read_default_body(), stored)
    low, high = verts.min(0) - 0.05, verts.max(0) + 0.05
    corners = np.array([[(low, high)[i >> k & 1][k] for k in range(3)] for i in range(8)])
    R, t, K = (m.double().numpy() for m in (camera.R, camera.t, camera.K))
    seen = (corners @ R.T + t) @ K.T
    hull = cv2.convexHull((seen[:, :2] / seen[:, 2:]).astype(np.float32))
    y, x = np.mgrid[:48, :48] + 0.5
    inside = np.array(
        [
            cv2.pointPolygonTest(hull, (float(a), float(b)), True)
            for a, b in zip(x.flat, y.flat, strict=True)
        ]
    ).reshape(48, 48)
    clear = np.abs(inside) > 0.01
    assert 100 < mask.sum() < 48 * 48
    np.testing.assert_array_equal(mask[clear], (inside > 0)[clear])
    assert mask[record.mask(1, 2).numpy()].mean() > 0.99


def test_boxed_is_the_older_protocol():
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(60, 50, 3, generator=generator)
    mask = torch.zeros(60, 50, dtype=torch.bool)
    mask[20:40, 15:35] = True
    pred = (target + 0.1 * torch.randn(60, 50, 3, generator=generator)).clamp(0, 1)
    pred = pred * mask[..., None]
    y, x = torch.meshgrid(torch.arange(60), torch.arange(50), indexing="ij")
    box = (y - 30).abs() + (x - 25).abs() < 24  # not a rectangle, as the box of a turned camera
    scores = score_image(pred, target, mask, "boxed", box=box)
    black = target * mask[..., None]
    error = (pred - black)[box].double().numpy()
    assert list(scores) == ["box"]
    assert scores["box"]["psnr"] == pytest.approx(-10 * np.log10((error**2).mean()), abs=1e-9)
    top, left, bottom, right = mask_box(box)
    crop = (slice(top, bottom), slice(left, right))
    expected = structural_similarity(
        pred[crop].double().numpy(), black[crop].double().numpy(), data_range=2, channel_axis=2
    )
    assert scores["box"]["ssim"] == pytest.approx(expected, abs=1e-9)
    # one error, three numbers: the larger the empty part, the better it looks
    assert psnr(pred, black) > scores["box"]["psnr"] > psnr(pred, black, mask)
    for nothing, found in ((None, "none"), (box & False, "no pixel")):
        with pytest.raises(InputError, match=f"box: expected .* found {found}"):
            score_image(pred, target, mask, "boxed", box=nothing)


def _depth_maps(root, depth, dtype=np.uint16):
    for camera in ("Camera_B1", "Camera_B2"):
        folder = root / "depth" / camera
        folder.mkdir(parents=True, exist_ok=True)
        for frame in range(4):
            cv2.imwrite(str(folder / f"{frame:06d}.png"), depth.astype(dtype))


def test_true_depth(tmp_path):
    root = write_miniature(tmp_path / "c")
    record = read_capture(root)
    assert true_depth(record, 0, 0) is None
    depth = np.arange(32 * 32).reshape(32, 32)
    _depth_maps(root, depth)
    np.testing.assert_allclose(true_depth(record, 1, 2).numpy(), depth / 1000, rtol=1e-6)
    _depth_maps(root, depth.repeat(2, 0).repeat(2, 1))  # of larger pictures: sampled
    np.testing.assert_allclose(true_depth(record, 1, 2).numpy(), depth / 1000, rtol=1e-6)
    _depth_maps(root, depth[:31])
    with pytest.raises(InputError, match="expected the proportions of 32 x 32, found 32 x 31"):
        true_depth(record, 0, 0)
    _depth_maps(root, depth, np.uint8)
    with pytest.raises(InputError, match="expected 16 bit depths of one channel, found uint8"):
        true_depth(record, 0, 0)
    (root / "depth" / "Camera_B1" / "000000.png").write_bytes(b"")
    with pytest.raises(InputError, match="expected a readable image"):
        true_depth(record, 0, 0)


def test_depth_of_a_distorted_camera_is_not_used(tmp_path):
    root = write_miniature(tmp_path / "c", distortion=(0.1, 0, 0, 0, 0))
    _depth_maps(root, np.ones((32, 32)))
    assert true_depth(read_capture(root), 0, 0) is None


def test_shape_scores_against_a_plane(small_capture):
    """A wall at camera z = 2 m, rendered 30 mm too far: known along the axis, not the ray."""
    camera = read_capture(small_capture).cameras[0]
    K = camera.K.double().numpy()
    y, x = np.mgrid[:48, :48] + 0.5
    stretch = np.sqrt(1 + ((x - K[0, 2]) / K[0, 0]) ** 2 + ((y - K[1, 2]) / K[1, 1]) ** 2)
    opacity = torch.zeros(48, 48)
    opacity[10:30, 5:40] = 0.8
    opacity[10:12] *= 0.5  # below one half: not solid
    ray = torch.from_numpy(2.03 * stretch).float()
    picture = Picture(torch.zeros(48, 48, 3), opacity, opacity * ray)
    mask = torch.zeros(48, 48, dtype=torch.bool)
    mask[12:30, 5:20] = True
    truth = 2.0 * mask
    scores = shape_scores(picture, mask, camera, truth)
    assert scores["mask_iou"] == pytest.approx(15 / 35)
    assert scores["depth_mm"] == pytest.approx(30, abs=0.01)
    assert scores["depth_median_mm"] == pytest.approx(30, abs=0.01)
    unknown = shape_scores(picture, mask, camera)
    assert unknown["depth_mm"] is None and unknown["mask_iou"] == scores["mask_iou"]
    assert shape_scores(picture, mask, camera, truth * 0)["depth_mm"] is None
    empty = Picture(picture.color, opacity * 0, opacity * 0)
    assert shape_scores(empty, mask & False, camera)["mask_iou"] is None
    assert shape_scores(empty, mask, camera, truth) == {
        "mask_iou": 0.0,
        "depth_mm": None,
        "depth_median_mm": None,
    }


@pytest.fixture(scope="module")
def evaluation(trained_run):
    protocols = ("legacy", "boxed")
    return evaluate_split(open_run(trained_run), "novel_view", None, protocols=protocols)


def test_every_protocol_is_named_in_the_table(evaluation, trained_run):
    assert list(evaluation.means) == ["strict", "legacy", "boxed", "shape"]
    # full and black alike: the same PSNR, another SSIM
    full = {name: evaluation.means[name]["full"] for name in ("strict", "legacy")}
    assert full["strict"]["psnr"] == full["legacy"]["psnr"]
    assert full["strict"]["ssim"] != full["legacy"]["ssim"]
    avatar = open_run(trained_run)
    rows = list(csv.DictReader(io.StringIO(images_csv(evaluation, avatar.record.camera_names))))
    for row, image in zip(rows, evaluation.images, strict=True):
        boxed = image.others["boxed"]["box"]["psnr"]
        assert float(row["boxed_box_psnr"]) == pytest.approx(boxed, rel=1e-5)
        assert row["shape_full_depth_mm"] == ""
    mean = np.mean([float(r["legacy_full_ssim"]) for r in rows])
    assert full["legacy"]["ssim"] == pytest.approx(mean, rel=1e-5)


def test_the_program_scores_under_all_of_them(trained_run, capsys):
    command = ["eval", str(trained_run), "--images", "1", "--split", "novel_pose"]
    assert cli.main([*command, "--protocols", "legacy", "boxed"]) is None
    lines = capsys.readouterr().out.splitlines()
    names = ("strict", "legacy", "boxed", "shape")
    assert [line.split(":")[0] for line in lines] == [f"novel_pose, {n}" for n in names]


def test_depth_of_a_run(trained_run, small_capture):
    """The rendered depth of every pixel that is solid, against the posed body: centimetres."""
    avatar = open_run(trained_run)
    record = avatar.record
    view = view_of(record, 1, 2)
    picture = render_view(avatar, view)
    center = record.poses[2].translation @ view.camera.R[2] + view.camera.t[2]
    truth = torch.where(record.mask(1, 2), center.item(), 0.0)
    scores = shape_scores(picture, record.mask(1, 2), view.camera, truth)
    assert scores["mask_iou"] > 0.3 and scores["depth_mm"] < 500


def test_worst_frames(evaluation, trained_run):
    record = open_run(trained_run).record
    frames = worst_frames(record, evaluation)
    scores = [f.scores["psnr"] for f in frames]
    assert scores == sorted(i.scores["full"]["psnr"] for i in evaluation.images)
    assert [f.label for f in worst_frames(record, evaluation, 1)] == [frames[0].label]
    sheet = contact_sheet(frames)
    assert sheet.dtype == np.uint8 and sheet.shape[0] == 264 and sheet.max() > 100
    assert sheet.shape[1] == 2 * (max(f.image.shape[1] for f in frames) + 8)
    assert contact_sheet([*frames, frames[0]]).shape[0] == 2 * 264
    page = worst_section(frames)
    assert page.count("<img ") == 2 and f"{scores[0]:.2f} dB" in page
    assert worst_section([]) == ""


def test_shape_section():
    full = {"mask_iou": 0.91234, "depth_mm": None, "depth_median_mm": None}
    metrics = {"novel_view": {"strict": {}, "shape": {"full": full}}, "old": {"strict": {}}}
    page = shape_section(metrics)
    assert "0.9123" in page and "Depth error" not in page
    full["depth_mm"] = 12.34
    assert "12.3" in shape_section(metrics)
    assert shape_section({"old": {"strict": {}}}) == ""
