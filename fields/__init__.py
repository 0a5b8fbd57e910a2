"""Neural fields over body geometry.

Every public name can be imported from here or from its room; the rooms load on first use, so
importing this package costs nothing and has no effects.
"""

if __name__ != "monopart.fields":  # a bare import would copy every class
    raise ImportError(f"import monopart.fields, not {__name__!r}")

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .distance_prior import DistancePrior as DistancePrior
    from .frequency import FrequencyEncoding as FrequencyEncoding
    from .fusion import CodeFusion as CodeFusion
    from .hash_grid import GridSpec as GridSpec
    from .hash_grid import HashGrid as HashGrid
    from .irradiance import irradiance_basis as irradiance_basis
    from .mlp import PartMLP as PartMLP
    from .occupancy import PartOccupancy as PartOccupancy
    from .part_field import PartField as PartField
    from .part_field import PartFieldSpec as PartFieldSpec
    from .part_union import Union as Union
    from .part_union import union_by_density as union_by_density
    from .pose_bank import PoseBank as PoseBank
    from .residual import ResidualField as ResidualField
    from .row_adam import RowAdam as RowAdam
    from .splats import Gaussians as Gaussians
    from .splats import Splats as Splats
    from .splats import project_gaussians as project_gaussians
    from .splats import render_gaussians as render_gaussians
    from .volume import composite as composite

_ROOM = {
    "CodeFusion": "fusion",
    "DistancePrior": "distance_prior",
    "FrequencyEncoding": "frequency",
    "Gaussians": "splats",
    "GridSpec": "hash_grid",
    "HashGrid": "hash_grid",
    "PartField": "part_field",
    "PartFieldSpec": "part_field",
    "PartMLP": "mlp",
    "PartOccupancy": "occupancy",
    "PoseBank": "pose_bank",
    "ResidualField": "residual",
    "RowAdam": "row_adam",
    "Splats": "splats",
    "Union": "part_union",
    "composite": "volume",
    "irradiance_basis": "irradiance",
    "project_gaussians": "splats",
    "render_gaussians": "splats",
    "union_by_density": "part_union",
}
__all__ = list(_ROOM)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name not in _ROOM:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_ROOM[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_ROOM})
