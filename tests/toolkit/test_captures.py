"""Captures are read in house conventions: against OpenCV, plain numpy and the files themselves."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from miniature import NAMES, pose_body, read_default_body, write_miniature

from monopart.geometry.errors import InputError
from monopart.toolkit.captures import CaptureRecord, check_capture, describe, read_capture
from monopart.toolkit.captures.frames import Split
from monopart.toolkit.captures.images import read_mask
from monopart.toolkit.captures.splits import read_splits

LENS = (-0.6, 0.3, 0.01, -0.01, 0.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_miniature(tmp_path_factory.mktemp("captures") / "tiny")


@pytest.fixture(scope="module")
def record(folder: Path) -> CaptureRecord:
    return read_capture(folder)


def test_plain_facts(record, folder):
    assert record.name == "tiny" and record.root == folder and record.fps == 6
    assert record.camera_names == list(NAMES) and record.image_size == (32, 32)
    assert record.splits["train"] == Split((0,), (0, 1, 2))
    assert record.split("novel_view").pairs() == [(1, 0), (1, 2)]
    assert record.split("novel_pose").pairs() == [(0, 3), (1, 3)]
    assert sorted(record.poses) == [0, 1, 2, 3] and record.params == "new_params"
    assert record.camera_index("Camera_B2") == record.camera_index("1") == 1
    for wrong in ("Camera_B9", "2", "-1", ""):
        with pytest.raises(InputError, match="Camera_B1"):
            record.camera_index(wrong)
    with pytest.raises(InputError, match="novel_pose"):
        record.split("test")


def test_cameras_agree_with_opencv(record, folder):
    """Half a pixel, millimetres, world to camera: OpenCV on the raw numbers of the file."""
    cams = np.load(folder / "annots.npy", allow_pickle=True).item()["cams"]
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    for c, camera in enumerate(record.cameras):
        K, D, R, T = (np.asarray(cams[key][c], np.float64) for key in "KDRT")
        expected = cv2.projectPoints(points, cv2.Rodrigues(R)[0], T / 1000, K, D)[0][:, 0]
        pixels, depth = camera.project(torch.from_numpy(points).float())
        np.testing.assert_allclose(pixels.numpy(), expected + 0.5, atol=1e-4)
        np.testing.assert_allclose(depth.numpy(), (points @ R.T + T.T / 1000)[:, 2], atol=1e-5)
        assert camera.size == (32, 32) and camera.K.dtype == torch.float32
        assert not camera.is_distorted


def test_poses_give_the_stored_vertices(record):
    for frame, pose in record.poses.items():
        assert pose.pose.shape == (24, 3) and pose.betas.shape == (10,)
        error = (record.body(pose).verts_world - record.vertices(frame)).abs().max()
        assert error < 1e-5


def test_root_pose_is_the_local_rotation_of_the_root(folder, tmp_path):
    """A root pose that is not zero turns joint 0 before Rh: plain numpy agrees."""
    root = write_miniature(tmp_path / "turned")
    path = root / "new_params" / "0.npy"
    params = np.load(path, allow_pickle=True).item()
    params["poses"][0, :3] = 0.3, -0.5, 0.2
    np.save(path, np.array(params, dtype=object), allow_pickle=True)
    turned = read_capture(root)
    verts = turned.body(turned.poses[0]).verts_world.numpy()
    np.testing.assert_allclose(verts, pose_body(read_default_body(), params), atol=1e-5)
    assert np.abs(verts - turned.vertices(0).numpy()).max() > 0.1


def test_images_and_masks_are_the_files(record, folder):
    bgr = cv2.imread(str(folder / NAMES[1] / "000002.jpg"))
    stored = cv2.imread(str(folder / "mask" / NAMES[1] / "000002.png"), cv2.IMREAD_GRAYSCALE) > 0
    image, mask = record.image(1, 2), record.mask(1, 2)
    assert image.dtype == torch.float32 and mask.dtype == torch.bool
    assert np.array_equal(image.numpy(), bgr[..., ::-1].astype(np.float32) / 255)
    assert np.array_equal(mask.numpy(), stored)
    black = record.masked_image(1, 2)
    assert torch.equal(black[mask], image[mask]) and not black[~mask].any()
    assert (record.masked_image(1, 2, background=0.5)[~mask] == 0.5).all()


def test_stack_and_preload_hold_the_same_pixels(folder):
    record, seen = read_capture(folder), []
    images, masks = record.stack("train", lambda done, total: seen.append((done, total)))
    assert images.dtype == torch.uint8 and images.shape == (3, 32, 32, 3)
    assert seen == [(1, 3), (2, 3), (3, 3)]
    for i, (camera, frame) in enumerate(record.split("train").pairs()):
        assert torch.equal(images[i].float() / 255, record.image(camera, frame))
        assert torch.equal(masks[i], record.mask(camera, frame))
    before = record.image(0, 1)
    record.preload("train")
    record.frames[0, 1].image_path.rename(folder / "away.jpg")
    try:
        assert torch.equal(record.image(0, 1), before)
    finally:
        (folder / "away.jpg").rename(record.frames[0, 1].image_path)


def test_body_projects_onto_the_masks(record):
    """Camera, pose and mask meet: the silhouette drawn through OpenCV covers the projected body."""
    for camera, frame in [(0, 0), (1, 2), (1, 3)]:
        verts = record.body(record.poses[frame]).verts_world
        pixels, _ = record.cameras[camera].project(verts)
        column, row = pixels.floor().long().unbind(-1)
        assert record.mask(camera, frame)[row, column].float().mean() > 0.99


def test_distorted_images_are_undistorted(tmp_path):
    plain = read_capture(write_miniature(tmp_path / "plain", frames=1, size=128))
    bent = read_capture(write_miniature(tmp_path / "bent", frames=1, size=128, distortion=LENS))
    assert bent.raw_cameras[0].is_distorted and not bent.cameras[0].is_distorted
    torch.testing.assert_close(bent.cameras[1].K, plain.cameras[1].K)
    for camera in (0, 1):
        stored = torch.from_numpy(read_mask(bent.frames[camera, 0].mask_path))
        target = plain.mask(camera, 0)
        assert 1 - _iou(bent.mask(camera, 0), target) < 0.3 * (1 - _iou(stored, target))
        both = bent.mask(camera, 0) & target
        assert (bent.image(camera, 0) - plain.image(camera, 0))[both].abs().mean() < 0.02
    assert (0, 0) in bent._cache and not plain._cache
    assert describe(bent)["distortion"]["Camera_B1"] == pytest.approx(0.6)


def _iou(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.mark.parametrize(
    ("stored", "on"),
    [
        ([[0, 1], [1, 0]], [[0, 1], [1, 0]]),  # 0/1
        ([[0, 255], [128, 127]], [[0, 1], [1, 0]]),  # soft
        ([[0, 5], [19, 1]], [[0, 1], [1, 1]]),  # number of a part
        ([[0, 0], [0, 0]], [[0, 0], [0, 0]]),
        (
            [[[0, 0, 0], [128, 0, 0]], [[0, 64, 64], [0, 0, 0]]],
            [[0, 1], [1, 0]],
        ),  # colour of a part
        ([[[9, 9, 9], [255] * 3], [[200] * 3, [0] * 3]], [[0, 1], [1, 0]]),  # grey as colour
    ],
)
def test_kinds_of_masks(tmp_path, stored, on):
    cv2.imwrite(str(tmp_path / "m.png"), np.array(stored, np.uint8))
    assert read_mask(tmp_path / "m.png").tolist() == np.array(on, bool).tolist()


def test_other_folders_of_the_layout(tmp_path):
    """params and vertices, masks under mask_cihp without images/, another track by name."""
    root = write_miniature(tmp_path / "c")
    (root / "new_params").rename(root / "params")
    (root / "new_vertices").rename(root / "vertices")
    (root / "mask").rename(root / "mask_cihp")
    (root / "images").mkdir()
    for name in NAMES:
        (root / name).rename(root / "images" / name)
    annots = np.load(root / "annots.npy", allow_pickle=True).item()
    for entry in annots["ims"]:
        entry["ims"] = [f"images/{name}" for name in entry["ims"]]
    np.save(root / "annots.npy", np.array(annots, dtype=object), allow_pickle=True)
    record = read_capture(root)
    assert record.params == "params" and sorted(record.vertex_paths) == [0, 1, 2, 3]
    assert record.camera_names == list(NAMES) and record.mask(0, 0).any()
    (root / "new_params_noisy").mkdir()
    for frame in range(4):
        text = (root / "params" / f"{frame}.npy").read_bytes()
        (root / "new_params_noisy" / f"{frame}.npy").write_bytes(text)
    noisy = read_capture(root, params="new_params_noisy")
    assert noisy.params == "new_params_noisy" and not noisy.vertex_paths
    with pytest.raises(InputError, match="new_params_other"):
        read_capture(root, params="new_params_other")


def test_default_splits_are_those_of_the_data_set(tmp_path):
    pictures = {(c, f): f"{c}/{f:06d}.jpg" for c in range(23) for f in range(1, 618)}
    splits, fps, size = read_splits(tmp_path, pictures, set(range(1, 618)))
    assert fps is None and size is None
    assert splits["train"] == Split((4,), tuple(range(1, 501, 5)))
    others = tuple(c for c in range(23) if c != 4)
    assert splits["novel_view"] == Split(others, tuple(range(1, 501, 30)))
    assert len(splits["novel_view"].frames) == 17
    assert splits["novel_pose"] == Split(others, tuple(range(501, 618, 5)))


def test_default_splits_of_a_small_capture(tmp_path):
    record = read_capture(write_miniature(tmp_path / "c", frames=6, splits=False))
    assert record.splits == {"train": Split((0,), (0, 5)), "novel_view": Split((1,), (0,))}
    assert record.fps is None and check_capture(record, deep=True).images == 2


def test_check_measures(record):
    seen = []
    shallow = check_capture(record)
    assert shallow.images == 0 and shallow.files == 7 and shallow.vertex_error is None
    deep = check_capture(record, deep=True, progress=lambda *at: seen.append(at))
    assert seen[-1] == (3, 3) and deep.images == 3
    assert deep.vertex_error is not None and deep.vertex_error < 1e-5
    assert deep.on_mask is not None and deep.on_mask > 0.99
    expected = np.mean([record.mask(0, f).float().mean() for f in (0, 1, 2)])
    assert deep.coverage == pytest.approx(expected)


def test_describe_is_plain(record):
    facts = json.loads(json.dumps(describe(record)))
    assert facts["cameras"] == list(NAMES) and facts["image_size"] == [32, 32]
    assert facts["splits"]["train"]["images"] == 3 and facts["splits"]["novel_pose"]["images"] == 2
    body = facts["body"]
    assert body["vertices"] == record.body.num_verts and body["joints"] == record.body.num_joints
    assert facts["frames"] == 4 and facts["stored_vertices"] == 4
    assert 0 < facts["poses"]["mean_joint_angle_deg"] < facts["poses"]["max_joint_angle_deg"] < 60
    assert facts["poses"]["translation_extent_m"] == pytest.approx(0.06, abs=1e-5)
    assert set(facts["distortion"].values()) == {0.0}


@pytest.mark.parametrize("name", ["actor_a", "actor_b", "actor_a_tiny", "actor_a_demo"])
def test_real_cameras_match_the_text_file(captures_dir, name):
    record = read_capture(captures_dir / name)
    text = json.loads((captures_dir / name / "annots.json").read_text())
    splits = json.loads((captures_dir / name / "splits.json").read_text())
    points = np.random.default_rng(1).uniform((-1, -1, 0), (1, 1, 2), (40, 3))
    assert len(record.cameras) == len(text["cams"]["K"])
    for c, camera in enumerate(record.cameras):
        K, R, T = (np.array(text["cams"][key][c], np.float64) for key in "KRT")
        rvec, tvec = cv2.Rodrigues(R)[0], T.reshape(3, 1) / 1000
        expected = cv2.projectPoints(points, rvec, tvec, K, np.zeros(5))[0][:, 0]
        pixels, _ = camera.project(torch.from_numpy(points).float())
        np.testing.assert_allclose(pixels.numpy(), expected + 0.5, atol=2e-3)
    assert list(record.image_size) == splits["image_size"] and record.fps == splits["fps"]
    for split in ("train", "novel_view", "novel_pose"):
        assert list(record.splits[split].frames) == splits[split]["frames"]
        assert list(record.splits[split].cameras) == splits[split]["cameras"]
    assert record.image(*record.splits["novel_pose"].pairs()[-1]).shape == (*record.image_size, 3)


@pytest.mark.parametrize(
    ("name", "params", "bound"),
    [
        ("actor_a", None, 1e-5),
        ("actor_a", "new_params_noisy", 1e-5),
        ("actor_b", None, 1e-5),
        ("actor_a_tiny", None, 1e-3),  # stored as float16
    ],
)
def test_real_vertices_are_reproduced(captures_dir, name, params, bound):
    record = read_capture(captures_dir / name, params=params)
    assert sorted(record.vertex_paths) == sorted(record.poses)
    frames = sorted(record.poses)[::13]
    errors = [
        (record.body(record.poses[f]).verts_world - record.vertices(f)).abs().max() for f in frames
    ]
    assert max(errors) <= bound


def test_real_capture_passes_the_deep_check(captures_dir):
    record = read_capture(captures_dir / "actor_a_tiny")
    check = check_capture(record, deep=True)
    assert check.images == 40 and check.files == 88
    assert check.on_mask is not None and check.on_mask > 0.9
