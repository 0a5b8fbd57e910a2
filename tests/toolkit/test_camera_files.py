"""Camera files of COLMAP and EasyMocap: against pycolmap's own files and OpenCV's format."""

import dataclasses
import json
import shutil
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from monopart.geometry.cameras import Camera
from monopart.geometry.errors import InputError
from monopart.toolkit.captures import read_colmap, read_easymocap, write_colmap, write_easymocap

GOLDEN = Path(__file__).parent / "golden_colmap"
"""A model of each camera kind with a few observations, written by pycolmap."""
F64 = torch.float64
K = [[537.1, 0.0, 251.3], [0.0, 536.2, 247.9], [0.0, 0.0, 1.0]]
LENS = [-0.2, 0.03, 6e-4, -4e-4, 0.002]
LONG = [*LENS, 0.05, -0.01, 0.003, 0.002, -0.001, 0.0015, 0.0007, 0.1, -0.2]


def make_camera(lens=(), kind="brown", size=(480, 520)) -> Camera:
    R = torch.from_numpy(cv2.Rodrigues(np.array([0.2, -0.5, 0.1]))[0])
    t = torch.tensor([0.1, -0.2, 3.0], dtype=F64)
    k = torch.tensor(lens, dtype=F64)
    return Camera(torch.tensor(K, dtype=F64), R, t, size, k, kind)


def same_projection(found: Camera, expected: Camera, bound: float = 1e-9) -> None:
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0), dtype=F64) - 0.5
    assert found.size == expected.size and found.lens == expected.lens
    error = (found.project(points)[0] - expected.project(points)[0]).abs().max()
    assert float(error) <= bound


# --- COLMAP ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_models_of_colmap_project_as_colmap_does(kind):
    expected = json.loads((GOLDEN / "expected.json").read_text())
    cameras = read_colmap(GOLDEN / kind)
    assert sorted(cameras) == sorted(expected["pixels"]) and len(cameras) == 9
    points = torch.tensor(expected["points"], dtype=F64)
    for name, pixels in expected["pixels"].items():
        found, _ = cameras[name].project(points)
        np.testing.assert_allclose(found.numpy(), pixels, atol=1e-9, err_msg=name)
        assert cameras[name].size == (480, 640)
        assert cameras[name].lens == ("fisheye" if "fisheye" in name else "brown")


@pytest.mark.parametrize("binary", [True, False])
def test_colmap_round_trip(tmp_path, binary):
    cameras = {
        "a.jpg": make_camera(),
        "sub/b.jpg": make_camera(LENS),
        "c.jpg": make_camera(LENS[:4]),
        "d.jpg": make_camera(LONG[:8]),
        "e.jpg": make_camera(LENS[:4], "fisheye"),
        "f.jpg": make_camera([], "fisheye", (100, 90)),
        "g.jpg": dataclasses.replace(make_camera(), t=torch.zeros(3, dtype=F64)),
        "h.jpg": make_camera([*LENS, *[0.0] * 7]),
    }
    root = write_colmap(tmp_path / "new" / "model", cameras, binary)
    assert sorted(p.suffix for p in root.iterdir()) == [".bin" if binary else ".txt"] * 3
    again = read_colmap(root)
    assert list(again) == list(cameras)
    for name, camera in cameras.items():
        same_projection(again[name], camera)
    text = write_colmap(tmp_path / "text", cameras, binary=False) / "cameras.txt"
    models = [line.split()[1] for line in text.read_text().splitlines()[1:]]
    assert models == "PINHOLE FULL_OPENCV OPENCV FULL_OPENCV OPENCV_FISHEYE OPENCV_FISHEYE".split()


def _change(root: Path, name: str, edit) -> Path:
    path = root / name
    path.write_bytes(edit(path.read_bytes()))
    return root


@pytest.mark.parametrize(
    ("kind", "name", "edit", "message"),
    [
        ("bin", "cameras.bin", lambda b: b[:100], "cameras.bin: expected a COLMAP file"),
        ("bin", "images.bin", lambda b: b[:300], "images.bin: expected a COLMAP file"),
        ("bin", "images.bin", lambda b: b[:-30], "images.bin: expected a COLMAP file"),
        ("bin", "cameras.bin", lambda b: b[:12] + struct.pack("<i", 7) + b[16:], "found FOV; und"),
        ("bin", "cameras.bin", lambda b: b[:12] + struct.pack("<i", 99) + b[16:], "number 99"),
        ("txt", "cameras.txt", lambda b: b.replace(b"640", b"x"), "cameras.txt: expected a COLMAP"),
        ("txt", "cameras.txt", lambda b: b.replace(b"PINHOLE", b"FOV"), "found SIMPLE_FOV"),
        ("txt", "cameras.txt", lambda b: b.replace(b"500 320", b"500"), "3 parameters of SIMPLE_P"),
        ("txt", "images.txt", lambda b: b.replace(b" 3 1 ", b" 3 "), "images.txt: expected a COL"),
        ("txt", "images.txt", lambda b: b.replace(b" 3 1 ", b" 3 77 "), "cameras .1, 2.*found 77"),
        ("txt", "images.txt", lambda b: b"\xff" + b, "images.txt: expected a COLMAP file"),
    ],
)
def test_damaged_models_are_refused(tmp_path, kind, name, edit, message):
    root = _change(Path(shutil.copytree(GOLDEN / kind, tmp_path / "m")), name, edit)
    with pytest.raises(InputError, match=message) as caught:
        read_colmap(root)
    assert "\n" not in str(caught.value)


def test_what_colmap_cannot_hold_is_refused_and_nothing_is_written(tmp_path):
    skewed = dataclasses.replace(
        make_camera(), K=make_camera().K + torch.tensor([[0, 1.0, 0], [0] * 3, [0] * 3])
    )
    for cameras, message in (
        ({}, "at least one camera"),
        ({"a b.jpg": make_camera()}, "expected one word"),
        ({"a.jpg": make_camera(), "b.jpg": skewed}, "b.jpg: expected no skew"),
        ({"a.jpg": make_camera(LONG)}, "thin-prism or tilt"),
    ):
        with pytest.raises(InputError, match=message):
            write_colmap(tmp_path / "m", cameras)
    assert not (tmp_path / "m").exists()
    with pytest.raises(InputError, match=r"cameras.bin or cameras.txt"):
        read_colmap(tmp_path)


def test_an_empty_model_has_no_cameras(tmp_path):
    for name in ("cameras", "images"):
        (tmp_path / f"{name}.bin").write_bytes(struct.pack("<Q", 0))
    assert read_colmap(tmp_path) == {}


# --- EasyMocap ------------------------------------------------------------------------------------

INTRI = """%YAML:1.0
---
names:
  - "01"
  - "B2"
K_01: !!opencv-matrix
  rows: 3
  cols: 3
  dt: d
  data: [1000.0, 0.0, 511.0, 0.0, 1001.0, 512.0, 0.0, 0.0, 1.0]
dist_01: !!opencv-matrix
  rows: 1
  cols: 5
  dt: d
  data: [-0.1, 0.02, 0.001, -0.002, 0.0]
K_B2: !!opencv-matrix
  rows: 3
  cols: 3
  dt: d
  data: [900.0, 0.0, 500.0, 0.0, 900.0, 500.0, 0.0, 0.0, 1.0]
"""
EXTRI = """%YAML:1.0
---
names:
  - "01"
  - "B2"
R_01: !!opencv-matrix
  rows: 3
  cols: 1
  dt: d
  data: [0.1, -0.2, 0.3]
Rot_01: !!opencv-matrix
  rows: 3
  cols: 3
  dt: d
  data: [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
T_01: !!opencv-matrix
  rows: 3
  cols: 1
  dt: d
  data: [0.5, 0.25, 3.0]
R_B2: !!opencv-matrix
  rows: 3
  cols: 1
  dt: d
  data: [0.1, -0.2, 0.3]
T_B2: !!opencv-matrix
  rows: 3
  cols: 1
  dt: d
  data: [0.0, 0.0, 2.0]
"""


def _folder(root: Path, intri: str = INTRI, extri: str = EXTRI) -> Path:
    root.mkdir(exist_ok=True)
    (root / "intri.yml").write_text(intri)
    (root / "extri.yml").write_text(extri)
    return root


def test_files_as_easymocap_writes_them(tmp_path):
    cameras = read_easymocap(_folder(tmp_path), sizes=(1024, 1024))
    assert list(cameras) == ["01", "B2"]
    first, second = cameras["01"], cameras["B2"]
    assert first.K[:2, 2].tolist() == [511.5, 512.5] and first.distortion.shape == (5,)
    assert first.R.tolist() == [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # Rot_ goes before R_
    assert first.t.tolist() == [0.5, 0.25, 3.0] and first.size == (1024, 1024)
    expected = cv2.Rodrigues(np.array([0.1, -0.2, 0.3]))[0]
    np.testing.assert_allclose(second.R.numpy(), expected, atol=1e-15)
    assert not second.is_distorted
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    pixels = cv2.projectPoints(
        points,
        expected,
        np.array([0.0, 0, 2]),
        second.K.numpy() - [[0, 0, 0.5], [0, 0, 0.5], [0] * 3],
        None,
    )[0][:, 0]
    np.testing.assert_allclose(second.project(torch.from_numpy(points))[0] - 0.5, pixels, atol=1e-9)


def test_easymocap_round_trip(tmp_path):
    cameras = {
        "01": make_camera(),
        "cam-2": make_camera(LENS),
        "C3": make_camera(LONG, size=(99, 77)),
    }
    root = write_easymocap(tmp_path / "deep" / "folder", cameras)
    again = read_easymocap(root)
    assert list(again) == list(cameras)
    for name, camera in cameras.items():
        same_projection(again[name], camera)
    assert read_easymocap(root, {"C3": (5, 6)})["C3"].size == (5, 6)
    assert sorted(p.name for p in root.iterdir()) == ["extri.yml", "intri.yml"]


@pytest.mark.parametrize(
    ("intri", "extri", "message"),
    [
        (INTRI, EXTRI, "intri.yml: expected the size of the images in H_01, found none; give size"),
        (INTRI.replace("K_B2", "K_XX"), EXTRI, "intri.yml: expected a matrix in K_B2, found none"),
        (INTRI, EXTRI.replace("T_01", "T_XX"), "extri.yml: expected a matrix in T_01, found none"),
        (
            INTRI,
            EXTRI.replace('- "B2"', '- "B3"'),
            "expected the cameras of intri.yml, found a dif",
        ),
        (INTRI.replace("names", "cams"), EXTRI, "expected a list of camera names in names"),
        (
            INTRI.replace("rows: 3\n  cols: 3", "rows: 9\n  cols: 1"),
            EXTRI,
            "a matrix 3 x 3 in K_01",
        ),
        (INTRI.replace("[1000.0, 0.0", "[-1000.0, 0.0"), EXTRI, "camera 01: K: expected"),
        ("not yaml", EXTRI, "expected YAML of OpenCV's FileStorage"),
        ("", EXTRI, "expected YAML of OpenCV's FileStorage"),
    ],
)
def test_damaged_files_are_refused(tmp_path, intri, extri, message):
    sizes = None if "H_01" in message else (1024, 1024)
    with pytest.raises(InputError, match=message) as caught:
        read_easymocap(_folder(tmp_path, intri, extri), sizes)
    assert "\n" not in str(caught.value)


def test_what_easymocap_cannot_hold_is_refused(tmp_path):
    for cameras, message in (
        ({}, "at least one camera"),
        ({"a b": make_camera()}, "letters, digits"),
        ({"a": make_camera([], "fisheye")}, "found a fisheye"),
    ):
        with pytest.raises(InputError, match=message):
            write_easymocap(tmp_path / "m", cameras)
    assert not (tmp_path / "m").exists()
    with pytest.raises(InputError, match=r"intri.yml: expected a file of EasyMocap, found none"):
        read_easymocap(tmp_path)
