"""Subjects of ZJU-MoCap and MonoCap are read by their protocol, quirks and sizes included."""

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from miniature import write_miniature
from public_miniature import SIZE, VLAD, ZJU, state, write_subject

from monopart.geometry.errors import InputError
from monopart.toolkit import cli
from monopart.toolkit.cache import Cache
from monopart.toolkit.captures import SUBJECTS, Reading, check_capture, read_capture, subject
from monopart.toolkit.captures.cache import read_pictures
from monopart.toolkit.captures.frames import Split
from monopart.toolkit.captures.scaling import camera_at, scale_image, scale_mask, scaled_size
from monopart.toolkit.captures.splits import subject_splits
from monopart.toolkit.captures.subjects import ON_TRAINING_CAMERA, recognise

SPLITS = ("train", "novel_view", "novel_pose", ON_TRAINING_CAMERA)


@pytest.fixture(scope="module")
def zju(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_subject(tmp_path_factory.mktemp("zju") / "my_386", ZJU)


@pytest.fixture(scope="module")
def vlad(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_subject(tmp_path_factory.mktemp("monocap") / "vlad_images1011", VLAD, lens=False)


def linked(root: Path, to: Path) -> Path:
    """A copy whose files may be removed and replaced."""
    return Path(shutil.copytree(root, to, copy_function=lambda a, b: Path(b).hardlink_to(a)))


def test_the_table_is_that_of_the_paper():
    assert list(SUBJECTS) == "377 386 387 392 393 394 lan marc olek vlad".split()
    for name in list(SUBJECTS)[:6]:
        person = SUBJECTS[name]
        assert person.train_camera == 4 and person.test_scale == 0.5
        assert person.test_cameras == tuple(c for c in range(23) if c != 4)
    train = {name: SUBJECTS[name].train_camera for name in ("lan", "marc", "olek", "vlad")}
    assert train == {"lan": 0, "marc": 0, "olek": 44, "vlad": 66}
    assert SUBJECTS["marc"].test_cameras == tuple(range(1, 11))
    assert SUBJECTS["olek"].test_cameras == (0, 5, 10, 15, 20, 25, 30, 35, 40, 45, 49)
    assert SUBJECTS["vlad"].test_cameras == tuple(range(0, 101, 10))
    for person in SUBJECTS.values():
        assert person.train_camera not in person.test_cameras
        assert (person.test_scale == 1) == (person.dataset == "monocap")


@pytest.mark.parametrize(
    ("folder", "name"),
    [
        ("my_377", "377"),
        ("CoreView_394", "394"),
        ("zju_393", "393"),
        ("lan_images620_1300", "lan"),
        ("Olek", "olek"),
        ("actor_a", None),
        ("377b", None),
        ("CoreView_313", None),
    ],
)
def test_folders_are_recognised(folder, name):
    found = recognise(folder)
    assert (found and found.name) == name


def test_unknown_subject_is_refused():
    with pytest.raises(InputError, match=r"expected one of 377, .* found '313'"):
        subject("313")


@pytest.mark.parametrize("origin", [0, 1])
def test_splits_of_a_long_capture(tmp_path, origin):
    pictures = {(c, f): f"{c}/{f:06d}.jpg" for c in range(23) for f in range(origin, origin + 900)}
    splits = subject_splits(tmp_path, subject("377"), pictures, set(range(origin, origin + 900)))
    assert tuple(splits) == SPLITS
    others = tuple(c for c in range(23) if c != 4)
    assert splits["train"] == Split((4,), tuple(range(origin, origin + 500, 5)))
    assert splits["novel_view"] == Split(others, tuple(range(origin, origin + 500, 30)))
    assert len(splits["novel_view"].frames) == 17 and len(splits["novel_view"].cameras) == 22
    later = tuple(range(origin + 500, origin + 750, 5))
    assert splits["novel_pose"] == Split(others, later) and len(later) == 50
    assert splits[ON_TRAINING_CAMERA] == Split((4,), later)


def test_a_short_capture_has_fewer_novel_poses_or_none(tmp_path):
    def read(count):
        pictures = {(c, f): f"{c}/{f}.jpg" for c in range(23) for f in range(count)}
        return subject_splits(tmp_path, subject("392"), pictures, set(range(count)))

    assert read(556)["novel_pose"].frames == tuple(range(500, 556, 5))
    assert list(read(500)) == ["train", "novel_view"]


def test_zju(zju):
    record = read_capture(zju)
    assert record.subject == "386" and record.params == "smpl_params"
    assert record.splits["train"].frames == tuple(range(0, 500, 5))
    assert record.splits["novel_pose"].frames == (500, 505)
    assert record.stored_size == SIZE and record.image_size == (15, 18)
    assert record.for_test() is record
    assert len(record.vertex_paths) == 102
    error = (record.body(record.poses[35]).verts_world - record.vertices(35)).abs().max()
    assert error < 1e-5
    assert record.frame(4, 35).mask_path == zju / "schp/04/000035.png"
    assert record.frame(5, 30).mask_path == zju / "mask_cihp/images/05/000030.png"
    check = check_capture(record, deep=True)
    assert check.images == 100 and check.files == 100 + 22 * 17 + 22 * 2 + 2
    assert check.on_mask is not None and check.on_mask > 0.8


def test_vlad_starts_at_one_and_is_compared_at_full_size(vlad):
    record = read_capture(vlad)
    assert record.subject == "vlad" and record.params == "params"
    assert record.splits["train"] == Split((66,), tuple(range(1, 501, 5)))
    assert record.splits["novel_view"].frames[:3] == (1, 31, 61)
    assert record.image_size == (15, 18)
    large = record.for_test()
    assert large.image_size == SIZE == large.image(10, 31).shape[:2]
    assert large.cameras[10].size == SIZE and large.for_test() is large
    assert large.frames is record.frames and large.poses is record.poses
    for frame in (1, 496):  # the file of the frame, not that at its place in the list
        verts = large.body(large.poses[frame]).verts_world
        pixels, _ = large.cameras[66].project(verts)
        column, row = pixels[large.cameras[66].visible(verts)].floor().long().unbind(-1)
        assert len(row) > 0.9 * len(verts)
        assert large.mask(66, frame)[row, column].float().mean() > 0.95


@pytest.mark.parametrize("camera", [3, 66])
def test_cameras_agree_with_opencv_at_every_size(vlad, camera):
    annots = np.load(vlad / "annots.npy", allow_pickle=True).item()["cams"]
    K, R, T = (np.asarray(annots[key][camera], np.float64) for key in "KRT")
    points = np.random.default_rng(0).uniform((-0.5, -0.5, 0.5), (0.5, 0.5, 1.5), (30, 3))
    plain = cv2.projectPoints(points, cv2.Rodrigues(R)[0], T / 1000, K, np.zeros(5))[0][:, 0]
    stored = read_capture(vlad, reading=Reading(scale=0.9))
    for scale in (1.0, 0.5, 0.3):
        for legacy in (False, True):
            record = dataclasses.replace(stored, legacy_pixels=legacy).scaled(scale)
            size = scaled_size(SIZE, scale, legacy)
            found = record.cameras[camera].project(torch.from_numpy(points).float())[0].numpy()
            if legacy:  # whole-number centres are scaled, and half a pixel added at the end
                expected = plain * scale + 0.5
            else:
                expected = (plain + 0.5) * np.array(size[::-1]) / np.array(SIZE[::-1])
            np.testing.assert_allclose(found, expected, atol=1e-4)
            assert record.image(camera if camera == 66 else 0, 1).shape[:2] == size


def test_legacy_pixels_are_half_a_pixel_off():
    camera = read_camera()
    exact, legacy = camera_at(camera, 0.5), camera_at(camera, 0.5, legacy_pixels=True)
    assert torch.equal(legacy.K[:2, :2], exact.K[:2, :2])
    torch.testing.assert_close(legacy.K[:2, 2] - exact.K[:2, 2], torch.full((2,), 0.25))


def read_camera():
    from monopart.geometry.cameras import Camera

    K = torch.tensor([[40.0, 0, 17.5], [0, 41, 14.5], [0, 0, 1]])
    return Camera.from_legacy_pixels(K, torch.eye(3), torch.zeros(3), (30, 36))


def test_scaled_images_are_means_of_areas():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (30, 36, 3), dtype=np.uint8)
    means = image.reshape(15, 2, 18, 2, 3).mean(axis=(1, 3))
    assert np.abs(scale_image(image, (15, 18)) - means).max() <= 0.5
    mask = rng.random((30, 36)) > 0.5
    share = mask.reshape(15, 2, 18, 2).mean(axis=(1, 3))
    assert np.array_equal(scale_mask(mask, (15, 18)), share >= 0.5)
    assert np.array_equal(scale_mask(mask, (15, 18), nearest=True), mask[::2, ::2])


def test_pictures_of_another_size_have_their_own_entry_in_the_cache(zju, tmp_path):
    cache = Cache(tmp_path / "cache")
    sizes = set()
    for how in (Reading(), Reading(scale=1.0), Reading(legacy_pixels=True)):
        record = read_capture(zju, reading=how)
        first = read_pictures(record, "train", cache)
        again = read_pictures(read_capture(zju, reading=how), "train", cache)
        assert torch.equal(first.images, again.images) and torch.equal(first.masks, again.masks)
        assert torch.equal(first.masks[7], record.mask(*record.split("train").pairs()[7]))
        sizes.add((tuple(first.images.shape), int(first.masks.sum())))
    assert cache.facts()["entries"] == 3 and len(sizes) == 3


def test_who_says_which_subject(zju, tmp_path):
    other = linked(zju, tmp_path / "somebody")
    with pytest.raises(InputError, match=r"mask_cihp/04/000000\.png"):
        read_capture(other)  # nobody: splits of the layout, and one kind of mask
    assert read_capture(other, reading=Reading(subject="393")).subject == "393"
    state(other, subject="my_392", scale=0.6)
    record = read_capture(other)
    assert (record.subject, record.image_size, record.test_scale) == ("392", (18, 22), 0.6)
    asked = read_capture(other, reading=Reading(subject="377", scale=1.0, test_scale=0.5))
    assert (asked.subject, asked.scale, asked.test_scale) == ("377", 1.0, 0.5)


def test_splits_json_goes_before_the_name_of_the_folder(tmp_path):
    root = write_miniature(tmp_path / "my_377")
    record = read_capture(root)
    assert record.subject is None and record.image_size == record.stored_size == (32, 32)
    with pytest.raises(InputError, match=r"camera 4 .* of subject 377, found cameras 0 to 1"):
        read_capture(root, reading=Reading(subject="377"))


def test_masks_of_another_size_are_brought_to_that_of_the_image(zju, tmp_path):
    root = linked(zju, tmp_path / "my_387")
    path = root / "schp/04/000010.png"
    small = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[::2, ::2]
    path.unlink()
    cv2.imwrite(str(path), small)
    on = read_capture(root).mask(4, 10)
    whole = read_capture(zju).mask(4, 10)
    assert on.shape == whole.shape and (on ^ whole).float().mean() < 0.1


def _remove(*names):
    def change(root: Path) -> None:
        for name in names:
            path = root / name
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    return change


def _annots(edit):
    def change(root: Path) -> None:
        value = np.load(root / "annots.npy", allow_pickle=True).item()
        edit(value)
        (root / "annots.npy").unlink()
        np.save(root / "annots.npy", np.array(value, dtype=object), allow_pickle=True)

    return change


def _fewer_cameras(value) -> None:
    value["ims"] = [{"ims": entry["ims"][:20]} for entry in value["ims"]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_remove("images/04/000100.jpg"), "images/04/000100.jpg: expected the image .*train"),
        (_remove("images/07/000030.jpg"), "000030.jpg: expected the image of camera 7.*novel_view"),
        (_remove("schp/04/000105.png"), "000105.png: expected the mask of camera 4, frame 105"),
        (_remove("schp", "mask_cihp"), "expected masks in schp, mask_cihp, mask, found no such"),
        (_remove("smpl_params/245.npy"), "body parameters 245.npy .train. of subject 386, found"),
        (_remove("smpl_params", "params"), "in smpl_params or new_params or params, found no"),
        (_annots(lambda v: v["ims"].pop(20)), "camera 4 at frame 100 .*train.*, found none"),
        (_annots(lambda v: v.update(ims=v["ims"][1:])), "frames from 0 .*386, found frame 5"),
        (_annots(_fewer_cameras), "camera 20 .novel_view. of subject 386, found cameras 0 to 19"),
        (lambda root: state(root, subject="390"), "expected one of 377, .*found '390'"),
        (lambda root: state(root, human="386"), "capture.json: expected an object with some of"),
        (lambda root: state(root, scale="half"), "expected a number in scale, found 'half'"),
        (lambda root: state(root, scale=True), "expected a number in scale, found True"),
        (lambda root: state(root, scale=1.5), "scale: expected a factor above 0 and at most 1"),
        (lambda root: (root / "capture.json").write_text("{"), "capture.json: expected JSON"),
    ],
)
def test_what_is_missing_is_named(zju, tmp_path, change, message):
    root = linked(zju, tmp_path / "my_386")
    change(root)
    with pytest.raises(InputError, match=message) as caught:
        read_capture(root)
    assert "\n" not in str(caught.value)


def test_another_body_is_named_in_capture_json(zju, tmp_path):
    root = linked(zju, tmp_path / "my_386")
    state(root, body="smpl.npz")
    with pytest.raises(InputError, match=r"my_386/smpl.npz"):
        read_capture(root)


def test_reading_of_a_run_is_recorded(zju):
    from monopart.toolkit.runs import _capture_facts, _reading

    how = Reading(scale=0.6, legacy_pixels=True)
    record = read_capture(zju, reading=how)
    facts = json.loads(json.dumps(_capture_facts(record)))
    again = read_capture(facts["path"], reading=_reading(facts))
    for name in ("subject", "scale", "test_scale", "legacy_pixels", "params", "image_size"):
        assert getattr(again, name) == getattr(record, name)
    assert _reading({"path": "x", "params": "params"}) == Reading(params="params")
    assert dataclasses.asdict(again.splits["train"]) == dataclasses.asdict(record.splits["train"])


@pytest.mark.parametrize(("camera", "frame"), [(5, 30), (4, 35)])
def test_legacy_images_are_those_of_the_authors_pipeline(zju, camera, frame):
    """cv2.undistort at the stored size, area means for images, nearest pixels for masks."""
    record = read_capture(zju, reading=Reading(legacy_pixels=True))
    annots = np.load(zju / "annots.npy", allow_pickle=True).item()["cams"]
    K, D = (np.asarray(annots[key][camera], np.float64) for key in "KD")
    entry = record.frame(camera, frame)
    image = cv2.undistort(cv2.imread(str(entry.image_path)), K, D)
    expected = cv2.resize(image, (18, 15), interpolation=cv2.INTER_AREA)[..., ::-1]
    error = np.abs(255 * record.image(camera, frame).numpy() - expected)
    assert error.mean() < 0.5 and error.max() <= 8  # its maps are rounded to 1/32 pixel
    stored = cv2.imread(str(entry.mask_path))
    on = cv2.undistort((stored != 0).any(-1).astype(np.uint8), K, D)
    on = cv2.resize(on, (18, 15), interpolation=cv2.INTER_NEAREST) != 0
    assert (record.mask(camera, frame).numpy() != on).mean() <= 0.01


def test_memory_for_scaled_images_is_bounded(vlad, monkeypatch):
    record = read_capture(vlad)
    size = 15 * 18 * 4
    monkeypatch.setattr("monopart.toolkit.captures.records.KEPT_BYTES", 3 * size)
    first = record.image(66, 1)
    for frame in range(1, 60, 5):
        record.image(66, frame)
    assert len(record._cache) == 3
    assert torch.equal(record.image(66, 1), first)


def test_flags_of_the_command_line(zju, capsys):
    assert (
        cli.main(["info", str(zju), "--subject", "393", "--scale", "1", "--test-scale", "0.6"])
        is None
    )
    facts = json.loads(capsys.readouterr().out)
    assert facts["subject"] == "393" and facts["image_size"] == list(SIZE)
    assert facts["test_size"] == [18, 22] and facts["params"] == "smpl_params"
    assert cli.main(["info", str(zju), "--scale", "2"]) == 2
    assert "scale: expected a factor above 0" in capsys.readouterr().err
