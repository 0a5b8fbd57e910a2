"""``monopart-bench scaling``: how the cost of a step and of a picture grows with the work.

An untrained avatar of the free body is enough: the work per ray does not depend on the colours.
"""

import dataclasses
import math
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.cameras import Camera, Rays
from monopart.geometry.parts import PartMap
from monopart.geometry.posed_parts import PosedParts

from .bodies import pose_list
from .meshes import subdivided
from .registry import Method, Operation, Problem, Settings
from .results import Report, Table, summarise
from .scaling_geometry import geometry_axes
from .timing import with_threads

RAYS = 2048


@dataclass(eq=False)
class StepData:
    """Rays of posed bodies, and an avatar to see them with."""

    model: Any
    parts: PosedParts
    inputs: Any
    rays: Rays
    owner: Tensor
    threads: int


@dataclass(frozen=True)
class Work:
    """What a problem of the suite is made of."""

    rays: int = RAYS
    """Rays that hit the shell."""
    step: float = 0.0125
    """Distance of the samples, metres."""
    frames: int = 4
    """Posed bodies over which the rays are spread."""
    parts: str = "five"
    """Table of parts."""
    levels: int = 0
    """Times the mesh is subdivided."""
    threads: int = 0
    """Threads; 0 leaves them as they are."""
    prior: bool = True
    """With the distance prior, which takes seconds to tabulate."""


def step_data(body: BodyModel, work: Work) -> StepData:
    """Pose the bodies, make an untrained avatar and pick rays that hit the shells."""
    from monopart.toolkit.model import AvatarModel, FrameInput
    from monopart.toolkit.presets import preset, with_overrides

    field = {} if work.prior else {"prior_slope": 0.0}
    geometry = {"step": work.step, "parts": work.parts}
    config = with_overrides(preset("fast"), geometry=geometry, field=field)
    poses = [pose for _, pose in pose_list(body, max(work.frames, 2))][: work.frames]
    batch = BodyPose(
        *(torch.stack([getattr(p, f.name) for p in poses]) for f in dataclasses.fields(BodyPose))
    )
    torch.manual_seed(0)
    with torch.no_grad():
        posed, canonical = body(batch), body.canonical(torch.zeros(body.num_betas))
    table = PartMap.preset(config.geometry.parts, body.num_joints)
    parts = PosedParts(body, posed, canonical, table, config.geometry.radius)
    model = AvatarModel(config, body, canonical, work.frames)
    inputs = FrameInput(torch.linspace(0, 1, work.frames), model.codes)
    owner = torch.arange(work.rays) % work.frames
    rays = _rays(parts, owner, work.rays)
    return StepData(model, parts, inputs, rays, owner, work.threads)


def _rays(parts: PosedParts, owner: Tensor, count: int) -> Rays:
    """Random pixels of a camera in front that hit the shell of their body."""
    size = (512, 512)
    eye, target = torch.tensor([0.0, 0.0, 3.0]), torch.zeros(3)
    camera = Camera.look_at(eye, target, torch.tensor([0.0, 1.0, 0.0]), size, fov=math.radians(45))
    generator = torch.Generator().manual_seed(11)
    origins, directions = torch.zeros(2, count, 3).unbind(0)
    missing = torch.arange(count)
    for _ in range(100):
        pixels = torch.rand(len(missing), 2, generator=generator) * size[0]
        rays = camera.rays(pixels)
        hit = parts.shell.intervals(rays, owner[missing])[2]
        origins[missing[hit]] = rays.origins.expand_as(rays.directions)[hit]
        directions[missing[hit]] = rays.directions[hit]
        missing = missing[~hit]
        if len(missing) == 0:
            break
    directions[missing] = torch.tensor([0.0, 0.0, 1.0])  # away from the bodies: costs nothing
    return Rays(origins, directions)


def _render(data: StepData) -> Callable[[], dict[str, int]]:
    def call() -> dict[str, int]:
        data.model.eval()
        with torch.no_grad():
            return data.model.render_rays(data.parts, data.inputs, data.rays, data.owner).stats

    return with_threads(data.threads, call)


def _train(data: StepData) -> Callable[[], dict[str, int]]:
    parameters = list(data.model.parameters())

    def call() -> dict[str, int]:
        data.model.train()
        out = data.model.render_rays(data.parts, data.inputs, data.rays, data.owner)
        loss = (out.color - 0.5).square().mean()
        torch.autograd.grad(loss, parameters, allow_unused=True)
        return out.stats

    return with_threads(data.threads, call)


def _judge(data: StepData, stats: dict[str, int]) -> dict[str, float]:
    return {
        "samples": float(stats["samples_shell"]),
        "pairs": float(stats["pairs_evaluated"]),
    }


def _axis(
    values: tuple[Any, ...], quick: tuple[Any, ...], make: Callable[[Any], tuple[int, str, Work]]
) -> Callable[[Settings], Iterator[Problem]]:
    """Problems of one axis; the body is subdivided as often as the work says."""

    def problems(settings: Settings) -> Iterator[Problem]:
        for value in quick if settings.quick else values:
            size, label, work = make(value)
            if settings.quick:
                work = dataclasses.replace(work, rays=min(work.rays, 64), prior=False)
            body = BodyModel.default()
            for _ in range(work.levels):
                body = subdivided(body)
            size = body.num_verts if label == "vertices" else size
            yield Problem(size, label, step_data(body, work))

    return problems


def _threads() -> tuple[int, ...]:
    cores = os.cpu_count() or 1
    return tuple(n for n in (1, 2, 4, 8, 16, 32) if n <= cores)


def operations() -> tuple[Operation, ...]:
    """One operation per axis."""
    methods = (
        Method("training step (forward, backward)", _train, ours=True),
        Method("rendering", _render, ours=True),
    )
    axes = (
        ("rays", _axis((256, 1024, 4096, 16384), (16, 32), lambda n: (n, "rays", Work(rays=n)))),
        (
            "samples",
            _axis(
                (1, 2, 4, 8),
                (1, 2),
                lambda n: (n, "samples per 2.5 cm", Work(rays=1024, step=0.025 / n)),
            ),
        ),
        ("frames", _axis((1, 4, 16, 64), (1, 2), lambda n: (n, "frames", Work(frames=n)))),
        (
            "parts",
            _axis(
                ("single", "three", "five", "six", "per_limb"),
                ("single", "five"),
                lambda name: (len(PartMap.preset(name, 24).names), "parts", Work(parts=name)),
            ),
        ),
        ("vertices", _axis((0, 1, 2), (0,), lambda n: (n, "vertices", Work(levels=n)))),
        ("threads", _axis(_threads(), (1,), lambda n: (n, "threads", Work(threads=n)))),
    )
    steps = tuple(
        Operation(f"scaling_{name}", f"Time against {name}", "none", methods, problems, _judge)
        for name, problems in axes
    )
    return steps + geometry_axes()


def exponents(table: Table) -> list[str]:
    """Growth as a power of the size, one sentence per method: over all, and over the last step.

    Time ~ size^p; p = 1 is linear, 0 is flat.
    """
    lines: dict[str, list[tuple[int, float]]] = {}
    for summary in summarise(table):
        lines.setdefault(summary.method, []).append((summary.size, summary.wall))
    result = []
    for method, points in lines.items():
        if len(points) < 2:
            continue
        whole, last = _power(points[0], points[-1]), _power(points[-2], points[-1])
        ends = f"from {points[0][0]} to {points[-1][0]}"
        end = f", size^{last:.2f} in the last step" if len(points) > 2 else ""
        result.append(f"{method}: time ~ size^{whole:.2f} {ends}{end}")
    return result


def _power(a: tuple[int, float], b: tuple[int, float]) -> float:
    return math.log(b[1] / a[1]) / math.log(b[0] / a[0])


def with_exponents(report: Report) -> Report:
    """The report with the growth of every table among its notes."""
    tables = [dataclasses.replace(t, notes=[*t.notes, *exponents(t)]) for t in report.tables]
    return dataclasses.replace(report, tables=tables)
