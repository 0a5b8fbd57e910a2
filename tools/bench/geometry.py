"""``monopart-bench geometry``: every geometric operation, method by method, time against error."""

from collections.abc import Iterator

import torch

from monopart.geometry.body import BodyModel

from .bodies import joint_limits, pose_list, surface_data
from .registry import Operation, Problem, Settings
from .rotation_methods import (
    LENSES,
    judge_lens,
    judge_matrix,
    judge_vector,
    lens_data,
    lens_methods,
    rotation_data,
    to_matrix_methods,
    to_vector_methods,
)
from .skinning_methods import SkinningData, judge_skinning, skinning_methods
from .surface_methods import judge_nearest, judge_surface, nearest_methods, surface_methods
from .timing import Effort
from .unskin_methods import judge_unskin, unskin_methods

POINTS = 32_768
SIZES = (1_000, 10_000, 100_000, 1_000_000)
MANY = Effort(rounds=5, least=2, seconds=0.5)
"""For each of many poses."""
THREE = Effort(rounds=7, least=2, seconds=2.0)
"""For each of three poses."""
LARGE = Effort(rounds=3, least=2, seconds=2.0)
"""For a million points."""


def _thorough(number: int, count: int) -> bool:
    """The first, the middle and the last of some poses: those that slow methods run on."""
    return number in (0, count // 2, count - 1)


def _near_surface(settings: Settings) -> Iterator[Problem]:
    """All poses at one size, then all sizes at a pose half-way."""
    body = BodyModel.default()
    poses = pose_list(body, 2 if settings.quick else settings.poses, settings.capture)
    count = 32 if settings.quick else POINTS
    for seed, (name, pose) in enumerate(poses):
        slow = _thorough(seed, len(poses))
        yield Problem(count, name, surface_data(body, pose, count, seed), MANY, slow)
    for size in (16,) if settings.quick else SIZES:
        name, pose = poses[len(poses) // 2]
        effort = LARGE if size == max(SIZES) else None
        yield Problem(size, name, surface_data(body, pose, size), effort)


def _one_size(settings: Settings) -> Iterator[Problem]:
    """Three poses at one size."""
    body = BodyModel.default()
    poses = pose_list(body, 3, settings.capture)
    count = 32 if settings.quick else POINTS
    for seed, (name, pose) in enumerate(poses[:1] if settings.quick else poses):
        yield Problem(count, name, surface_data(body, pose, count, seed), THREE)


def _poses_only(settings: Settings) -> Iterator[Problem]:
    body = BodyModel.default()
    poses = pose_list(body, 2 if settings.quick else settings.poses, settings.capture)
    count = 32 if settings.quick else POINTS
    for seed, (name, pose) in enumerate(poses):
        slow = _thorough(seed, len(poses))
        yield Problem(count, name, surface_data(body, pose, count, seed), MANY, slow)


def _skinning(settings: Settings) -> Iterator[Problem]:
    body = BodyModel.default()
    if settings.quick:
        yield Problem(2, "forward", _batch(body, 2, False))
        yield Problem(2, "forward + backward", _batch(body, 2, True))
        return
    for count in (1, 64):
        yield Problem(count, "forward", _batch(body, count, False))
    yield Problem(64, "forward + backward", _batch(body, 64, True))


def _forward(settings: Settings) -> Iterator[Problem]:
    return (p for p in _skinning(settings) if p.setting == "forward")


def _both(settings: Settings) -> Iterator[Problem]:
    return (p for p in _skinning(settings) if p.setting != "forward")


def _batch(body: BodyModel, count: int, backward: bool) -> SkinningData:
    generator = torch.Generator().manual_seed(3)
    unit = 2 * torch.rand(count, body.num_joints, 3, generator=generator) - 1
    betas = 0.5 * torch.randn(count, body.num_betas, generator=generator)
    return SkinningData(body, unit * joint_limits(body), betas, backward)


def _rotations(settings: Settings) -> Iterator[Problem]:
    for count in (200,) if settings.quick else (1_000, 100_000):
        yield Problem(count, "random", rotation_data(count))


def _lenses(settings: Settings) -> Iterator[Problem]:
    edge = 16 if settings.quick else 512
    for name in LENSES:
        yield Problem(edge * edge, name, lens_data(name, edge))


_GAP = "largest distance beyond the exact one, m (float64 oracle)"
_LBS_NOTE = (
    "The free body has no pose blend shapes; ours skips the zero matrix exactly, the others "
    "multiply by it."
)


def operations() -> tuple[Operation, ...]:
    """All operations of the geometry suite."""
    return (
        Operation(
            *("surface", "Closest surface point with barycentrics", _GAP),
            *(surface_methods(), _near_surface, judge_surface),
            ("Points within 3 cm of the posed body; the structure exists already.",),
        ),
        Operation(
            *(
                "surface_moving",
                "Closest surface point after moving the mesh: update and query",
                _GAP,
            ),
            *(surface_methods(moving=True), _one_size, judge_surface),
            ("Ours and Warp refit their tree; the others build anew.",),
        ),
        Operation(
            *("nearest", "Nearest vertex in place of the closest surface point"),
            "mean distance beyond the exact closest surface point, m",
            *(nearest_methods(), _one_size, judge_nearest),
            ("weights p99: total variation of the skinning weights, 99th percentile.",),
        ),
        Operation(
            *("unskin", "Inverse skinning"),
            "95th percentile of the cycle error, m (float64 closest-surface weights at rest)",
            *(unskin_methods(), _poses_only, judge_unskin),
            ("share: points with a cycle error of at most 1 mm, percent.",),
        ),
        Operation(
            *("skinning", "Linear blend skinning, forward", "largest vertex error, m"),
            *(skinning_methods(), _forward, judge_skinning),
            (_LBS_NOTE,),
        ),
        Operation(
            *("skinning_backward", "Linear blend skinning, forward and backward"),
            "largest vertex error, m",
            *(skinning_methods(), _both, judge_skinning),
            (_LBS_NOTE,),
        ),
        Operation(
            *("to_matrix", "Axis-angle to rotation matrix", "largest entry, float64 oracle"),
            *(to_matrix_methods(), _rotations, judge_matrix),
        ),
        Operation(
            *("to_vector", "Rotation matrix to axis-angle", "largest entry, float64 oracle"),
            *(to_vector_methods(), _rotations, judge_vector),
        ),
        Operation(
            *("undistort", "Undistortion of all pixels (float64)"),
            "largest reprojection error, pixels",
            *(lens_methods(), _lenses, judge_lens),
            ("Ours returns unit rays, divided here; pixels beyond the fold are left out.",),
        ),
    )
