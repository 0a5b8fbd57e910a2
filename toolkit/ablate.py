"""``monopart ablate``: a grid of configurations × seeds × captures, trained and scored, resumable.

A cell is an ordinary run folder, made by ``monopart train`` in a process of its own; summary.json,
written last, says that it is complete. All cells are checked before the first one is trained.
"""

import json
import shlex
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from monopart.geometry.errors import InputError, MonopartError

from .ablate_jobs import Start, locked, running_part, start_process
from .ablate_page import write_tables
from .arguments import resolve
from .atomic import write_json
from .captures import read_capture
from .config import Config, from_json
from .environment import usable_cores
from .grid import Variant, explicit, same_but_for_name
from .metrics import Protocol
from .progress import progress_bar
from .protocols import held_out_pairs
from .results import say
from .resume import STATE
from .runs import read_facts

SUMMARY = "summary.json"
POLL = 0.25  # seconds between two looks at the processes


@dataclass(frozen=True)
class Plan:
    """What is to be compared, and how.

    Attributes:
        captures: folders of captures.
        out: folder of the cells and tables.
        variants: name to variant; `full` is one of them.
        seeds: number of seeds, from 0.
        base: name of the preset that variants without their own start from.
        settings: entries to replace in every cell; a variant's own come after them.
        seconds: wall-clock budget of each training; None for the preset's.
        iterations: steps of each training; None for the preset's.
        images: held-out images to score per split; None for all.
        params: name of the body track; None for the capture's own.
        device: where to train.
        jobs: trainings at a time; each gets its share of the cores.
        protocols: names of protocols to score under; ``strict`` is always one.
    """

    captures: tuple[Path, ...]
    out: Path
    variants: Mapping[str, Variant]
    seeds: int
    base: str
    settings: tuple[str, ...] = ()
    seconds: float | None = None
    iterations: int | None = None
    images: int | None = None
    params: str | None = None
    device: str = "cpu"
    jobs: int = 1
    protocols: tuple[Protocol, ...] = ("strict",)


@dataclass(frozen=True)
class Cell:
    """One training of a plan.

    Attributes:
        capture: folder of the capture.
        name: name of the variant.
        seed: seed of the run.
        config: the resolved configuration.
        folder: run folder.
        command: arguments of ``monopart`` that make it.
    """

    capture: Path
    name: str
    seed: int
    config: Config
    folder: Path
    command: tuple[str, ...]

    @property
    def title(self) -> str:
        """Short name for messages."""
        return f"{self.capture.name}, {self.name}, seed {self.seed}"


def cells_of(plan: Plan) -> tuple[list[Cell], dict[str, str]]:
    """All trainings of a plan, seed by seed, and variants that are equal to another one.

    Args:
        plan: what is to be compared.

    Returns:
        Cells; name of a variant to the one before it that has the same configuration.

    Raises:
        InputError: an unknown preset or entry, a bad value, two captures of one name.
    """
    names = [capture.resolve().name for capture in plan.captures]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise InputError(
            f"CAPTURE: expected folders of different names, found {twice[0]} twice; rename one"
        )
    configs: dict[str, tuple[Config, tuple[str, ...]]] = {}
    equal: dict[str, str] = {}
    for name, variant in plan.variants.items():
        configs[name] = _resolved(plan, name, variant)
        for other, (config, _) in list(configs.items())[:-1]:
            if other not in equal and same_but_for_name(configs[name][0], config):
                equal[name] = other
                break
    cells = [
        _cell(plan, capture, name, seed, *configs[name])
        for seed in range(plan.seeds)
        for capture in plan.captures
        for name in plan.variants
        if name not in equal
    ]
    return cells, equal


def _resolved(plan: Plan, name: str, variant: Variant) -> tuple[Config, tuple[str, ...]]:
    preset = variant.preset or plan.base
    try:
        base = resolve(preset, [plan.settings], plan.seconds, plan.iterations)
        settings = (*plan.settings, *explicit(variant.settings, base))
        return resolve(preset, [settings], plan.seconds, plan.iterations), settings
    except InputError as error:
        raise InputError(f"cell {name}: {error}") from None


def _cell(
    plan: Plan, capture: Path, name: str, seed: int, config: Config, settings: tuple[str, ...]
) -> Cell:
    folder = plan.out / capture.resolve().name / name / f"seed-{seed}"
    preset = plan.variants[name].preset or plan.base
    command = ["train", str(capture), "--out", str(folder), "--preset", preset]
    command += ["--seed", str(seed), "--device", plan.device]
    for option in ("seconds", "iterations", "images", "params"):
        value = getattr(plan, option)
        command += [] if value is None else [f"--{option}", str(value)]
    command += ["--protocols", *plan.protocols]
    if settings:
        command += ["--set", *settings]
    seeded = resolve(preset, [settings], plan.seconds, plan.iterations, seed)
    return Cell(capture, name, seed, seeded, folder, tuple(command))


def state_of(cell: Cell, plan: Plan) -> str:
    """How far a cell is: "absent", "unfinished" (it can go on), "broken" (begin again) or "done".

    Args:
        cell: the training.
        plan: what it belongs to.

    Raises:
        InputError: the folder holds a run of other settings, or something else.
    """
    folder = cell.folder
    if not folder.exists() or not any(folder.iterdir()):
        return "absent"
    if not (folder / "config.json").is_file():
        raise InputError(
            f"{folder}: expected a run of this grid or nothing, found other files; choose another "
            "--out"
        )
    found = from_json(folder / "config.json")
    if found != cell.config:
        raise InputError(
            f"{folder}: expected a run of the same settings, found {_difference(found, cell)}; "
            "choose another --out, or remove that folder"
        )
    if (folder / SUMMARY).is_file():
        facts = read_facts(folder / SUMMARY)
        asked = {"images": plan.images, "protocols": list(plan.protocols)}
        for name, wanted in asked.items():
            if facts.get(f"{name}_asked") != wanted:
                raise InputError(
                    f"{folder}: expected scores of --{name} {wanted}, found "
                    f"{facts.get(f'{name}_asked')}; choose another --out, or the same --{name}"
                )
        return "done"
    return "unfinished" if (folder / STATE).is_file() else "broken"


def _difference(found: Config, cell: Cell) -> str:
    """The first entry in which a stored configuration differs from the wanted one."""
    for section, wanted in vars(cell.config).items():
        stored = getattr(found, section)
        if stored == wanted:
            continue
        if not hasattr(wanted, "__dataclass_fields__"):
            return f"{section}={stored} in place of {wanted}"
        for entry, value in vars(wanted).items():
            if getattr(stored, entry) != value:
                return f"{section}.{entry}={getattr(stored, entry)} in place of {value}"
    return "another configuration"


def ablate(
    plan: Plan, command: str, publish: Path | None = None, start: Start | None = None
) -> Path:
    """Train what is not there yet, and write the tables.

    Args:
        plan: what is to be compared.
        command: the command line, for the tables.
        publish: a page whose marked part is replaced by the tables.
        start: how a training is started, for tests.

    Returns:
        The page with the tables.

    Raises:
        InputError: something in the plan cannot be used; nothing was trained.
        MonopartError: a training failed; the others are complete.
    """
    cells, equal = cells_of(plan)
    splits = _check_captures(plan)
    states = {cell.folder: state_of(cell, plan) for cell in cells}
    open_cells = [c for c in cells if states[c.folder] != "done"]
    say(f"{len(cells)} trainings, {len(cells) - len(open_cells)} of them complete")
    for name, other in equal.items():
        say(f"{name}: the same configuration as {other}; not trained again")
    with locked(plan.out) as lock:
        threads = max(1, usable_cores() // plan.jobs)
        failed = _run(
            plan, open_cells, start or (lambda a, log: start_process(a, log, threads, lock))
        )
        done = [read_facts(c.folder / SUMMARY) for c in cells if (c.folder / SUMMARY).is_file()]
        facts = {"command": command, "base": plan.base, "equal": equal, "splits": splits}
        facts["settings"] = list(plan.settings)
        page = write_tables(plan.out, plan.variants, done, facts, publish)
    if failed:
        raise MonopartError(
            f"{len(failed)} of {len(cells)} trainings failed ({failed[0][0].title}: see "
            f"{failed[0][1]}); correct the cause and give the same command again"
        )
    return page


def _check_captures(plan: Plan) -> dict[str, dict[str, int]]:
    """Number of images of each split of each capture."""
    found = {}
    for capture in plan.captures:
        record = read_capture(capture, params=plan.params)
        held = held_out_pairs(record)
        if not held:
            raise InputError(f"{capture}: expected a held-out split, found none; add splits.json")
        found[capture.resolve().name] = {name: len(pairs) for name, pairs in held.items()}
    return found


def _run(plan: Plan, cells: Sequence[Cell], start: Start) -> list[tuple[Cell, Path]]:
    """Train cells, some at a time; those that failed, with their logs."""
    waiting, running = list(cells), {}
    failed: list[tuple[Cell, Path]] = []
    took: list[float] = []
    logs = plan.out / "logs"
    logs.mkdir(exist_ok=True)
    try:
        with progress_bar("Ablation") as update:
            while waiting or running:
                while waiting and len(running) < plan.jobs:
                    cell = waiting.pop(0)
                    log = logs / f"{cell.capture.resolve().name}-{cell.name}-{cell.seed}.txt"
                    running[start(_begun(cell, plan, log), log)] = (cell, log, time.perf_counter())
                for job in [j for j in running if j.poll() is not None]:
                    cell, log, began = running.pop(job)
                    took.append(time.perf_counter() - began)
                    if job.poll() == 0:
                        summarise(cell, plan)
                    else:
                        failed.append((cell, log))
                        say(f"failed: {cell.title}; see {log}")
                count = len(cells) - len(waiting) - len(running)
                titles = "; ".join(c.title for c, _, _ in running.values())
                part = running_part(took, [began for _, _, began in running.values()])
                update((count + part) / max(len(cells), 1), f"{count}/{len(cells)} {titles}")
                if running:
                    time.sleep(POLL)
    finally:
        for job in running:
            job.terminate()
    return failed


def _begun(cell: Cell, plan: Plan, log: Path) -> Sequence[str]:
    """Arguments that begin a cell or go on with it; what cannot go on is removed first."""
    state = state_of(cell, plan)
    if state == "broken":
        shutil.rmtree(cell.folder)
    else:
        cell.folder.parent.mkdir(parents=True, exist_ok=True)
    arguments = [*cell.command, *(["--resume"] if state == "unfinished" else [])]
    with log.open("a", encoding="utf-8") as file:
        file.write(f"$ monopart {shlex.join(arguments)}\n")
    return arguments


def summarise(cell: Cell, plan: Plan) -> dict[str, Any]:
    """Write summary.json, which says that a cell is complete.

    Args:
        cell: a training that has ended well.
        plan: what it belongs to.

    Returns:
        What it holds: capture, cell, seed, metrics, costs, numbers of scored images, code.

    Raises:
        InputError: a file of the run is missing or broken.
    """
    folder = cell.folder
    training, environment = (read_facts(folder / f"{n}.json") for n in ("training", "environment"))
    metrics = read_facts(folder / "metrics.json")
    counts: dict[str, int] = {}
    for split in metrics:
        table = folder / f"images_{split}.csv"
        if not table.is_file():
            raise InputError(f"{table}: expected the scores of each image, found none; restore it")
        counts[split] = len(table.read_text(encoding="utf-8").splitlines()) - 1
    if (folder / "refit.json").is_file():  # scores at refit poses stand beside the others
        for row in read_facts(folder / "refit.json")["rows"]:
            metrics[f"{row['split']}@{row['column']}"] = {"strict": row["refit"]}
    name = cell.capture.resolve().name
    # folders by their names alone: the summary is published
    run = f"runs/{plan.out.name}/{name}/{cell.name}/seed-{cell.seed}"
    places = f"CAPTURES/{name}", "--out", run
    summary = {
        "capture": name,
        "cell": cell.name,
        "seed": cell.seed,
        "command": shlex.join(("monopart", "train", *places, *cell.command[4:])),
        "images_asked": plan.images,
        "protocols_asked": plan.protocols,
        "images": counts,
        "iterations": training["iterations"],
        "seconds": training["seconds"],
        "cpu_seconds": training["cpu_seconds"],
        "warnings": training["warnings"],
        "code": {k: environment.get(k) for k in ("git_commit", "packages", "threads", "cpu")},
        "metrics": metrics,
    }
    write_json(folder / SUMMARY, summary)
    return json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
