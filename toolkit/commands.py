"""What the program's subcommands do; heavy imports live here, the command line is in ``cli``."""

import dataclasses
import json
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from monopart.geometry.errors import InputError

from .animate import as_uint8, pose_of, turntable_views
from .avatar import Avatar, View
from .cache import user_cache
from .capacity import allocated, capacity_lines
from .captures import Reading, check_capture, describe, read_capture
from .captures.cache import read_pictures
from .choices import Choices, Extras
from .config import Config
from .device import pick_device
from .explain import print_skipping, why_empty
from .metrics import Protocol
from .pose_errors import joint_error_table, joint_errors
from .profile_page import print_profile, write_profile
from .profiling import profile_training
from .progress import counted, progress_bar
from .render import Picture, render_view, render_views
from .results import (
    evaluate_splits,
    held_out,
    report_refit,
    say,
    skipping,
    summary,
    write_results,
    write_scores,
)
from .resume import load_state
from .runs import check_free, check_uv, create_run, next_free, open_run, read_facts, resumable
from .savings import print_savings, rendering_savings, training_savings
from .train import Trainer
from .train_result import TrainResult
from .video import save_png, write_video

STRIP_VIEWS, STRIP_SIZE = 8, 384  # turntable of a report: pictures of one turn, pixels
DEMO_VIEWS, DEMO_SIZE = 24, 320  # turntable of the demo: frames of the video, pixels
FPS = 24


@dataclass
class Stages:
    """Wall-clock seconds of the stages of a run, in order."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add the time of a block."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = time.perf_counter() - start


def train(
    capture: Path,
    out: Path,
    config: Config,
    reading: Reading | None = None,
    extras: Extras | None = None,
    resume: bool = False,
) -> Path:
    """Train on a capture, evaluate, write the report; the scores and its path go to stdout.

    An interrupt of the training ends it early: what was trained is saved, scored and reported.

    Args:
        capture: folder of the capture.
        out: run folder to make.
        config: the resolved configuration.
        reading: how the capture is read: body track, subject, sizes.
        extras: what is done beside the training, and where.
        resume: go on with an unfinished run in ``out``, with its own configuration.

    Returns:
        The report.

    Raises:
        InputError: a fault in the capture, or a run folder that exists.
        KeyboardInterrupt: the training was interrupted; everything is written.
    """
    stages, extras = Stages(), extras or Extras()
    device = pick_device(extras.device)
    trainer = _trainer(capture, out, config, reading, stages, device, resume)
    if extras.profile:
        _profile(trainer, out)
    interrupted = _train(trainer, stages)
    avatar, result = trainer.avatar.for_test(), trainer.result
    if extras.explain:
        print_savings("What skipping saves in a training step", training_savings(trainer))
    with stages.timed("evaluation"):
        names = held_out(avatar.record)
        evaluations = evaluate_splits(avatar, names, extras.images, extras.protocols)
    size = min(STRIP_SIZE, *avatar.record.image_size)
    with stages.timed("turntable strip"):
        strip = [as_uint8(p.color) for p in turn(avatar, STRIP_VIEWS, size=size)]
    report_refit(out, avatar, evaluations, extras.images is None)
    report = write_results(out, avatar, result, evaluations, stages.seconds, strip, extras.explain)
    print(f"report: {report}", flush=True)
    if interrupted:
        raise KeyboardInterrupt
    return report


def demo(capture: Path, out: Path, config: Config, device: str = "cpu") -> Path:
    """Train, evaluate, write a turntable video and the report; the last line says where it is.

    Args:
        capture: folder of the capture.
        out: run folder to make; where it exists, the next free name is taken.
        config: the resolved configuration.
        device: see :func:`pick_device`.

    Returns:
        The report.
    """
    there = pick_device(device)
    run, stages = next_free(out), Stages()
    if run != out:
        say(f"{out} exists; this run goes to {run}")
    trainer = _trainer(capture, run, config, None, stages, there)
    interrupted = _train(trainer, stages)
    avatar, result = trainer.avatar.for_test(), trainer.result
    with stages.timed("evaluation"):
        evaluations = evaluate_splits(avatar, held_out(avatar.record), None)
    with stages.timed("turntable video"):
        pictures = [as_uint8(p.color) for p in turn(avatar, DEMO_VIEWS, size=DEMO_SIZE)]
        write_video(run / "turntable.mp4", pictures, fps=FPS)
    print(f"turntable: {run / 'turntable.mp4'}")
    strip = pictures[:: max(1, DEMO_VIEWS // STRIP_VIEWS)]
    report = write_results(run, avatar, result, evaluations, stages.seconds, strip)
    print(f"report: {report}", flush=True)
    if interrupted:
        raise KeyboardInterrupt
    return report


def _trainer(
    capture: Path,
    out: Path,
    config: Config,
    reading: Reading | None,
    stages: Stages,
    device: torch.device,
    resume: bool = False,
) -> Trainer:
    """Everything that a training needs, read and prepared; the run folder is made."""
    if resume:
        config, reading = resumable(out)
    else:
        check_free(out)
    with stages.timed("reading and body geometry"), progress_bar("Reading", True) as update:
        record, cache = read_capture(capture, reading=reading), user_cache(say)
        pictures = read_pictures(
            record, "train", cache, lambda i, n: update(0.6 * i / n, f"image {i}/{n}")
        )
        check_capture(record, deep=True, masks=pictures.masks)
        record = record.to(device)
        config, capacity = allocated(config, record, pictures, cache)
        run = out if resume else create_run(out, config, record)
        torch.manual_seed(config.seed)
        update(0.6, "canonical body")
        avatar = Avatar.create(record, config, cache)
        update(0.8, "posed bodies")
        trainer = Trainer(avatar, run, pictures=pictures)
        trainer.result.capacity = capacity
        if resume:
            check_uv(run, record)
            load_state(trainer, run)
            say(f"going on from step {trainer.result.iterations}")
        update(1.0, "")
    with stages.timed("kernels (compiled once per machine)"):
        trainer.warm_up()
    return trainer


def _profile(trainer: Trainer, run: Path) -> None:
    """Measure the stages of a step on a copy; the training is not touched."""
    with progress_bar("Profiling") as update:
        profiles = profile_training(trainer, lambda i, n: update(i / n, f"step {i}/{n}"))
    print_profile(profiles)
    write_profile(run, profiles)
    say(f"profile: {run / 'profile.html'}")


def _train(trainer: Trainer, stages: Stages) -> bool:
    """Train; True where an interrupt ended it early."""
    name, preset = trainer.avatar.record.name, trainer.config.preset
    say(f"{name}: training preset {preset} on {len(trainer.body_of_image)} images")
    for line in capacity_lines(trainer.result.capacity):
        say(line)
    interrupted = _run_loop(trainer)
    stages.seconds["training"] = trainer.result.seconds
    say(f"trained {trainer.result.iterations} steps in {trainer.result.seconds:.1f} s")
    return interrupted


def _run_loop(trainer: Trainer) -> bool:
    """Train; True where an interrupt ended it early."""
    with progress_bar("Training") as update:

        def show(done: float, numbers: dict[str, float]) -> None:
            count, seconds = trainer.result.iterations, trainer.result.seconds
            loss = sum(v for k, v in numbers.items() if k != "psnr")
            note = f"step {count}, {count / max(seconds, 1e-9):.1f}/s, loss {loss:.4f}"
            update(done, f"{note}, PSNR {numbers.get('psnr', float('nan')):.1f}")

        try:
            trainer.loop(show)
        except KeyboardInterrupt:
            if not trainer.result.iterations:
                raise
            trainer.finish()
            trainer.result.warnings.append("Training was interrupted; the report is of that state.")
            say("interrupted: scoring what was trained; interrupt again to stop at once")
            return True
    return False


def evaluate(
    run: Path,
    split: str | None,
    capture: Path | None,
    images: int | None,
    device: str = "cpu",
    protocols: Sequence[Protocol] = ("strict",),
    truth: str | None = None,
) -> None:
    """Score a run; all images of all splits also rebuild its report.

    Args:
        run: the run folder.
        split: name of one split; None for all held-out ones.
        capture: the capture, if it has moved.
        images: images per split; the run folder is then left as it is. None for all.
        device: see :func:`pick_device`.
        protocols: names of protocols; ``strict`` is always one.
        truth: name of a folder of exact body poses: the joint error against it is printed.
    """
    avatar = open_run(run, capture, pick_device(device)).for_test()
    stages = Stages()
    path = run / "training.json"
    whole = images is None and split is None and path.is_file()
    training = _training_facts(path) if whole else None
    names = held_out(avatar.record) if split is None else [split]
    with stages.timed("evaluation"):
        evaluations = evaluate_splits(avatar, names, images, protocols)
    report_refit(run, avatar, evaluations, images is None and split is None)
    if truth is not None:
        print(joint_error_table(*joint_errors(avatar, read_capture(avatar.record.root, truth))))
    if training is not None:
        result, earlier = training
        size = min(STRIP_SIZE, *avatar.record.image_size)
        strip = [as_uint8(p.color) for p in turn(avatar, STRIP_VIEWS, size=size)]
        report = write_results(run, avatar, result, evaluations, earlier | stages.seconds, strip)
        print(f"report: {report}")
        return
    if images is None:
        write_scores(run, avatar.record, evaluations)
    else:
        say(f"{run}: left as it is, for these are the scores of some of the images")
    for evaluation in evaluations:
        print(summary(evaluation))


def _training_facts(path: Path) -> tuple[TrainResult, dict[str, float]]:
    """What a training.json says: what the training did, and seconds per stage."""
    facts = read_facts(path)
    names = [f.name for f in dataclasses.fields(TrainResult)]
    lacking = [n for n in (*names, "stages") if n not in facts]
    if lacking:
        raise InputError(f"{path}: expected {lacking[0]}, found no such entry; restore the file")
    facts["stats"] = Counter(facts["stats"])
    return TrainResult(**{n: facts[n] for n in names}), facts["stages"]


def render(
    run: Path,
    camera: str,
    frame: int,
    out: Path,
    capture: Path | None,
    choices: Choices,
) -> None:
    """Render one camera at one frame of the capture.

    Args:
        run: the run folder.
        camera: name or number of a camera.
        frame: frame that gives the body pose.
        out: picture to write.
        capture: the capture, if it has moved.
        choices: how.
    """
    avatar = open_run(run, capture, pick_device(choices.device))
    index = avatar.record.camera_index(camera)
    view = View(avatar.record.cameras[index], pose_of(avatar.record, frame), frame)
    start = time.perf_counter()
    picture = render_view(avatar, view, skip=choices.skip, coarse=choices.coarse, half=choices.half)
    took = time.perf_counter() - start
    save_png(out, as_uint8(picture.color))
    why = why_empty(avatar, view, picture)
    if why is not None:
        say(f"warning: camera {camera}, frame {frame}: nothing is visible: {why}")
    if choices.explain:
        print_skipping(skipping(avatar, {}, 0, picture.stats))
        print_savings("What skipping saves in this picture", rendering_savings(avatar, view))
    say(f"rendered in {took:.2f} s")
    print(out)


def turn(
    avatar: Avatar, views: int, frame: int | None = None, size: int | None = None
) -> list[Picture]:
    """Pictures of one turn around the person; says so where one of them is empty.

    Args:
        avatar: the person.
        views: number of pictures.
        frame: frame that gives the pose; the first training frame if None.
        size: longer side, pixels; the training camera's if None.
    """
    cameras = turntable_views(avatar, views, frame, size)
    with progress_bar("Turntable") as update:
        pictures = render_views(avatar, cameras, counted(update))
    for view, picture in zip(cameras, pictures, strict=True):
        why = why_empty(avatar, view, picture)
        if why is not None:
            say(f"warning: turntable: nothing is visible: {why}")
            break
    return pictures


def turntable(
    run: Path,
    out: Path,
    frames: int,
    frame: int | None,
    size: int | None,
    capture: Path | None,
    device: str = "cpu",
) -> None:
    """Write a video of the person turning once.

    Args:
        run: the run folder.
        out: video to write.
        frames: number of frames.
        frame: frame that gives the pose; the first training frame if None.
        size: longer side, pixels; the training camera's if None.
        capture: the capture, if it has moved.
        device: see :func:`pick_device`.
    """
    avatar = open_run(run, capture, pick_device(device))
    pictures = turn(avatar, frames, frame, size)
    write_video(out, [as_uint8(p.color) for p in pictures], fps=FPS)
    print(out)


def info(path: Path, reading: Reading | None = None) -> None:
    """Print the facts of a capture or of a run as JSON.

    Args:
        path: folder of a capture or of a run.
        reading: how a capture is read.
    """
    facts: dict[str, Any]
    if (path / "config.json").is_file():
        facts = {"run": str(path)}
        for name in ("config", "metrics", "capture", "training", "environment"):
            file = path / f"{name}.json"
            facts[name] = read_facts(file) if file.is_file() else None
    else:
        record = read_capture(path, reading=reading)
        facts = describe(record) | {"check": dataclasses.asdict(check_capture(record, deep=True))}
    facts["cache"] = user_cache(say).facts()
    print(json.dumps(facts, indent=2, default=str))
