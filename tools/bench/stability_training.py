"""``monopart-bench stability-training``: trainings that are asked for the impossible.

Nothing may become NaN, the run must end, and it must say what is wrong.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from monopart.geometry.errors import MonopartError
from monopart.toolkit.avatar import Avatar
from monopart.toolkit.captures import read_capture
from monopart.toolkit.captures.cache import Pictures, read_pictures
from monopart.toolkit.captures.records import CaptureRecord, Split
from monopart.toolkit.config import Config
from monopart.toolkit.presets import preset, with_overrides
from monopart.toolkit.train import Trainer

from .sections import marks, read_page, with_section, write_section

BEGIN, END = marks("stability-training")


@dataclasses.dataclass(frozen=True)
class Setting:
    """What a training is made of.

    Attributes:
        record: the capture.
        pictures: its training pictures.
        config: the configuration.
    """

    record: CaptureRecord
    pictures: Pictures
    config: Config


def _with_pictures(setting: Setting, images: torch.Tensor, masks: torch.Tensor) -> Setting:
    return dataclasses.replace(setting, pictures=Pictures(images, masks))


def _painted(value: int) -> Callable[[Setting, torch.Generator], Setting]:
    def change(setting: Setting, generator: torch.Generator) -> Setting:
        images, masks = setting.pictures.images, setting.pictures.masks
        return _with_pictures(setting, torch.full_like(images, value) * masks[..., None], masks)

    return change


def _fast(setting: Setting, generator: torch.Generator) -> Setting:
    loop = setting.config.train
    rates = {"lr_table": 10 * loop.lr_table, "lr_network": 10 * loop.lr_network}
    return dataclasses.replace(setting, config=with_overrides(setting.config, train=rates))


def _one_frame(setting: Setting, generator: torch.Generator) -> Setting:
    train = setting.record.split("train")
    splits = setting.record.splits | {"train": Split(train.cameras[:1], train.frames[:1])}
    record = dataclasses.replace(setting.record, splits=splits)
    return Setting(
        record,
        Pictures(setting.pictures.images[:1], setting.pictures.masks[:1]),
        setting.config,
    )


def _wrong_masks(setting: Setting, generator: torch.Generator) -> Setting:
    """The complement of the person, in a random half of the pictures all of it."""
    images, masks = setting.pictures.images, ~setting.pictures.masks
    whole = torch.rand(len(masks), generator=generator) < 0.5
    masks = masks | whole[:, None, None]
    noise = torch.randint(0, 256, images.shape, generator=generator, dtype=torch.uint8)
    return _with_pictures(
        setting,
        torch.where(setting.pictures.masks[..., None], images, noise) * masks[..., None],
        masks,
    )


def _moved(setting: Setting, generator: torch.Generator) -> Setting:
    """Bodies 30 cm from where they are, in a direction of their own."""
    poses = {}
    for frame, pose in setting.record.poses.items():
        way = torch.randn(3, generator=generator)
        moved = pose.translation + 0.3 * way / way.norm()
        poses[frame] = dataclasses.replace(pose, translation=moved)
    return dataclasses.replace(setting, record=dataclasses.replace(setting.record, poses=poses))


def _twins(setting: Setting, generator: torch.Generator) -> Setting:
    images, masks = setting.pictures.images.clone(), setting.pictures.masks.clone()
    images[-1], masks[-1] = images[0], masks[0]
    return _with_pictures(setting, images, masks)


def _huge_patch(setting: Setting, generator: torch.Generator) -> Setting:
    patch = {"patch": 4 * max(setting.record.image_size), "lpips_start": 0.0, "lpips_every": 4}
    return dataclasses.replace(setting, config=with_overrides(setting.config, train=patch))


CASES: dict[str, tuple[Callable[[Setting, torch.Generator], Setting], str | None]] = {
    "as it should be": (lambda setting, _: setting, None),
    "learning rates × 10": (_fast, "times that of preset"),
    "one frame": (_one_frame, "one training frame"),
    "all black": (_painted(0), "black"),
    "all white": (_painted(255), "white"),
    "wrong masks": (_wrong_masks, "masks"),
    "bodies moved by 30 cm": (_moved, "of the body lies on the masks"),
    "two frames identical": (_twins, "same picture"),
    "huge patch": (_huge_patch, "patches are cut"),
}
"""Name: how the training is changed, and what the report must say; None where nothing is wrong."""


@dataclasses.dataclass(frozen=True)
class Row:
    """What a training did.

    Attributes:
        case: name of the case.
        seed: seed of initial values, batches and of the change.
        steps: steps taken.
        skipped: steps that were left out as not finite.
        finite: whether every weight, and the last losses, are finite.
        told: whether the warnings say what is wrong.
        psnr: of the last step's batch.
        error: what ended it early, or empty.
    """

    case: str
    seed: int
    steps: int
    skipped: int
    finite: bool
    told: bool
    psnr: float
    error: str = ""


def run_case(name: str, seed: int, setting: Setting, steps: int) -> Row:
    """Train one case.

    Args:
        name: a key of `CASES`.
        seed: a seed.
        setting: the training as it should be.
        steps: steps to take.
    """
    change, words = CASES[name]
    generator = torch.Generator().manual_seed(seed)
    setting = change(setting, generator)
    config = with_overrides(setting.config, train={"iterations": steps, "seconds": None})
    torch.manual_seed(seed)
    avatar = Avatar.create(setting.record, dataclasses.replace(config, seed=seed))
    trainer, error = Trainer(avatar, None, pictures=setting.pictures), ""
    try:
        trainer.loop()
    except MonopartError as stop:
        error = str(stop)
    weights = all(bool(p.isfinite().all()) for p in avatar.model.parameters())
    losses = bool(trainer.last) and all(map(math.isfinite, trainer.last.values()))
    said = " ".join(trainer.result.warnings)
    return Row(
        name,
        seed,
        trainer.result.iterations,
        trainer.result.skipped,
        weights and losses,
        words is None or words in said,
        trainer.last.get("psnr", math.nan),
        error,
    )


def setting_of(capture: Path, overrides: dict[str, Any] | None = None) -> Setting:
    """Preset ``fast`` on a capture.

    Args:
        capture: its folder.
        overrides: sections of the configuration with entries to replace.
    """
    record = read_capture(capture)
    config = with_overrides(preset("fast"), **(overrides or {}))
    return Setting(record, read_pictures(record, "train"), config)


def table(rows: Sequence[Row]) -> str:
    """Markdown: a line for each case."""
    out = [
        "| case | runs | ended early | steps left out | not finite | said what is wrong | PSNR of "
        "the last batch |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, (_, words) in CASES.items():
        own = [r for r in rows if r.case == name]
        if not own:
            continue
        told = "nothing is" if words is None else f"{sum(r.told for r in own)} of {len(own)}"
        psnr = sorted(r.psnr for r in own)
        out.append(
            f"| {name} | {len(own)} | {sum(bool(r.error) for r in own)} | "
            f"{sum(r.skipped for r in own)} of {sum(r.steps for r in own)} | "
            f"{sum(not r.finite for r in own)} | {told} | {psnr[0]:.1f} to {psnr[-1]:.1f} |"
        )
    return "\n".join(out) + "\n"


def command(capture: Path, seeds: int, steps: int, into: Path | None) -> None:
    """Run all cases with some seeds; print the table, and write it into a page.

    Args:
        capture: folder of the capture.
        seeds: number of seeds.
        steps: steps of a training.
        into: page with the marks of the table, or None.
    """
    if into is not None:  # before the long run
        with_section(read_page(into), into, "stability-training", "")
    setting, rows = setting_of(capture), []
    for name in CASES:
        for seed in range(seeds):
            rows.append(run_case(name, seed, setting, steps))
        bad = sum(not r.finite or bool(r.error) or not r.told for r in rows if r.case == name)
        print(f"{name}: {seeds - bad} of {seeds} as they should be", flush=True)
    text = f"`{capture.name}`, preset `fast`, {steps} steps, {seeds} seeds a case.\n\n{table(rows)}"
    print(text)
    if into is not None:
        write_section(into, "stability-training", f"\n{text}\n")
