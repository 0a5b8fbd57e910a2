"""Named configurations; the command line starts from one of them."""

import dataclasses

from monopart.geometry.errors import InputError

from .config import (
    AppearanceConfig,
    Config,
    DeformConfig,
    FieldConfig,
    GeometryConfig,
    LossConfig,
    TrainConfig,
)

ALL = 1 << 30  # pairs of a step whose round trip is computed, where all are
SLOW = TrainConfig(
    iterations=3000,
    rays=0,
    patch=64,
    lpips_start=0.0,
    lpips_every=1,
    lr_table=5e-4,
    lr_network=5e-4,
    lr_final=1.0,
    ema=0.0,
    occupancy=False,
)
"""One patch of one frame a step, Adam at 5e-4, no accelerators (METHOD section 9)."""
FASTER = 5.0
"""Factor of a preset's learning rate from which on a training is doubted."""
UNLIT = AppearanceConfig(light=False)
"""Appearance of published methods: none of them knows which way a surface looks."""
BARE = FieldConfig(prior_slope=0.0, allocation="data")
"""No density to start from; capacity by part."""


def _published() -> dict[str, Config]:
    """The paper as it is written, and the conventions of the authors' code."""
    appearance = AppearanceConfig(
        pose_feature=True,
        channels=20,
        codes=100,
        lr=1.0,
        light=False,
        density_sees_fusion=True,
        blend_time=True,
    )
    paper = Config(
        preset="paper",
        field=BARE,
        appearance=appearance,
        loss=LossConfig(lpips=1.0, consistency_threshold=0.05, consistency_samples=ALL, offset=0.0),
        train=SLOW,
    )
    code = dataclasses.replace(
        paper,
        preset="code",
        field=dataclasses.replace(BARE, use_step=False, sharpness=1.0),
        loss=dataclasses.replace(paper.loss, offset=0.1, distortion=0.1, elastic=0.1),
        train=dataclasses.replace(SLOW, ignore_band=2, scales=(0.3, 0.5, 0.5), head_focus=0.5),
    )
    return {"paper": paper, "code": code}


def _baselines() -> dict[str, Config]:
    """Other methods from the same pieces, with our accelerators: one engine, other models."""
    # UNLIT: one code per frame, no pose embedding and no fusion
    one_way = LossConfig(consistency=0.0, offset=0.1)
    instant = Config(preset="instant_nvr", loss=one_way, appearance=UNLIT)
    single = Config(
        preset="single_part",
        geometry=GeometryConfig(parts="single"),
        field=FieldConfig(log2_size=17),  # about the rows of five parts of 2^15
        deform=DeformConfig(input="xyzt"),
        loss=one_way,
        appearance=UNLIT,
    )
    return {"instant_nvr": instant, "single_part": single}


def _presets() -> dict[str, Config]:
    fast = Config(preset="fast")
    # Light says what a code of the frame would; residuals want an avatar to move.
    best = Config(
        preset="best",
        deform=DeformConfig(start=0.6),
        appearance=AppearanceConfig(code=0),
        loss=LossConfig(lpips=0.02, l1=0.1),
        train=TrainConfig(seconds=1680.0),
    )
    tiny = Config(
        preset="tiny",
        loss=best.loss,
        train=TrainConfig(seconds=80.0, checkpoint_seconds=30.0),
    )
    rigid = Config(preset="rigid", appearance=UNLIT, deform=DeformConfig(residual=False))
    full = Config(preset="full", appearance=dataclasses.replace(UNLIT, pose_feature=True))
    own = {"fast": fast, "best": best, "tiny": tiny, "rigid": rigid, "full": full}
    return own | _published() | _baselines()


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


def preset_doubts(config: Config) -> list[str]:
    """What a configuration asks for that its preset was never tried with.

    Args:
        config: a configuration, which names its preset.

    Returns:
        One sentence for each learning rate that is `FASTER` times the preset's or more, and one
        where light and poses are learned together.
    """
    usual, found = _presets().get(config.preset, Config()).train, []
    if config.refine.poses and config.appearance.light:
        found.append(
            "poses are learned (refine.poses) and light too (appearance.light), which explains "
            "wrong poses instead of correcting them: --set appearance.light=false leaves it out."
        )
    for name in ("lr_table", "lr_network"):
        rate, known = getattr(config.train, name), getattr(usual, name)
        if rate >= FASTER * known:
            found.append(
                f"train.{name} is {rate:g}, {rate / known:.3g} times that of preset "
                f"{config.preset} ({known:g}): the training may swing instead of settling."
            )
    return found


def with_overrides(config: Config, **sections: dict) -> Config:
    """A copy with some entries of some sections replaced."""
    changed = {
        name: dataclasses.replace(getattr(config, name), **values)
        for name, values in sections.items()
        if values
    }
    return dataclasses.replace(config, **changed)
