"""Entries of the configuration from text."""

import dataclasses
import json
from typing import Literal

import pytest

from monopart.geometry.errors import InputError
from monopart.toolkit.config import Config
from monopart.toolkit.overrides import overridden, parse_value, type_text
from monopart.toolkit.presets import preset, preset_doubts, preset_names


@pytest.mark.parametrize("name", preset_names())
def test_every_entry_can_be_set_to_its_own_value(name):
    """A new type in the configuration must be one that the command line can read."""
    config, settings = preset(name), []
    for section in dataclasses.fields(Config):
        values = getattr(config, section.name)
        if dataclasses.is_dataclass(values):
            for entry in dataclasses.fields(values):
                value = getattr(values, entry.name)
                text = value if isinstance(value, str) else json.dumps(value)
                text = {"null": "none"}.get(text, text).strip("[]").replace(" ", "")
                settings.append(f"{section.name}.{entry.name}={text}")
    assert overridden(config, settings) == config
    assert len(settings) > 30


def test_values_change_and_later_ones_win():
    config = overridden(
        Config(),
        [
            "train.rays=7",
            "loss.lpips=0",
            "deform.residual=False",
            "train.seconds=3",
            "train.rays=9",
        ],
    )
    assert (config.train.rays, config.loss.lpips, config.train.seconds) == (9, 0.0, 3.0)
    assert config.deform.residual is False and type(config.loss.lpips) is float
    assert overridden(config, ["train.seconds=none"]).train.seconds is None
    assert overridden(config, ["geometry.parts=single"]).geometry.parts == "single"


def test_light_is_not_learned_with_poses_unless_it_is_asked_for():
    for settings, light in (
        (["refine.poses=True"], False),
        (["refine.poses=true", "refine.poses=false"], True),
        (["appearance.light=true", "refine.poses=true"], True),
    ):
        config = overridden(Config(), settings)
        assert config.appearance.light is light
        both = config.refine.poses and light
        assert [d.startswith("poses are learned") for d in preset_doubts(config)] == [True] * both


def test_types():
    assert parse_value("1,2", tuple[int, ...]) == (1, 2)
    assert parse_value("a", Literal["a", "b"]) == "a"
    assert type_text(tuple[int, ...]) == "whole numbers with commas between"


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("train.rays=1.5", "--set train.rays: expected whole number.*found '1.5'"),
        ("train.rays=-1", "not negative, found '-1'"),
        ("train.lr_table=nan", "--set train.lr_table: expected float, finite.*found 'nan'"),
        ("train.occupancy=1", "expected true or false, found '1'"),
        ("geometry.parts=nine", "expected one of five.*found 'nine'"),
        ("train.seconds=soon", "expected float or none"),
        ("train.nothing=1", "expected an entry of train .*rays.*found 'nothing'"),
        ("nothing.rays=1", "expected a section .*train.*found 'nothing'"),
        ("seed=1", "expected section.entry=value"),
        ("train.rays", "expected section.entry=value"),
        ("train.rays=", "found ''"),
    ],
)
def test_refusals(setting, words):
    with pytest.raises(InputError, match=words) as caught:
        overridden(Config(), [setting])
    assert "\n" not in str(caught.value) and "; " in str(caught.value)
