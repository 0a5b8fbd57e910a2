"""Named configurations; the command line starts from one of them."""

import dataclasses

from monopart.geometry.errors import InputError

from .config import Config, DeformConfig, TrainConfig


def _presets() -> dict[str, Config]:
    fast = Config(preset="fast")
    tiny = Config(preset="tiny", train=TrainConfig(seconds=80.0, checkpoint_seconds=30.0))
    rigid = Config(preset="rigid", deform=DeformConfig(residual=False))
    return {"fast": fast, "tiny": tiny, "rigid": rigid}


def preset_names() -> tuple[str, ...]:
    """Names of all presets, the default first."""
    return tuple(_presets())


def preset(name: str) -> Config:
    """The configuration of a preset.

    Raises:
        InputError: no preset of that name.
    """
    presets = _presets()
    if name not in presets:
        known = ", ".join(presets)
        raise InputError(f"--preset: expected one of {known}, found {name!r}; choose one of these")
    return presets[name]


def with_overrides(config: Config, **sections: dict) -> Config:
    """A copy with some entries of some sections replaced."""
    changed = {
        name: dataclasses.replace(getattr(config, name), **values)
        for name, values in sections.items()
        if values
    }
    return dataclasses.replace(config, **changed)
