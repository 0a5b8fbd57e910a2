"""``monopart reproduce``: the paper's table for whoever holds ZJU-MoCap and MonoCap."""

import dataclasses
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from monopart.geometry.errors import InputError

from .atomic import write_json, write_text
from .capacity import as_asked
from .captures import SUBJECTS, Reading, read_capture, subject
from .captures.subjects import ON_TRAINING_CAMERA
from .choices import Extras
from .commands import train
from .config import Config, from_json
from .published import TRAINING_TIMES, published_scores
from .results import say
from .resume import STATE
from .runs import read_facts

DEPTH = 2
"""Folders below a named one in which subjects are looked for."""
NAMES = {"zju_mocap": "ZJU-MoCap", "monocap": "MonoCap"}
SPLITS = ("novel_view", "novel_pose", ON_TRAINING_CAMERA)
_TITLES = {
    "novel_view": "novel view",
    "novel_pose": "novel pose, held-out cameras",
    ON_TRAINING_CAMERA: "novel pose, training camera",
}


def find_subjects(folders: Sequence[Path], only: Sequence[str] = ()) -> dict[str, Path]:
    """The captures of the public subjects in some folders.

    Args:
        folders: where to look, themselves and up to `DEPTH` folders below.
        only: names of the subjects that are wanted; all that are found if empty.

    Returns:
        Subject to folder, in the order of the paper.

    Raises:
        InputError: a folder or a wanted subject is not there, none is found, or one twice.
    """
    wanted = [subject(name).name for name in only]
    found: dict[str, Path] = {}
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"{folder}: expected a folder that holds subjects, found none")
        for level in range(DEPTH + 1):
            for annots in sorted(folder.glob("*/" * level + "annots.npy")):
                root = annots.parent
                person = Reading().resolved(root).known_subject(root)
                if person is None:
                    continue
                if person.name in found and found[person.name].resolve() != root.resolve():
                    raise InputError(
                        f"{root}: expected one folder of subject {person.name}, found also "
                        f"{found[person.name]}; name the data set's folder alone"
                    )
                found[person.name] = root
    missing = [name for name in wanted if name not in found]
    if missing or not found:
        where = ", ".join(str(f) for f in folders) or "DATA"
        names = ", ".join(missing or (s.folders[0] for s in SUBJECTS.values()))
        raise InputError(
            f"{where}: expected folders such as {names} with annots.npy, found "
            f"{', '.join(found) or 'none'}; name their folder, or state the subject in capture.json"
        )
    return {name: found[name] for name in SUBJECTS if name in found and name in (wanted or found)}


def reproduce(
    folders: Sequence[Path],
    out: Path,
    config: Config,
    reading: Reading,
    only: Sequence[str] = (),
    images: int | None = None,
    device: str = "cpu",
) -> Path:
    """Train what is not there yet, and write the table.

    Args:
        folders: where the subjects are.
        out: folder of the runs and the table.
        config: configuration of every training.
        reading: how the captures are read; the subject is added.
        only: names of subjects; all that are found if empty.
        images: held-out images per split; None for all.
        device: where to train.

    Returns:
        The page with the table.

    Raises:
        InputError: a subject that cannot be read, or a run folder of another configuration; nothing
            was trained.
        KeyboardInterrupt: a training was interrupted; it was scored as it was, and its folder has
            to go before the same command trains it again.
    """
    captures = find_subjects(folders, only)
    readings = {name: dataclasses.replace(reading, subject=name) for name in captures}
    for name, capture in captures.items():
        say(f"{name}: {capture}")
        read_capture(capture, reading=readings[name])
    states = {name: _state(out / name, config) for name in captures}
    out.mkdir(parents=True, exist_ok=True)
    for name, capture in captures.items():
        if states[name] != "done":
            again = states[name] == "unfinished"
            train(capture, out / name, config, readings[name], _extras(images, device), again)
    scores = {name: read_facts(out / name / "metrics.json") for name in captures}
    facts = {
        "preset": config.preset,
        "seed": config.seed,
        "images_per_split": images,
        "legacy_pixels": bool(reading.legacy_pixels),
        "seconds": {n: read_facts(out / n / "training.json")["seconds"] for n in captures},
    }
    table = tabulate(scores, facts)
    write_json(out / "table.json", table, nonfinite="null")
    return write_text(out / "table.md", page(table))


def _extras(images: int | None, device: str) -> Extras:
    """What is scored; the paper's protocol is among it where the evaluation has a choice."""
    given: dict[str, Any] = {"protocols": ("strict", "legacy")}
    known = {f.name for f in dataclasses.fields(Extras)}
    given = {name: value for name, value in given.items() if name in known}
    return Extras(images=images, device=device, **given)


def _state(run: Path, config: Config) -> str:
    """How far a run is: absent, unfinished or done."""
    if not run.exists() or not any(run.iterdir()):
        return "absent"
    path = run / "config.json"
    if not path.is_file() or as_asked(from_json(path), config) != config:
        raise InputError(
            f"{run}: expected a run of this configuration or nothing, found another; choose "
            f"another --out, or remove that folder"
        )
    if (run / "report.html").is_file() and (run / "metrics.json").is_file():
        warnings = read_facts(run / "training.json").get("warnings", [])
        if any("interrupted" in text for text in warnings):
            raise InputError(
                f"{run}: expected a whole training, found one that was interrupted and scored as "
                f"it was; remove the folder to train it again"
            )
        return "done"
    if (run / STATE).is_file():
        return "unfinished"
    raise InputError(f"{run}: expected a run that can go on, found a broken one; remove the folder")


def tabulate(scores: Mapping[str, Mapping[str, Any]], facts: Mapping[str, Any]) -> dict[str, Any]:
    """Scores of subjects, and means over the subjects of each data set.

    Args:
        scores: subject to the content of its metrics.json.
        facts: what the table says of the trainings.

    Returns:
        `facts`, the protocol, and rows with dataset, subject ("mean" for all), split, subjects,
        psnr, ssim, lpips (times 1000; None where it was not measured).
    """
    named = [set(split) for metrics in scores.values() for split in metrics.values()]
    legacy = bool(named) and all("legacy" in protocols for protocols in named)
    protocol = "legacy" if legacy else "strict"
    rows: list[dict[str, Any]] = []
    for dataset in NAMES:
        names = [n for n in scores if SUBJECTS[n].dataset == dataset]
        for split in SPLITS:
            found = {n: scores[n].get(split, {}).get(protocol, {}).get("full") for n in names}
            group = [{"subject": n, **_figures(full)} for n, full in found.items() if full]
            if group:
                mean = {m: _mean([row[m] for row in group]) for m in ("psnr", "ssim", "lpips")}
                group.append({"subject": "mean", **mean})
            count = len(group) - 1
            rows += [{"dataset": dataset, "split": split, "subjects": count, **r} for r in group]
    return {**facts, "protocol": protocol, "rows": rows}


def _figures(full: Mapping[str, float | None]) -> dict[str, float | None]:
    lpips = full["lpips"]
    return {
        "psnr": full["psnr"],
        "ssim": full["ssim"],
        "lpips": None if lpips is None else 1000 * lpips,
    }


def _mean(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return statistics.fmean(known) if len(known) == len(values) else None


def page(table: Mapping[str, Any]) -> str:
    """The table as Markdown: the paper's figures, labelled so, and ours.

    Args:
        table: from `tabulate`.

    Returns:
        The text.
    """
    lines = ["# ZJU-MoCap and MonoCap", "", *_notes(table)]
    for dataset, title in NAMES.items():
        mine = [row for row in table["rows"] if row["dataset"] == dataset]
        for split in SPLITS:
            rows = [row for row in mine if row["split"] == split]
            if not rows:
                continue
            lines += ["", f"## {title}, {_TITLES[split]}", ""]
            lines += ["| | PSNR | SSIM | LPIPS × 1000 | training |", "|---|---|---|---|---|"]
            theirs = "novel_pose" if split == ON_TRAINING_CAMERA else split
            for score in published_scores():
                if (score.dataset, score.split) == (dataset, theirs):
                    cells = _cells(score.psnr, score.ssim, score.lpips)
                    time = TRAINING_TIMES[score.method]
                    lines.append(f"| {score.method} *(published)* | {cells} | {time} |")
            for row in rows:
                lines.append(_own_row(row, table))
    return "\n".join(lines) + "\n"


def _own_row(row: Mapping[str, Any], table: Mapping[str, Any]) -> str:
    cells = _cells(row["psnr"], row["ssim"], row["lpips"])
    if row["subject"] == "mean":
        whole = sum(s.dataset == row["dataset"] for s in SUBJECTS.values())
        return f"| **mean of {row['subjects']} of {whole} subjects** *(measured)* | {cells} | |"
    return f"| {row['subject']} *(measured)* | {cells} | {table['seconds'][row['subject']]:.0f} s |"


def _cells(psnr: float | None, ssim: float | None, lpips: float | None) -> str:
    texts = (
        "–" if value is None else f"{value:.{digits}f}"
        for value, digits in ((psnr, 2), (ssim, 3), (lpips, 2))
    )
    return " | ".join(texts)


def _notes(table: Mapping[str, Any]) -> list[str]:
    notes = [
        f"Preset `{table['preset']}`, seed {table['seed']}, protocol `{table['protocol']}`, "
        f"{'the authors’' if table['legacy_pixels'] else 'exact'} pixels."
    ]
    if table["protocol"] != "legacy":
        notes.append("The published figures are of protocol `legacy`: the columns differ in kind.")
    if table["images_per_split"] is not None:
        notes.append(f"Only {table['images_per_split']} images of each split were scored.")
    return notes
