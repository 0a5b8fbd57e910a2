"""Configurations: written, read back strictly, presets, overrides."""

import json
from pathlib import Path

import pytest

from monopart.geometry.errors import InputError
from monopart.toolkit.config import Config, from_json, to_json
from monopart.toolkit.presets import preset, preset_names, with_overrides


@pytest.mark.parametrize("name", preset_names())
def test_round_trip_through_json(name: str, tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    path.write_text(to_json(preset(name)))
    assert from_json(path) == preset(name)
    assert preset(name).preset == name


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda d: d["train"].update(rays="many"), "rays"),
        (lambda d: d["train"].update(rays=True), "rays"),
        (lambda d: d["train"].pop("rays"), "rays"),
        (lambda d: d["field"].update(depth=3), "depth"),
        (lambda d: d.update(geometry=[]), "object"),
        (lambda d: d["geometry"].update(parts="nine"), "parts"),
    ],
)
def test_a_changed_file_is_refused(change, word: str, tmp_path: Path) -> None:
    data = json.loads(to_json(Config()))
    change(data)
    path = tmp_path / "config.json"
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match=word) as error:
        from_json(path)
    assert str(path) in str(error.value)


def test_missing_and_broken_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no file"):
        from_json(tmp_path / "config.json")
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(InputError, match="JSON"):
        from_json(tmp_path / "config.json")


def test_numbers_without_a_point_are_numbers(tmp_path: Path) -> None:
    data = json.loads(to_json(Config()))
    data["loss"]["mse"] = 1
    data["train"]["seconds"] = 30
    path = tmp_path / "config.json"
    path.write_text(json.dumps(data))
    assert from_json(path).train.seconds == 30


def test_unknown_preset_names_the_known_ones() -> None:
    with pytest.raises(InputError, match="fast"):
        preset("slow")


def test_overrides_leave_the_rest() -> None:
    changed = with_overrides(preset("fast"), train={"rays": 7}, loss={})
    assert changed.train.rays == 7
    assert changed.loss == preset("fast").loss
    assert preset("fast").train.rays != 7
