"""Geometry that takes long to build and is the same for every run: through the cache of the user.

The geometry itself knows nothing of files: it takes finished tensors as arguments.
"""

from importlib import metadata
from pathlib import Path

import torch
from jaxtyping import Float, Int, Integer
from torch import Tensor

from monopart.fields import distance_prior as prior_code
from monopart.fields.distance_prior import DistancePrior
from monopart.geometry import culling as shell_code
from monopart.geometry.body import BodyModel, PosedBody
from monopart.geometry.culling import BodyShell
from monopart.geometry.parts import PartMap

from .cache import NO_CACHE, Cache, Tensors
from .config import GeometryConfig
from .sizes import part_radii

REACH, CELL = 0.12, 0.01
"""Distance beyond which the prior is constant, and the edge of its cells, metres."""


def distance_prior(
    verts: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], cache: Cache = NO_CACHE
) -> DistancePrior:
    """The signed distance to the canonical body on a grid.

    Args:
        verts: canonical vertices, metres.
        faces: triangles.
        cache: where the grid is kept.

    Returns:
        The prior.
    """

    def unpack(tensors: Tensors) -> DistancePrior:
        values = tensors["values"].to(verts.device)
        return DistancePrior(verts, faces, REACH, CELL, values)

    return cache.fetch(
        "prior",
        (verts, faces, REACH, CELL, *_code(verts), prior_code),
        lambda: DistancePrior(verts, faces, REACH, CELL),
        lambda prior: {"values": prior.values[0, 0].cpu()},
        unpack,
    )


def body_shell(
    body: BodyModel,
    posed: PosedBody,
    table: PartMap,
    spec: GeometryConfig,
    cache: Cache = NO_CACHE,
) -> BodyShell:
    """The voxels near the surfaces of posed bodies.

    Args:
        body: the body model.
        posed: the bodies, metres.
        table: the part of each joint.
        spec: radius of the shell and edge of its voxels.
        cache: where the voxels are kept.

    Returns:
        The shell.
    """
    verts = posed.verts.detach().reshape(-1, body.num_verts, 3).float()
    faces = body.faces.to(verts.device)
    owner = table.face_parts(body.weights, body.faces).to(verts.device)
    radius = torch.tensor(part_radii(spec, table.num_parts), device=verts.device)

    def build(grid: Tensor | None = None) -> BodyShell:
        return BodyShell(verts, faces, radius, owner, spec.voxel, grid)

    return cache.fetch(
        "shell",
        (verts, faces, owner, radius, spec.voxel, *_code(verts)),
        build,
        lambda shell: {"bits": narrowed(shell.grid, table.num_parts).cpu()},
        lambda tensors: build(tensors["bits"].to(verts.device).int()),
    )


def narrowed(bits: Integer[Tensor, "n"], width: int) -> Integer[Tensor, "n"]:
    """Bit sets in the smallest whole numbers that hold them.

    Args:
        bits: the sets.
        width: number of bits in use.

    Returns:
        The same numbers.
    """
    if width <= 8:
        return bits.to(torch.uint8)
    return bits.to(torch.int16) if width < 16 else bits


def geometry_sources() -> list[Path]:
    """Source files of the geometry: all of them, for a list by hand misses what is added later.

    Returns:
        The files, in the order of their names.
    """
    return sorted(Path(shell_code.__file__).parent.rglob("*.py"))


def _code(like: Tensor) -> tuple:
    """What computes geometry: code and library, and the kind of machine."""
    return geometry_sources(), metadata.version("warp-lang"), like.device.type
