"""Entries of a configuration from text: ``section.entry=value``, checked against their types."""

import dataclasses
import math
import typing
from collections.abc import Sequence
from typing import Any, Literal

from monopart.geometry.errors import InputError

from .config import Config
from .presets import with_overrides


def type_text(hint: Any) -> str:
    """A type as a user reads it.

    >>> type_text(float | None), type_text(Literal["a", "b"])
    ('float or none', 'one of a, b')
    """
    if typing.get_origin(hint) is Literal:
        return "one of " + ", ".join(str(v) for v in typing.get_args(hint))
    if typing.get_origin(hint) is tuple:
        return f"{type_text(typing.get_args(hint)[0])}s with commas between"
    if typing.get_args(hint):
        return " or ".join(type_text(v) for v in typing.get_args(hint))
    if hint is bool:
        return "true or false"
    names = {type(None): "none", int: "whole number", float: "float"}
    return names.get(hint) or str(hint.__name__)


def parse_value(text: str, hint: Any) -> Any:
    """A value of a type from text.

    Args:
        text: what the user wrote.
        hint: annotation of the entry.

    Raises:
        ValueError: the text is not of that type, or not a finite number from 0.

    >>> parse_value("0.5", float | None), parse_value("none", float | None)
    (0.5, None)
    """
    options = typing.get_args(hint)
    if typing.get_origin(hint) is Literal:
        return {str(v): v for v in options}[text]
    if typing.get_origin(hint) is tuple:
        return tuple(parse_value(item, options[0]) for item in text.split(",") if item)
    if type(None) in options and text.lower() == "none":
        return None
    kind = next((o for o in options if o is not type(None)), hint)
    if kind is bool:
        return {"true": True, "false": False}[text.lower()]
    value = kind(text)
    if isinstance(value, int | float) and not (math.isfinite(value) and value >= 0):
        raise ValueError(text)
    return value


def overridden(config: Config, settings: Sequence[str]) -> Config:
    """A configuration with some entries replaced.

    Args:
        config: where to start from.
        settings: texts such as ``train.rays=512``; later ones win. ``refine.poses=true`` brings
            ``appearance.light=false`` with it where light is not set: it explains wrong poses.

    Raises:
        InputError: a text of another form, an unknown entry, a value of another type.

    >>> overridden(Config(), ["train.rays=512"]).train.rays
    512
    >>> overridden(Config(), ["refine.poses=true"]).appearance.light
    False
    """
    sections: dict[str, dict[str, Any]] = {}
    known = {
        f.name: typing.get_type_hints(type(getattr(config, f.name)))
        for f in dataclasses.fields(config)
        if dataclasses.is_dataclass(getattr(config, f.name))
    }
    for setting in settings:
        path, equals, text = setting.partition("=")
        section, dot, entry = path.partition(".")
        if not (equals and dot):
            raise InputError(
                f"--set {setting}: expected section.entry=value such as train.rays=512, found "
                f"{setting!r}; write it so"
            )
        if section not in known:
            raise InputError(
                f"--set {setting}: expected a section ({', '.join(known)}), found {section!r}; "
                "choose one of these"
            )
        if entry not in known[section]:
            raise InputError(
                f"--set {setting}: expected an entry of {section} ({', '.join(known[section])}), "
                f"found {entry!r}; choose one of these"
            )
        hint = known[section][entry]
        try:
            value = parse_value(text, hint)
        except (ValueError, KeyError):
            raise InputError(
                f"--set {path}: expected {type_text(hint)}{_range(hint)}, found {text!r}; "
                "correct the value"
            ) from None
        sections.setdefault(section, {})[entry] = value
    if sections.get("refine", {}).get("poses"):
        sections.setdefault("appearance", {}).setdefault("light", False)
    return with_overrides(config, **sections)


def _range(hint: Any) -> str:
    number = {int, float} & {hint, *typing.get_args(hint)}
    return ", finite and not negative" if number else ""
