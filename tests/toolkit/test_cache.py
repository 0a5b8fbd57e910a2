"""The cache on disk: the same bits warm as cold, nothing trusted, nothing needed."""

import errno
import os
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from miniature import write_miniature
from safetensors.torch import load_file, save_file

from monopart.geometry.culling import BodyShell
from monopart.geometry.errors import InputError
from monopart.toolkit import cache as cache_module
from monopart.toolkit import prepared
from monopart.toolkit.avatar import Avatar
from monopart.toolkit.cache import NO_CACHE, Cache
from monopart.toolkit.captures import check_capture, read_capture
from monopart.toolkit.captures.cache import Pictures, read_pictures
from monopart.toolkit.presets import preset, with_overrides
from monopart.toolkit.train import Trainer

SMALL = with_overrides(
    preset("fast"),
    loss={"lpips": 0.0},
    train={"iterations": 3, "rays": 128},
    field={"log2_size": 9, "levels": 3, "hidden": 16},
    deform={"log2_size": 8, "hidden": 16},
)
LENS = (-0.3, 0.1, 0.002, -0.001, 0.0)


class Told(list):
    """A cache's warnings."""

    def cache(self, folder: Path | None, limit: int = 10**9) -> Cache:
        return Cache(folder, limit, self.append)


@pytest.fixture
def told() -> Told:
    return Told()


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_miniature(tmp_path_factory.mktemp("captures") / "mini", size=37)


def numbers(cache: Cache, value: int = 3, built: list[int] | None = None) -> torch.Tensor:
    """A cached result: the numbers below a value."""

    def build() -> torch.Tensor:
        if built is not None:
            built.append(value)
        return torch.arange(value)

    def unpack(tensors: dict[str, torch.Tensor]) -> torch.Tensor:
        if tensors["x"].shape != (value,):
            raise InputError("x: expected another number")
        return tensors["x"]

    return cache.fetch("numbers", (value,), build, lambda x: {"x": x}, unpack)


def trained(capture: Path, cache: Cache) -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    avatar = Avatar.create(read_capture(capture), SMALL, cache)
    trainer = Trainer(avatar)
    trainer.loop()
    assert avatar.model.prior is not None
    scene = trainer.scene.parts.shell
    geometry = {"prior": avatar.model.prior.values, "grid": scene.grid, "lo": scene.lo}
    images = {"images": trainer.sampler.images, "masks": trainer.sampler.masks}
    return dict(avatar.model.state_dict()) | geometry | images | {"pixel": trainer.sampler.pixel}


def files(folder: Path) -> list[str]:
    return sorted(p.name.split("-")[0] for p in folder.iterdir())


def test_training_with_a_warm_cache_equals_a_cold_one_and_none(
    capture: Path, tmp_path: Path, told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    cold = trained(capture, told.cache(tmp_path))
    assert files(tmp_path) == ["pictures", "prior", "shell"]
    none = trained(capture, NO_CACHE)

    def must_not_run(*_: object) -> None:
        raise AssertionError("built again")

    marked = BodyShell._marked

    def few(self: BodyShell, verts: torch.Tensor, *rest: Any) -> torch.Tensor:
        assert len(verts) == 1, "only the one canonical body may be built anew"
        return marked(self, verts, *rest)

    monkeypatch.setattr("monopart.fields.distance_prior._sampled", must_not_run)
    monkeypatch.setattr(BodyShell, "_marked", few)
    monkeypatch.setattr("monopart.toolkit.captures.records.read_image", must_not_run)
    monkeypatch.setattr("monopart.toolkit.captures.zju_mocap.read_image", lambda _: FIRST)
    warm = trained(capture, told.cache(tmp_path))
    for name, value in none.items():
        assert torch.equal(cold[name], value), name
        assert torch.equal(warm[name], value), name
        assert cold[name].dtype == warm[name].dtype == value.dtype
    assert not told


FIRST = torch.zeros(37, 37, 3).numpy()


@pytest.mark.parametrize("lens", [(), LENS])
def test_pictures_are_those_of_the_files(tmp_path: Path, lens: tuple[float, ...]) -> None:
    record = read_capture(write_miniature(tmp_path / "c", size=37, distortion=lens))
    cache, seen = Cache(tmp_path / "cache"), []
    cold = read_pictures(record, "train", cache, lambda done, total: seen.append((done, total)))
    warm = read_pictures(record, "train", cache, lambda done, total: seen.append((done, total)))
    assert seen == [(1, 3), (2, 3), (3, 3), (3, 3)]
    for pictures in (cold, warm):
        for i, pair in enumerate(record.split("train").pairs()):
            assert torch.equal(pictures.masks[i], record.mask(*pair))
            assert torch.equal(pictures.images[i].float() / 255, record.masked_image(*pair))
    assert not cold.images[~cold.masks].any()
    assert isinstance(warm, Pictures)


def test_a_file_or_a_lens_that_changes_gives_a_new_entry(tmp_path: Path) -> None:
    root, cache = write_miniature(tmp_path / "c", size=32), Cache(tmp_path / "cache")
    before = read_pictures(read_capture(root), "train", cache)
    record = read_capture(root)
    first = record.frame(*record.split("train").pairs()[0])
    other = record.frame(*record.split("train").pairs()[1])
    first.image_path.write_bytes(other.image_path.read_bytes())
    after = read_pictures(record, "train", cache)
    assert files(tmp_path / "cache") == ["pictures", "pictures"]
    assert not torch.equal(before.images[0], after.images[0])
    bent = read_capture(write_miniature(tmp_path / "c", size=32, distortion=LENS))
    read_pictures(bent, "train", cache)
    assert len(files(tmp_path / "cache")) == 3


def test_a_missing_image_is_named_as_without_a_cache(tmp_path: Path) -> None:
    record = read_capture(write_miniature(tmp_path / "c", size=32))
    path = record.frame(*record.split("train").pairs()[1]).image_path
    path.unlink()
    with pytest.raises(InputError, match=path.name):
        read_pictures(record, "train", Cache(tmp_path / "cache"))


def test_an_empty_mask_of_another_split_is_kept(tmp_path: Path) -> None:
    root = write_miniature(tmp_path / "c", size=32, empty_mask=(1, 0))
    record, cache = read_capture(root), Cache(tmp_path / "cache")
    for _ in range(2):
        pictures = read_pictures(record, "novel_view", cache)
        assert not pictures.masks[0].any() and pictures.masks[1].any()


def test_checking_masks_that_were_read_opens_no_image(
    capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = read_capture(capture)
    expected = check_capture(record, deep=True)
    masks = read_pictures(record, "train").masks
    monkeypatch.setattr("monopart.toolkit.captures.records.read_image", None)
    assert check_capture(record, deep=True, masks=masks) == expected


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-5])


def _flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-3] ^= 1
    path.write_bytes(data)


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _foreign(path: Path) -> None:
    save_file({"x": torch.zeros(3, dtype=torch.long)}, path)


def _other_entry(path: Path) -> None:
    cache = Cache(path.parent)
    numbers(cache, 4)
    other = next(p for p in path.parent.iterdir() if p != path)
    other.replace(path)


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _own_checksum_wrong_shape(path: Path) -> None:
    Cache(path.parent)._write(path, {"x": torch.zeros(9)})


def _own_checksum_wrong_name(path: Path) -> None:
    Cache(path.parent)._write(path, {"y": torch.arange(3)})


@pytest.mark.parametrize(
    "damage",
    [
        _cut,
        _flip,
        _empty,
        _foreign,
        _other_entry,
        _own_checksum_wrong_shape,
        _own_checksum_wrong_name,
        _folder,
    ],
)
def test_damage_is_told_in_one_line_and_mended(damage, tmp_path: Path, told: Told) -> None:
    cache = told.cache(tmp_path)
    numbers(cache)
    (path,) = tmp_path.iterdir()
    damage(path)
    assert numbers(cache).tolist() == [0, 1, 2]
    assert told and all(str(path.parent) in t and "\n" not in t for t in told)
    if path.is_dir():  # not ours to remove
        return
    assert len(told) == 1 and "made anew" in told[0]
    built: list[int] = []
    assert numbers(told.cache(tmp_path), 3, built).tolist() == [0, 1, 2]
    assert not built and load_file(path)["x"].tolist() == [0, 1, 2]


def refuse_writing(monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    def refused(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(cache_module, "write_bytes", refused)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EACCES, errno.EROFS])
def test_a_disk_that_takes_nothing_is_told_once(
    code: int, tmp_path: Path, told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse_writing(monkeypatch, code)
    cache = told.cache(tmp_path / "cache")
    assert numbers(cache).tolist() == [0, 1, 2] and numbers(cache, 2).tolist() == [0, 1]
    assert len(told) == 1 and os.strerror(code) in told[0] and "going on" in told[0]


def test_training_goes_on_without_write_permission(
    capture: Path, tmp_path: Path, told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse_writing(monkeypatch, errno.EACCES)
    avatar = Avatar.create(read_capture(capture), SMALL, told.cache(tmp_path / "cache"))
    assert Trainer(avatar).loop().iterations == 3
    assert len(told) == 1 and "Permission denied" in told[0]


def test_a_folder_that_cannot_be_made_is_told_once(tmp_path: Path, told: Told) -> None:
    (tmp_path / "file").write_text("in the way")
    cache = told.cache(tmp_path / "file" / "cache")
    assert numbers(cache).tolist() == [0, 1, 2] and numbers(cache, 2).tolist() == [0, 1]
    assert len([t for t in told if "cannot be written" in t]) == 1


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="permissions do not bind")
def test_a_folder_without_write_permission(tmp_path: Path, told: Told) -> None:
    numbers(told.cache(tmp_path))
    tmp_path.chmod(0o500)
    try:
        built: list[int] = []
        assert numbers(told.cache(tmp_path), 3, built).tolist() == [0, 1, 2] and not built
        assert numbers(told.cache(tmp_path), 4).tolist() == [0, 1, 2, 3]
        assert "cannot be written" in told[0]
    finally:
        tmp_path.chmod(0o700)


def test_what_was_not_used_for_longest_goes_first(tmp_path: Path, told: Told) -> None:
    (tmp_path / "notes.txt").write_text("x" * 5000)  # not ours, not counted, not removed
    numbers(told.cache(tmp_path), 100)
    size = told.cache(tmp_path).facts()["bytes"]
    cache = told.cache(tmp_path, int(3.5 * size))
    (first,) = tmp_path.glob("numbers-*")
    now = time.time()
    os.utime(first, (now - 100, now - 100))
    for i, value in enumerate((101, 102)):
        before = set(tmp_path.iterdir())
        numbers(cache, value)
        (new,) = set(tmp_path.iterdir()) - before
        os.utime(new, (now - 90 + i, now - 90 + i))
    numbers(cache, 100)  # used again: now the youngest
    numbers(cache, 103)
    built: list[int] = []
    for value in (100, 102, 103):
        numbers(cache, value, built)
    assert not built
    facts = cache.facts()
    assert facts["entries"] == 3 and facts["bytes"] <= facts["limit_bytes"]
    numbers(cache, 101, built)
    assert built == [101] and (tmp_path / "notes.txt").exists() and not told


def test_an_entry_above_the_limit_is_not_kept(tmp_path: Path, told: Told) -> None:
    assert len(numbers(told.cache(tmp_path, 1000), 500)) == 500
    assert not list(tmp_path.iterdir()) and "MONOPART_CACHE_GB" in told[0]


def test_unfinished_files_of_dead_processes_are_removed(tmp_path: Path, told: Told) -> None:
    cache = told.cache(tmp_path)
    numbers(cache)
    (path,) = tmp_path.iterdir()
    dead, alive = (tmp_path / f".{path.stem}.{c * 8}.safetensors" for c in "ab")
    dead.write_bytes(b"x")
    alive.write_bytes(b"x")
    os.utime(dead, (0.0, 0.0))
    numbers(cache, 7)
    assert alive.exists() and not dead.exists()


def test_geometry_is_made_anew_when_any_of_its_code_changes(
    tmp_path: Path, told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = {path.relative_to(path.parents[1]).as_posix() for path in prepared.geometry_sources()}
    assert {"geometry/surface.py", "geometry/face_tree.py", "kernels/face_tree.py"} <= names
    assert {"geometry/culling.py", "kernels/shell.py", "geometry/norms.py"} <= names
    verts = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    cache, changed = told.cache(tmp_path / "cache"), tmp_path / "face_tree.py"
    sources = prepared.geometry_sources()
    monkeypatch.setattr(prepared, "geometry_sources", lambda: [*sources, changed])
    for text, entries in (("old", 1), ("old", 1), ("new", 2)):
        changed.write_text(text)
        prepared.distance_prior(verts, faces, cache)
        assert cache.facts()["entries"] == entries, text


def test_a_file_that_changes_while_it_is_read_is_not_kept(tmp_path: Path, told: Told) -> None:
    source, cache = tmp_path / "source", told.cache(tmp_path / "cache")
    source.write_text("old")

    def build() -> torch.Tensor:
        source.write_text("new")
        return torch.zeros(1)

    cache.fetch("text", (source,), build, lambda x: {"x": x}, lambda t: t["x"])
    assert not (tmp_path / "cache").exists() and not told


def test_two_at_once(tmp_path: Path, told: Told) -> None:
    """A second process that writes the same entry in between changes nothing."""

    def build() -> torch.Tensor:
        numbers(told.cache(tmp_path))
        return torch.arange(3)

    cache = told.cache(tmp_path)
    found = cache.fetch("numbers", (3,), build, lambda x: {"x": x}, lambda t: t["x"])
    assert found.tolist() == [0, 1, 2] and len(list(tmp_path.iterdir())) == 1 and not told
    assert numbers(cache).tolist() == [0, 1, 2]
