"""Grids of configurations that are compared: the paper's ablations, and baselines, as data."""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from monopart.geometry.errors import InputError

from .config import Config

FULL = "full"
"""Name of the cell that every other one is compared with."""
PUBLISHED_ON = "published, ZJU-MoCap"
"""Where the paper's own figures come from; protocol `legacy`."""


@dataclass(frozen=True)
class Variant:
    """One configuration of a grid: a preset with some entries replaced.

    Attributes:
        label: what it is, for a reader.
        settings: texts as of ``--set``; ``section.entry*=factor`` multiplies the preset's number.
        preset: name of a preset of its own; None for the base of the grid.
        published: split to the paper's own PSNR, dB.
    """

    label: str
    settings: tuple[str, ...] = ()
    preset: str | None = None
    published: Mapping[str, float] = field(default_factory=dict)


def _ablation(label: str, setting: str, psnr: float) -> Variant:
    return Variant(label, (setting,), published={"novel_view": psnr})


PAPER: Mapping[str, Variant] = {
    FULL: Variant("everything", published={"novel_view": 32.12, "novel_pose": 32.42}),
    "no_uvt": _ablation("deformation in (x, y, z, t)", "deform.input=xyzt", 32.03),
    "no_f_k": _ablation("no fused feature F_k", "appearance.fusion=false", 31.79),
    "no_consistency": _ablation("no consistency term", "loss.consistency=0", 31.63),
    "no_rgb_latent": _ablation("no rgb_latent", "appearance.code=0", 31.93),
    "no_pose_feature": _ablation("no part pose feature", "appearance.pose_feature=false", 31.88),
    "light": Variant("with light, beyond the paper", ("appearance.light=true",)),
    "half_consistency": _ablation("weights (1, 1, ½)", "loss.consistency*=0.5", 31.74),
    "half_lpips": _ablation("weights (1, ½, 1)", "loss.lpips*=0.5", 31.86),
    "half_mse": _ablation("weights (½, 1, 1)", "loss.mse*=0.5", 31.52),
    "instant_nvr": Variant(
        "baseline: parts, backward residual only",
        preset="instant_nvr",
        published={"novel_view": 31.01, "novel_pose": 31.53},
    ),
    "single_part": Variant("baseline: one field for the body", preset="single_part"),
    "rigid": Variant("baseline: skinning alone", preset="rigid"),
    "fast": Variant("preset fast", preset="fast"),
    "best": Variant("preset best", preset="best"),
}
"""The paper's ablations in its own order (METHOD section 12), then baselines and presets.

The paper's loss weights are (mse, lpips, consistency), its full model (1, 1, 1); here each is half
of the base's own weight, which is the same on a base with equal weights.
"""


def read_grid(path: Path) -> dict[str, Variant]:
    """A grid from a JSON file: ``{name: {"label": …, "set": […], "preset": …}}``.

    Args:
        path: the file; all three entries of a cell may be left out.

    Returns:
        Name to variant, `full` first; a grid without it gets the base as it is.

    Raises:
        InputError: no such file, or one of another form.
    """
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"--grid {path}: expected a file, found {error.strerror}") from None
    except ValueError as error:
        raise InputError(f"--grid {path}: expected JSON, found {error}; correct the file") from None
    if not isinstance(stored, dict):
        raise InputError(
            f"--grid {path}: expected an object of cells, found {type(stored).__name__}; write "
            '{"no_consistency": {"set": ["loss.consistency=0"]}}'
        )
    grid = {FULL: Variant("everything")}
    return grid | {name: _read_variant(path, name, cell) for name, cell in stored.items()}


def _read_variant(path: Path, name: str, cell: Any) -> Variant:
    where = f"--grid {path}: {name}"
    if not name.replace("-", "_").isidentifier():
        raise InputError(f"{where}: expected a name of letters, digits, - and _; rename the cell")
    if not isinstance(cell, dict) or cell.keys() - {"label", "set", "preset"}:
        raise InputError(f"{where}: expected an object of label, set and preset, found {cell!r}")
    settings = cell.get("set", [])
    if not (isinstance(settings, list) and all(isinstance(s, str) for s in settings)):
        raise InputError(f"{where}: set: expected a list of texts, found {settings!r}")
    texts = (cell.get("label", name), cell.get("preset"))
    if not (isinstance(texts[0], str) and isinstance(texts[1], str | None)):
        raise InputError(f"{where}: label, preset: expected texts, found {texts!r}")
    return Variant(texts[0], tuple(settings), texts[1])


def chosen(grid: Mapping[str, Variant], only: Sequence[str]) -> dict[str, Variant]:
    """Some cells of a grid, in its order; `full` is always one of them.

    Args:
        grid: name to variant.
        only: names; none means all.

    Raises:
        InputError: a name that is not in the grid.

    >>> list(chosen(PAPER, ["no_f_k"]))
    ['full', 'no_f_k']
    """
    for name in only:
        if name not in grid:
            known = ", ".join(grid)
            raise InputError(f"--only: expected some of {known}, found {name!r}; choose of these")
    return {n: v for n, v in grid.items() if not only or n in only or n == FULL}


def explicit(settings: Sequence[str], base: Config) -> tuple[str, ...]:
    """Settings in which a factor has become a value.

    Args:
        settings: texts; ``section.entry*=factor`` multiplies.
        base: whose numbers are multiplied.

    Returns:
        Texts as ``--set`` takes them.

    Raises:
        InputError: a factor for what is no number, or a factor that is none.

    >>> explicit(["loss.mse*=0.5"], Config())
    ('loss.mse=0.5',)
    """
    out = []
    for setting in settings:
        path, times, text = setting.partition("*=")
        if not times:
            out.append(setting)
            continue
        section, _, entry = path.partition(".")
        value: Any = getattr(getattr(base, section, None), entry, None)
        try:
            factor = float(text)
        except ValueError:
            factor = math.nan
        number = float(value) if type(value) in (int, float) else math.nan
        if not math.isfinite(number * factor):
            raise InputError(
                f"{setting}: expected section.entry*=factor of a number of the configuration, "
                f"found {value!r} times {text!r}; name another entry or write its value by ="
            )
        out.append(f"{path}={number * factor!r}")
    return tuple(out)


def same_but_for_name(a: Config, b: Config) -> bool:
    """Whether two configurations differ in nothing but the names of their presets."""
    return dataclasses.replace(a, preset=b.preset) == b
