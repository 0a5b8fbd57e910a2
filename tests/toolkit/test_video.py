"""Videos, strips and PNG files are what was asked for, or an error that says why."""

import cv2
import numpy as np
import pytest
import torch

from monopart.geometry.errors import BackendError, InputError
from monopart.toolkit import video


def _frames(count: int, height: int, width: int) -> list[np.ndarray]:
    ramp = np.linspace(0, 200, width)[None, :, None] * np.ones((height, 1, 3))
    return [(ramp * np.array([1, 0.5, 0.1]) + 5 * i).astype(np.uint8) for i in range(count)]


@pytest.mark.parametrize(("height", "width"), [(48, 64), (47, 63)])
def test_video_reads_back_with_count_size_and_colours(tmp_path, height, width):
    frames = _frames(7, height, width)
    info = video.write_video(tmp_path / "a.mp4", iter(frames), 12)
    assert info.frames == 7
    assert info.size == (height + height % 2, width + width % 2)
    assert info.fps == pytest.approx(12)
    assert info.codec in ("avc1", "mp4v")
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]
    capture = cv2.VideoCapture(str(info.path))
    _, first = capture.read()
    capture.release()
    got = first[:height, :width, ::-1].astype(float)  # RGB order survives the round trip
    assert np.abs(got - frames[0]).mean() < 6


def test_video_takes_float_tensors(tmp_path):
    info = video.write_video(tmp_path / "a.mp4", [torch.rand(16, 16, 3) for _ in range(3)])
    assert info.frames == 3


def test_codec_asked_for_by_name_is_used_or_raises(tmp_path):
    assert video.write_video(tmp_path / "a.mp4", _frames(2, 16, 16), codec="mp4v").codec == "mp4v"
    try:
        info = video.write_video(tmp_path / "b.mp4", _frames(2, 16, 16), codec="avc1")
    except BackendError as error:
        assert "mp4v" in str(error)
        assert not (tmp_path / "b.mp4").exists()
    else:
        assert info.codec == "avc1"


@pytest.mark.parametrize(
    ("name", "frames", "fps", "match"),
    [
        ("a.avi", _frames(1, 8, 8), 24, r"\.mp4"),
        ("a", _frames(1, 8, 8), 24, r"\.mp4"),
        ("a.mp4", [], 24, "at least one frame"),
        ("a.mp4", _frames(1, 8, 8) + _frames(1, 8, 10), 24, r"frames\[1\]"),
        ("a.mp4", [np.full((8, 8, 3), np.nan)], 24, "64 pixels with NaN"),
        ("a.mp4", _frames(1, 8, 8), 0, "fps"),
        ("none/a.mp4", _frames(1, 8, 8), 24, "folder"),
    ],
)
def test_bad_video_input_is_one_line_and_leaves_nothing(tmp_path, name, frames, fps, match):
    with pytest.raises(InputError, match=match) as caught:
        video.write_video(tmp_path / name, frames, fps)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_failed_video_keeps_the_old_file(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"old")
    with pytest.raises(InputError):
        video.write_video(path, _frames(1, 8, 8) + _frames(1, 8, 10))
    assert path.read_bytes() == b"old"


def test_png_is_exact_and_rgb(tmp_path):
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    path = video.save_png(tmp_path / "a.png", image)
    back = cv2.imread(str(path), cv2.IMREAD_COLOR)
    assert back is not None
    np.testing.assert_array_equal(back[..., ::-1], image)
    video.save_png(path, torch.from_numpy(image).float() / 255)
    again = cv2.imread(str(path), cv2.IMREAD_COLOR)
    assert again is not None
    np.testing.assert_array_equal(again[..., ::-1], image)
    with pytest.raises(InputError, match=r"\.png"):
        video.save_png(tmp_path / "a.jpg", image)
    with pytest.raises(InputError, match="NaN"):
        video.save_png(tmp_path / "b.png", np.full((2, 2, 3), np.nan))
    with pytest.raises(InputError, match="int64"):
        video.save_png(tmp_path / "b.png", np.zeros((2, 2, 3), np.int64))


def test_contact_strip_places_every_image():
    images = [np.full((4, 6, 3), v, np.uint8) for v in (10, 20, 30)]
    sheet = video.contact_strip(images, columns=2, gap=1)
    assert sheet.shape == (9, 13, 3)
    assert (sheet[:4, :6] == 10).all()
    assert (sheet[:4, 7:] == 20).all()
    assert (sheet[5:, :6] == 30).all()
    assert (sheet[5:, 7:] == 0).all()
    with pytest.raises(InputError):
        video.contact_strip([])


def test_rounding_is_to_the_nearest_level():
    levels = np.arange(256, dtype=np.uint8).reshape(-1, 1, 1).repeat(3, -1)
    np.testing.assert_array_equal(video.to_uint8(levels / 255.0), levels)
    np.testing.assert_array_equal(video.to_uint8((levels / 255.0).astype(np.float32)), levels)
    assert video.to_uint8(np.array([[[-1.0, 2.0, 0.5]]])).tolist() == [[[0, 255, 128]]]
