"""Every fault of a capture is one line that names the file and the fix; none runs code."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from miniature import FAULTS, write_miniature

from monopart.geometry.errors import InputError
from monopart.toolkit.captures import check_capture, read_capture

MIRROR = np.diag([1.0, 1.0, -1.0])

# fault → how to ask for it, the file that the message names, words of the message, deep check only
CASES = {
    "missing_image": ((0, 1), "Camera_B1/000001.jpg", "found no file; add it", False),
    "missing_mask": ((1, 2), "mask/Camera_B2/000002.png", "found no file; add it", False),
    "mask_size": ((0, 1), "mask/Camera_B1/000001.png", "32 x 32 as its image, found 64 x 64", True),
    "image_size": ((0, 1), "Camera_B1/000001.jpg", "expected 32 x 32 .* found 64 x 64", True),
    "empty_mask": ((0, 2), "mask/Camera_B1/000002.png", "found no pixel", True),
    "corrupt_image": ((0, 2), "Camera_B1/000002.jpg", "found 12 other bytes", True),
    "truncated_image": ((0, 1), "Camera_B1/000001.jpg", "cut short", True),
    "nan_pose": (2, "new_params/2.npy", "finite numbers in poses, found NaN", False),
    "wrong_joints": (1, "new_params/1.npy", "72 numbers .24 joints.*found 69", False),
    "no_shapes": (1, "new_params/1.npy", "found no shapes", False),
    "drop_camera": (True, "annots.npy", "camera for each of the 2 images .*found 1 camera", False),
    "few_vertices": (True, "new_vertices/0.npy", "expected 5600 vertices .*found 100", False),
    "vertices_shift": (0.1, "new_vertices/0.npy", "within 5 mm, found 100 mm", True),
    "split_camera": (True, "splits.json", "camera from 0 to 1 in 'novel_view', found 7", False),
    "split_frame": (True, "splits.json", "frame from 0 to 3 in 'novel_pose', found 99", False),
    "principal_point": ((50.0, 10.0), "annots.npy", "camera 0: .*principal point .*50.5", False),
    "rotation": (MIRROR, "annots.npy", "camera 0: R: expected a rotation", False),
    "metres": (True, "annots.npy", "found 0 % of it there .*millimetres", True),
}


def _is_one_line(error: InputError, file: Path | str) -> None:
    message = str(error)
    assert "\n" not in message and str(file) in message, message
    assert re.search("expected .*found .*; .", message), message


def test_every_fault_has_a_case():
    assert set(CASES) | {"evil_annots", "evil_params"} == set(FAULTS)


@pytest.mark.parametrize("fault", CASES)
def test_fault(tmp_path, fault):
    value, file, words, deep = CASES[fault]
    root = write_miniature(tmp_path / "capture", **{fault: value})
    if deep:  # reading alone does not open every file
        record = read_capture(root)
        with pytest.raises(InputError, match=words) as caught:
            check_capture(record, deep=True)
    else:
        with pytest.raises(InputError, match=words) as caught:
            read_capture(root)
    _is_one_line(caught.value, root / file)


@pytest.mark.parametrize("fault", ["mask_size", "empty_mask", "corrupt_image", "truncated_image"])
def test_stack_refuses_what_the_deep_check_refuses(tmp_path, fault):
    value, file, words, _ = CASES[fault]
    record = read_capture(write_miniature(tmp_path / "capture", **{fault: value}))
    with pytest.raises(InputError, match=words) as caught:
        record.stack("train")
    _is_one_line(caught.value, record.root / file)


def test_pickles_execute_nothing(tmp_path):
    """The control shows that the pickles are armed; reading them does not set them off."""
    trap = tmp_path / "executed"
    armed = write_miniature(tmp_path / "a", evil_annots=trap)
    with pytest.raises(InputError) as caught:
        read_capture(armed)
    _is_one_line(caught.value, armed / "annots.npy")
    assert "mkdir" in str(caught.value) and not trap.exists()
    params = write_miniature(tmp_path / "p", evil_params=(1, trap))
    with pytest.raises(InputError) as caught:
        read_capture(params)
    _is_one_line(caught.value, params / "new_params" / "1.npy")
    assert not trap.exists()
    np.load(armed / "annots.npy", allow_pickle=True)
    assert trap.exists()


def test_not_a_capture(tmp_path):
    file = tmp_path / "file"
    file.write_text("x")
    for path, words in [
        (tmp_path / "nowhere", "found nothing; check the path"),
        (file, "found a file"),
        (tmp_path, "expected annots.npy .*found file;"),
    ]:
        with pytest.raises(InputError, match=words) as caught:
            read_capture(path)
        _is_one_line(caught.value, path)


def test_files_that_are_not_what_they_seem(tmp_path):
    root = write_miniature(tmp_path / "c")
    for name, data in {
        "annots.npy": b"no array",
        "splits.json": b"{",
        "new_params/0.npy": b"",
        "new_vertices/0.npy": b"no array",
        "Camera_B1/000000.jpg": b"",
    }.items():
        path = root / name
        whole = path.read_bytes()
        path.write_bytes(data)
        with pytest.raises(InputError) as caught:
            read_capture(root)
        _is_one_line(caught.value, path)
        path.write_bytes(whole)
    read_capture(root)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"train": {"cameras": [], "frames": [0]}}, "split 'train' with images, found none"),
        ({"train": {"cameras": ["x"], "frames": [0]}}, "lists of cameras"),
        ({"image_size": [64, 64]}, "found .64, 64.; correct it"),
    ],
)
def test_splits_that_make_no_sense(tmp_path, change, words):
    root = write_miniature(tmp_path / "c")
    path = root / "splits.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=words) as caught:
        read_capture(root)
    _is_one_line(caught.value, path)


def test_folders_that_are_missing(tmp_path):
    for folder, words in [
        ("mask", "expected masks in mask, mask_cihp"),
        ("new_params", "expected body parameters in new_params or params"),
    ]:
        root = write_miniature(tmp_path / folder)
        (root / folder).rename(root / "elsewhere")
        with pytest.raises(InputError, match=words) as caught:
            read_capture(root)
        _is_one_line(caught.value, root)


def test_frame_without_pose_and_picture_without_entry(tmp_path):
    root = write_miniature(tmp_path / "c")
    record = read_capture(root)
    with pytest.raises(InputError, match="found camera 0, frame 77"):
        record.image(0, 77)
    (root / "new_params" / "3.npy").unlink()
    with pytest.raises(InputError, match="frame 3 of 'novel_pose', found no file") as caught:
        read_capture(root)
    _is_one_line(caught.value, root / "splits.json")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Camera_B1/../../x/000000.jpg", "inside the capture"),
        ("Camera_B1/first.jpg", "named by their frame number"),
        ("Camera_B1/000001.jpg", "one image for camera 0, frame 1"),
    ],
)
def test_image_names(tmp_path, name, words):
    root = write_miniature(tmp_path / "c")
    annots = np.load(root / "annots.npy", allow_pickle=True).item()
    annots["ims"][0]["ims"][0] = name
    np.save(root / "annots.npy", np.array(annots, dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match=words) as caught:
        read_capture(root)
    _is_one_line(caught.value, root / "annots.npy")
