"""What a report shows; the page is built from this alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from .video import Image

Number = float | int


@dataclass(frozen=True)
class Headline:
    """A number at the top of the page."""

    label: str
    """What it is, such as "PSNR, novel view"."""
    value: Number | str | None
    """A number (shown with four digits), a text as it is, or None: "not measured"."""
    unit: str = ""
    """Such as "dB"."""
    note: str = ""
    """Small line below, such as "full image, strict"."""


@dataclass(frozen=True)
class Triple:
    """A held-out image beside its render."""

    label: str
    """Such as "camera B2, frame 30"."""
    split: str
    """Such as "novel_view"."""
    rendered: Image | None
    """H W 3, float in [0, 1] or uint8; None is said in words."""
    truth: Image | None
    """H W 3, the same size."""
    scores: Mapping[str, Number | None] = field(default_factory=dict)
    """psnr, ssim, lpips of this image; None: not computed."""
    note: str = ""
    """A remark, or why an image is missing."""


@dataclass(frozen=True)
class WorstFrame:
    """One of the worst images of a split."""

    label: str
    """Such as "camera B2, frame 30"."""
    split: str
    """Such as "novel_view"."""
    image: Image
    """Rendered, truth and difference in a row, uint8."""
    scores: Mapping[str, Number | None] = field(default_factory=dict)
    """psnr, ssim, lpips of this image; None: not computed."""


@dataclass(frozen=True)
class Timings:
    """What the run cost."""

    stages: Mapping[str, Number] = field(default_factory=dict)
    """Seconds per stage in order; the one named "training" is our time beside the peers."""
    seconds_per_iteration: Number | None = None
    """Median wall-clock seconds of a training iteration."""
    render_seconds_per_frame: Number | None = None
    """Wall-clock seconds to render one frame."""
    peak_memory_bytes: int | None = None
    """Largest resident memory of the process."""
    note: str = ""
    """How it was measured."""


@dataclass(frozen=True)
class SkipRow:
    """What skipping saved, for one kind of work."""

    what: str
    """Such as "samples" or "part evaluations"."""
    dense: int | None
    """How many there are without skipping."""
    kept: int | None
    """How many were evaluated."""
    note: str = ""
    """Why the rest does not change the image."""


@dataclass(frozen=True)
class ReferenceRow:
    """A published or measured figure of another method, beside ours."""

    name: str
    """Method."""
    psnr: Number | None = None
    """dB."""
    ssim: Number | None = None
    """In [0, 1]."""
    lpips: Number | None = None
    """LPIPS-VGG, not times 1000."""
    seconds: Number | None = None
    """Training time."""
    split: str = "novel_view"
    """Split that it is comparable with."""
    protocol: str = "strict"
    """Protocol that it is comparable with."""
    region: str = "full"
    """Region that it is comparable with."""
    note: str = ""
    """Source and hardware."""


@dataclass(frozen=True)
class ReportData:
    """Everything on the page. Only `title` is needed; what is missing is said in words."""

    title: str
    """Heading, such as the name of the capture."""
    capture: Mapping[str, Any] = field(default_factory=dict)
    """Facts on the capture: name → value."""
    headline: Sequence[Headline] = ()
    """Numbers at the top; three to six look best."""
    curves: Sequence[Mapping[str, Any]] = ()
    """Rows of train.jsonl: iteration, seconds, losses {name: value}, psnr, optional val_psnr."""
    round_trips: Sequence[Mapping[str, Any]] = ()
    """Of a training.json: round-trip distances at some moments of the training."""
    capacity: Sequence[Mapping[str, Any]] = ()
    """Of a training.json: the size of each part's field."""
    metrics: Mapping[str, Mapping[str, Mapping[str, Mapping[str, Number | None]]]] = field(
        default_factory=dict
    )
    """metrics.json: {split: {protocol: {region: {"psnr", "ssim", "lpips"}}}}."""
    triples: Sequence[Triple] = ()
    """Held-out images."""
    worst: Sequence[WorstFrame] = ()
    """The worst images of each split, the worst first."""
    turntable: Sequence[Image] = ()
    """Frames of one turn, of one size; 6 to 12 look best."""
    timings: Timings = field(default_factory=Timings)
    """What the run cost."""
    skipping: Sequence[SkipRow] = ()
    """What was skipped."""
    config: Mapping[str, Any] = field(default_factory=dict)
    """The resolved configuration, nested."""
    environment: Mapping[str, Any] = field(default_factory=dict)
    """From `environment_facts`."""
    warnings: Sequence[str] = ()
    """What went wrong; shown first."""
    references: Sequence[ReferenceRow] = ()
    """Other methods."""
    error_gain: Number = 4
    """The error maps reach their brightest colour at a difference of 1 / error_gain."""
