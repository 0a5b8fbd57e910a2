"""The configuration of a run: frozen, written as JSON beside it and read back strictly."""

import dataclasses
import json
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from monopart.geometry.errors import InputError


@dataclass(frozen=True)
class GeometryConfig:
    """Body geometry."""

    parts: Literal["five", "three", "six", "per_limb", "single"] = "five"
    """Table of parts (METHOD section 2)."""
    radius: float = 0.06
    """Largest distance of a sample from the surface of a part that it belongs to, metres."""
    reach: Literal["radius", "masks"] = "radius"
    """How far the parts reach: as the radius says, or as far as the masks of the training frames
    stand out from the body, where that is more (up to twice the radius)."""
    part_radius: tuple[float, ...] = ()
    """Radius of each part, metres; filled in from the masks."""
    voxel: float = 0.02
    """Edge of the shell's voxels, metres; changes the speed, never the image."""
    step: float = 0.0125
    """Distance of neighbouring samples of a ray, metres (delta t of eq. 9)."""
    canonical_margin: float = 0.08
    """Margin of a part's canonical box around its vertices, metres."""


@dataclass(frozen=True)
class FieldConfig:
    """Part fields (METHOD section 6)."""

    levels: int = 8
    """Resolutions of the hash grid."""
    features: int = 2
    """Features per level: 1, 2 or 4."""
    log2_size: int = 15
    """Rows of a level, log2."""
    base: int = 16
    """Cells of the first level along the longest edge of a part's box."""
    finest: float = 0.003
    """Edge of the finest cells, metres."""
    hidden: int = 64
    """Width of the density and colour networks."""
    geometry_features: int = 15
    """Features handed from the density to the colour network."""
    sharpness: float = 100.0
    """Density in 1/m per unit of softplus."""
    prior_slope: float = 200.0
    """Slope k of the distance prior, 1/m; 0 leaves the density to the network."""
    prior_margin: float = 0.015
    """Distance outside the body at which the prior is neutral, metres."""
    allocation: Literal["data", "uniform"] = "uniform"
    """Capacity of the parts: from what the training frames show of each, or the same for all."""
    part_log2_size: tuple[int, ...] = ()
    """Rows of a level of each part, log2; filled in by the allocation from data."""
    part_finest: tuple[float, ...] = ()
    """Edge of the finest cells of each part, metres; filled in by the allocation from data."""
    use_step: bool = True
    """Opacity 1 - exp(-density x step) of a sample (eq. 9); off, 1 - exp(-density)."""


@dataclass(frozen=True)
class DeformConfig:
    """Non-rigid deformation (METHOD section 3)."""

    residual: bool = True
    """Backward residual; off, the deformation is skinning alone."""
    input: Literal["uvt", "xyzt"] = "uvt"
    """What the residuals depend on: surface point and time, or place in a part's box and time."""
    scale: float = 0.05
    """Largest residual per axis, metres."""
    hidden: int = 32
    """Width of the residual networks."""
    log2_size: int = 14
    """Rows of a level of the (u, v, t) grid, log2."""
    time_span: float = 1.0
    """Part of the grid that the times of the training fill: less is smoother in time."""
    time_jitter: float = 0.0
    """Standard deviation of the noise on the times of a training step, in frames."""
    lr: float = 1.0
    """Factor of the learning rates of the residuals."""
    start: float = 0.0
    """Part of the run after which residuals begin: until then skinning alone, which costs less."""


@dataclass(frozen=True)
class AppearanceConfig:
    """Appearance of a frame (METHOD section 5)."""

    code: int = 8
    """Length of an appearance code (rgb_latent); 0 has none: one appearance for all frames."""
    pose_feature: bool = False
    """Part pose embedding: lines of the key poses, which are the training frames (eq. 5)."""
    knots: int = 128
    """Values along a line of the pose embedding."""
    channels: int = 8
    """Features of a line."""
    fusion: bool = True
    """Where there are pose features and codes: cross-attention over the codes of a part (eq. 6).
    Off, or where one is missing, what there is is fed directly, with one code per frame."""
    codes: int = 32
    """Codes of a part that the attention chooses from."""
    fused: int = 16
    """Length of the fused feature."""
    density_sees_fusion: bool = False
    """The density sees the same feature as the colour (eq. 7)."""
    lr: float = 0.1
    """Factor of the learning rate of the lines: a step shows little of one frame."""
    light: bool = True
    """The colour sees which way the surface below looks in the world: light stands still while the
    person turns."""
    light_out: float = 0.1
    """Share of training frames that a step lights as if nobody saw from which side: what surfaces
    look like, in the mean, where nobody did."""
    leave_out: float = 0.5
    """Share of training poses that are blended from their neighbours, like an unseen pose."""
    blend_time: bool = False
    """An unseen pose has the mean time of the nearest training poses; off, that of the nearest."""


@dataclass(frozen=True)
class LossConfig:
    """Weights and thresholds of the losses; a term of weight 0 is not computed."""

    mse: float = 1.0
    """Weight of the squared colour error (eq. 10)."""
    lpips: float = 0.1
    """Weight of LPIPS-VGG on patches (eq. 10)."""
    patch_pixels: float = 0.1
    """Weight of a pixel of a patch beside a random one in the colour errors: neighbours in one
    picture say less than pixels of all. Where there are no random ones it has no effect."""
    consistency: float = 1.0
    """Weight of the bidirectional consistency (eq. 3)."""
    consistency_threshold: float = 0.002
    """Round-trip distances below this cost nothing, metres; at larger ones frames are learned
    by heart."""
    consistency_samples: int = 1024
    """Pairs of a step whose round trip is computed."""
    offset: float = 0.0
    """Weight of the mean residual length, 1/m."""
    unseen: float = 0.0
    """Weight of the mean residual length at random places and times, which most pictures do not
    show, 1/m."""
    unseen_samples: int = 1024
    """Places of a step."""
    l1: float = 0.0
    """Weight of the absolute colour error."""
    distortion: float = 0.0
    """Weight of the spread of a ray's weights, 1/m; grows to ten times in the last third."""
    elastic: float = 0.0
    """Weight of the difference of residuals at neighbouring places, 1/m."""
    elastic_reach: float = 0.01
    """Standard deviation of the way to a neighbour, in units of the residual's input."""


@dataclass(frozen=True)
class RefineConfig:
    """Body-pose refinement (METHOD section 9), for captures whose poses are estimates."""

    poses: bool = False
    """Learn corrections of joint rotations, Rh and Th of every training frame."""
    shape: bool = False
    """Learn a correction of the shape too, one for all frames; needs `poses`."""
    frames: int = 12
    """Training frames that the random pixels of a step come from."""
    start: float = 0.02
    """Part of the run after which corrections begin."""
    rigid: float = 0.6
    """Part of the run without residuals, which would otherwise explain wrong poses."""
    align: int = 5
    """Gauss-Newton steps that align all poses with their pictures; from the first one on poses
    change by these alone, and a shape no more. 0: steps of the training learn them to its end."""
    align_start: float = 0.16
    """Part of the run before the first of these steps; the others follow evenly."""
    align_end: float = 0.5
    """Part of the run before the last of them."""
    align_size: int = 256
    """Largest side of the pictures in these steps, pixels."""
    evidence: float = 24.0
    """Independent differences of colour that a picture counts as in these steps, against the prior:
    what the avatar gets wrong is wrong in many pixels alike."""
    drift: float = 0.5
    """Slowness of the errors of the tracker: standard deviation of the Gaussian that smooths them
    in time, seconds (25 frames each where the capture has no rate); 0: frames are independent."""
    jitter: float = 0.25
    """Share of the variance of these errors that is independent between frames."""
    lr: float = 1e-3
    """Learning rate of rotations, radians; translations take 0.3 of it in metres."""
    prior: float = 4e-5
    """Weight of how unlikely the corrections are: their mean square with the drift undone, in units
    of 0.03 rad, 0.01 m and 1 of shape."""
    smooth: float = 0.0
    """Weight of the mean squared second difference of the corrections in time, same units."""
    opacity: float = 0.0
    """Weight of the squared difference of opacity and mask."""
    margin: float = 0.02
    """Movement of a body after which its shell is built anew, metres; never changes the image."""
    refit_steps: int = 3
    """Gauss-Newton steps by which the poses of frames that were not trained on are fitted at
    test."""


@dataclass(frozen=True)
class TrainConfig:
    """Optimisation and batches."""

    iterations: int = 1500
    """Steps; used when no time is given."""
    seconds: float | None = None
    """Budget of the loop, seconds; takes the place of `iterations`."""
    clock: Literal["wall", "cpu"] = "wall"
    """What `seconds` counts: time, or processor time, which other work on the machine leaves
    alone."""
    rays: int = 2048
    """Random pixels of a step, over all training frames."""
    patch: int = 64
    """Edge of the LPIPS patch, pixels."""
    lpips_start: float = 0.4
    """Part of the run after which patches begin."""
    lpips_every: int = 2
    """Steps between two patches."""
    band: int = 14
    """Pixels around the mask from which random pixels are drawn."""
    lr_table: float = 6e-2
    """Learning rate of the hash tables."""
    lr_network: float = 1e-2
    """Learning rate of networks and codes."""
    lr_final: float = 0.03
    """Factor of both rates at the end, reached exponentially."""
    sparse_optimizer: bool = False
    """Step only the rows of the hash tables that received a gradient (approximate); pays where
    `field.log2_size` is 19 or more."""
    ema: float = 0.98
    """Decay of the weights' moving average that is rendered and saved; 0 switches it off."""
    random_background: bool = True
    """Composite rendering and target over a random colour in training."""
    occupancy: bool = True
    """Learn which canonical cells are empty and skip them in training (approximate)."""
    deterministic: bool = False
    """On CUDA, sum gradients in one order, so that a seed repeats a run bit for bit; slower. The
    CPU always does."""
    max_skipped: int = 50
    """Steps that may be left out because a loss or a gradient was not finite; then a run ends."""
    checkpoint_seconds: float = 60.0
    """Wall-clock seconds between two saved checkpoints."""
    log_every: int = 20
    """Steps between two lines of train.jsonl."""
    ignore_band: int = 0
    """Pixels on either side of the edge of the mask that no loss sees."""
    scales: tuple[float, ...] = ()
    """Scale of the images in equal stretches of the run, such as 0.3,0.5,0.5; empty: full size."""
    head_focus: float = 0.0
    """Part of the pixels and patches of the middle third that is drawn at the head."""


@dataclass(frozen=True)
class Config:
    """Everything that decides a run."""

    preset: str = "fast"
    """Name of the preset this configuration started from."""
    seed: int = 0
    """Seed of initial values, batches and jitter."""
    geometry: GeometryConfig = dataclasses.field(default_factory=GeometryConfig)
    field: FieldConfig = dataclasses.field(default_factory=FieldConfig)
    deform: DeformConfig = dataclasses.field(default_factory=DeformConfig)
    appearance: AppearanceConfig = dataclasses.field(default_factory=AppearanceConfig)
    loss: LossConfig = dataclasses.field(default_factory=LossConfig)
    train: TrainConfig = dataclasses.field(default_factory=TrainConfig)
    refine: RefineConfig = dataclasses.field(default_factory=RefineConfig)


def to_json(config: Config) -> str:
    """The configuration as indented JSON."""
    return json.dumps(dataclasses.asdict(config), indent=2) + "\n"


def from_json(path: Path) -> Config:
    """Read a configuration back; unknown, missing or mistyped entries are errors.

    Args:
        path: a config.json.

    Raises:
        InputError: the file is absent, not JSON, or does not match.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: expected a run's config.json, found no file") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected JSON, found {error}; restore the file") from None
    return config_of(data, str(path))


def config_of(data: Any, where: str) -> Config:
    """The configuration that :func:`to_json` wrote, from its parsed JSON.

    Args:
        data: parsed JSON.
        where: what errors name.

    Raises:
        InputError: entries that are unknown, missing or mistyped.
    """
    return _build(Config, data, where)


def _build(kind: Any, data: Any, where: str) -> Any:
    if not isinstance(data, dict):
        raise InputError(f"{where}: expected an object, found {type(data).__name__}")
    fields = {f.name: f for f in dataclasses.fields(kind)}
    hints = typing.get_type_hints(kind)
    for name in data.keys() ^ fields.keys():
        found = "an unknown entry" if name in data else "no entry"
        raise InputError(f"{where}: {kind.__name__}.{name}: found {found}; use the same version")
    values = {}
    for name, value in data.items():
        hint = hints[name]
        if dataclasses.is_dataclass(hint):
            values[name] = _build(hint, value, where)
        else:
            values[name] = _checked(value, hint, f"{where}: {kind.__name__}.{name}")
    return kind(**values)


def _checked(value: Any, hint: Any, where: str) -> Any:
    choices = typing.get_args(hint)
    if typing.get_origin(hint) is tuple:
        if not isinstance(value, list):
            raise InputError(f"{where}: expected a list, found {value!r}; restore the file")
        return tuple(_checked(item, choices[0], where) for item in value)
    if typing.get_origin(hint) is Literal:
        good = value in choices
    else:
        kinds = choices or (hint,)
        number = float in kinds and isinstance(value, int) and not isinstance(value, bool)
        value = float(value) if number else value
        good = type(value) in kinds
    if not good:
        raise InputError(f"{where}: expected {hint}, found {value!r}; restore the file")
    return value
