"""The arguments of every command, as dataclasses that tyro turns into a command line."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from monopart.geometry.errors import InputError

from .ablate_arguments import Ablate, ProtocolName
from .config import Config
from .overrides import overridden
from .presets import preset, preset_names
from .reading_arguments import AS_IT_IS, Flags
from .replay_arguments import Replay
from .reproduce_arguments import Reproduce
from .skipping import EVERY, KINDS

PROGRAM = """Animatable avatars from monocular video.

CAPTURE is a folder in the layout of ZJU-MoCap or MonoCap; RUN is a folder that training makes.
Results go to stdout, progress to stderr. Bad input: one line and exit code 2; interrupt: 130.

What takes long to prepare is kept in ~/.cache/monopart/frames (XDG_CACHE_HOME is heeded), at most
in 4 GB. MONOPART_CACHE names another folder, or "off"; MONOPART_CACHE_GB another limit; monopart
info tells where it is and how large."""
SPLITS = ("novel_view", "novel_pose", "novel_pose_training_camera")
OF_PRESET = "(default: the preset's)"

Device = Annotated[str, arg(metavar="cpu|cuda|cuda:N|auto")]
CaptureArg = Annotated[Positional[Path], arg(metavar="CAPTURE")]
RunArg = Annotated[Positional[Path], arg(metavar="RUN")]
OutRun = Annotated[Path, arg(metavar="RUN")]
Name = Annotated[str, arg(metavar="NAME")]
Count = Annotated[int, arg(metavar="N")]
MaybeImages = Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: all)")]
MovedCapture = Annotated[
    Path | None, arg(metavar="DIR", help_behavior_hint="(default: where it was in training)")
]
Settings = Annotated[
    tuple[tuple[str, ...], ...], UseAppendAction, arg(metavar="SECTION.ENTRY=VALUE ...")
]
KindsOfSkipping = Annotated[tuple[str, ...], arg(metavar="|".join(KINDS) + " ...")]
Protocols = Annotated[tuple[ProtocolName, ...], arg(metavar="strict|legacy|boxed ...")]
PresetName = Annotated[
    str,
    arg(metavar="NAME", help="Configuration to start from: " + ", ".join(preset_names()) + "."),
]


@dataclass(frozen=True)
class Train:
    """Train an avatar on a capture, evaluate it on the held-out images and write the report.

    The run folder holds config.json, capture.json, environment.json, train.jsonl,
    model.safetensors, training.json, metrics.json, images_SPLIT.csv and report.html.
    """

    capture: CaptureArg
    """Folder of the capture (it holds annots.npy)."""
    out: OutRun
    """Run folder to make; it must be new or empty."""
    preset: PresetName = preset_names()[0]
    """Configuration to start from."""
    seconds: Annotated[float | None, arg(metavar="S", help_behavior_hint=OF_PRESET)] = None
    """Wall-clock seconds of training; not together with --iterations."""
    iterations: Annotated[int | None, arg(metavar="N", help_behavior_hint=OF_PRESET)] = None
    """Steps of training; not together with --seconds."""
    seed: Annotated[int | None, arg(metavar="K", help_behavior_hint=OF_PRESET)] = None
    """Seed of initial values, batches and jitter, from 0."""
    reading: Flags = AS_IT_IS
    """How the capture is read."""
    set: Settings = ()
    """Entries of the configuration to replace, such as train.rays=512; config.json lists them."""
    images: MaybeImages = None
    """Held-out images to evaluate per split, evenly spread."""
    protocols: Protocols = ("strict",)
    """Protocols to score under; each costs another pass of LPIPS. strict is always one of them."""
    explain: bool = False
    """Print tables of the rays, samples, part evaluations and modules that were skipped, and of the
    time that this saves."""
    profile: bool = False
    """Measure where a step's time goes first; writes profile.html and profile.json (a trace)."""
    resume: bool = False
    """Go on with the unfinished run in --out, with its own configuration."""
    device: Device = "cpu"
    """Where to train and render; auto is a GPU where there is one."""

    def run(self) -> None:
        """Do it."""
        config = resolve(self.preset, self.set, self.seconds, self.iterations, self.seed)
        check_count("--images", self.images)
        from . import commands

        commands.train(
            self.capture,
            self.out,
            config,
            reading=self.reading.reading(),
            extras=commands.Extras(
                self.images, self.explain, self.profile, self.device, self.protocols
            ),
            resume=self.resume,
        )


@dataclass(frozen=True)
class Eval:
    """Score a run on the held-out images of its capture.

    Protocols: strict (masked image over black; full image, box of the mask, silhouette), legacy
    (as the published tables: SSIM of data range 2, LPIPS fed [0, 1]) and boxed (legacy inside the
    box of the body, as NeuralBody).

    A run that refined body poses is scored at the poses as given, and in columns of their own at
    refit ones (refit.json). Scores of all images of a split go into metrics.json; a full
    evaluation rebuilds report.html.
    """

    run_folder: RunArg
    """Folder that monopart train made."""
    split: Annotated[
        str | None, arg(metavar="|".join(SPLITS), help_behavior_hint="(default: all)")
    ] = None
    """Held-out cameras at training poses (novel_view), at new poses (novel_pose), or the training
    camera at new poses."""
    images: MaybeImages = None
    """Images to score per split, evenly spread; the run folder is then left as it is."""
    protocols: Protocols = ("strict",)
    """Protocols to score under; each costs another pass of LPIPS. strict is always one of them."""
    capture: MovedCapture = None
    """Folder of the capture, if it has moved."""
    device: Device = "cpu"
    """Where to render; auto is a GPU where there is one."""
    truth: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: none)")] = None
    """Folder of exact body poses in the capture: prints the joint error of the training frames."""

    def run(self) -> None:
        """Do it."""
        check_count("--images", self.images)
        if self.split is not None and self.split not in SPLITS:
            raise InputError(
                f"--split: expected {' or '.join(SPLITS)}, found {self.split!r}; choose one of them"
            )
        from . import commands

        commands.evaluate(
            self.run_folder,
            self.split,
            self.capture,
            self.images,
            self.device,
            self.protocols,
            self.truth,
        )


@dataclass(frozen=True)
class Render:
    """Render one camera of the capture at one of its frames."""

    run_folder: RunArg
    """Folder that monopart train made."""
    camera: Name
    """Name of a camera, or its number from 0; monopart info lists them."""
    frame: Count
    """Frame number that gives the body pose."""
    out: Annotated[Path, arg(metavar="FILE.png")]
    """Picture to write, of the camera's size in pixels."""
    capture: MovedCapture = None
    """Folder of the capture, if it has moved."""
    explain: bool = False
    """Print tables of the rays, samples and part evaluations that were skipped, and of the time
    that each kind saves (the picture is rendered without each)."""
    no_skip: KindsOfSkipping = ()
    """Kinds of skipping to switch off."""
    coarse: Count = 1
    """Look at every N-th sample of a ray first and fill in where there is something; 1 is exact."""
    half: bool = False
    """Run the networks in float16 (for GPUs: slower on a CPU)."""
    device: Device = "cpu"
    """Where to render; auto is a GPU where there is one."""

    def run(self) -> None:
        """Do it."""
        check_file("--out", self.out, ".png")
        check_count("--coarse", self.coarse)
        skip = EVERY.without(self.no_skip)
        if self.coarse > 1 and not skip.light:
            raise InputError("--coarse: expected 1 together with --no-skip light; drop one of them")
        from . import commands

        commands.render(
            self.run_folder,
            self.camera,
            self.frame,
            self.out,
            self.capture,
            commands.Choices(self.explain, self.coarse, self.half, skip, self.device),
        )


@dataclass(frozen=True)
class Turntable:
    """Write a video of the person turning once in one pose, 24 frames a second."""

    run_folder: RunArg
    """Folder that monopart train made."""
    out: Annotated[Path, arg(metavar="FILE.mp4")]
    """Video to write."""
    frames: Count = 48
    """Number of frames of the video."""
    frame: Annotated[
        int | None, arg(metavar="N", help_behavior_hint="(default: the first training frame)")
    ] = None
    """Frame number of the capture that gives the body pose."""
    size: Annotated[
        int | None, arg(metavar="PX", help_behavior_hint="(default: the training camera's)")
    ] = None
    """Longer side of the video, pixels, from 16."""
    capture: MovedCapture = None
    """Folder of the capture, if it has moved."""
    device: Device = "cpu"
    """Where to render; auto is a GPU where there is one."""

    def run(self) -> None:
        """Do it."""
        check_count("--frames", self.frames)
        check_count("--size", self.size, 16)
        check_file("--out", self.out, ".mp4")
        from . import commands

        commands.turntable(
            self.run_folder,
            self.out,
            self.frames,
            self.frame,
            self.size,
            self.capture,
            self.device,
        )


@dataclass(frozen=True)
class Info:
    """Print the facts of a capture (after checking every training image) or of a run, as JSON."""

    path: Annotated[Positional[Path], arg(metavar="CAPTURE|RUN")]
    """Folder of a capture or of a run."""
    reading: Flags = AS_IT_IS
    """How a capture is read."""

    def run(self) -> None:
        """Do it."""
        from . import commands

        commands.info(self.path, self.reading.reading())


@dataclass(frozen=True)
class Demo:
    """Train preset tiny on a small capture, evaluate, write turntable.mp4 and the report.

    The last line on stdout says where the report is.
    """

    out: OutRun = Path("runs/demo")
    """Run folder to make; where it exists, the next free name (demo-2, demo-3, ...) is taken."""
    capture: Annotated[Path, arg(metavar="DIR")] = Path("examples/capture")
    """Folder of the capture."""
    set: Settings = ()
    """Entries of the configuration to replace, such as train.seconds=60."""
    device: Device = "cpu"
    """Where to train and render; auto is a GPU where there is one."""

    def run(self) -> None:
        """Do it."""
        config = resolve("tiny", self.set)
        if not self.capture.exists():
            raise InputError(
                f"{self.capture}: expected the capture of the demo, found nothing; run this in the "
                "folder of the repository, or name a capture by --capture"
            )
        from . import commands

        commands.demo(self.capture, self.out, config, self.device)


Command = Train | Eval | Render | Turntable | Info | Demo | Replay | Ablate | Reproduce
_Commands = (
    Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Eval, tyro.conf.subcommand("eval")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Turntable, tyro.conf.subcommand("turntable")]
    | Annotated[Info, tyro.conf.subcommand("info")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Replay, tyro.conf.subcommand("replay")]
    | Annotated[Ablate, tyro.conf.subcommand("ablate")]
    | Annotated[Reproduce, tyro.conf.subcommand("reproduce")]
)


def parse(argv: Sequence[str]) -> Command:
    """The command that a command line asks for.

    Args:
        argv: arguments after the program's name.

    Raises:
        SystemExit: help was asked for (0), or the arguments do not fit (2); what is wrong is on
            stderr.
    """
    return tyro.cli(
        _Commands,  # pyright: ignore[reportArgumentType]
        prog="monopart",
        description=PROGRAM,
        args=list(argv),
        config=(FlagCreatePairsOff,),
    )


def resolve(
    name: str,
    settings: Sequence[Sequence[str]] = (),
    seconds: float | None = None,
    iterations: int | None = None,
    seed: int | None = None,
) -> Config:
    """The configuration that a command line asks for.

    Args:
        name: name of the preset.
        settings: groups of ``section.entry=value``.
        seconds: wall-clock budget of the training, seconds.
        iterations: steps of the training.
        seed: seed of the run.

    Raises:
        InputError: an unknown preset or entry, a bad value, both budgets at once.
    """
    if seconds is not None and iterations is not None:
        raise InputError(
            "--seconds and --iterations: expected one of them, found both; leave one out"
        )
    config = overridden(preset(name), [s for group in settings for s in group])
    train = config.train
    if seconds is not None:
        train = dataclasses.replace(train, seconds=seconds)
    if iterations is not None:
        train = dataclasses.replace(train, iterations=iterations, seconds=None)
    if train.seconds is not None and not (math.isfinite(train.seconds) and train.seconds > 0):
        raise InputError(f"--seconds: expected more than 0, found {train.seconds}; give a time")
    check_count("--iterations", train.iterations)
    if seed is not None and not 0 <= seed < 2**63:
        raise InputError(f"--seed: expected 0 to 2^63 - 1, found {seed}; choose one of these")
    return dataclasses.replace(config, train=train, seed=config.seed if seed is None else seed)


def check_count(name: str, value: int | None, least: int = 1) -> None:
    """Refuse a number below the least one; None is fine."""
    if value is not None and value < least:
        raise InputError(f"{name}: expected at least {least}, found {value}; give a larger number")


def check_file(name: str, path: Path, extension: str) -> None:
    """Refuse, before the work, a file that could not be written after it."""
    if path.suffix.lower() != extension:
        raise InputError(
            f"{name} {path}: expected a name that ends in {extension}, found "
            f"{path.suffix or 'no extension'!r}; rename it to {path.stem}{extension}"
        )
    if not path.parent.is_dir():
        raise InputError(
            f"{name} {path}: expected an existing folder to write into, found none; create it first"
        )
    if path.is_dir():
        raise InputError(f"{name} {path}: expected a file name, found a folder; add a file name")
