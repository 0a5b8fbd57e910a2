"""Sizes of the part fields from the configuration."""

from collections.abc import Sequence

from monopart.fields.irradiance import NUM_IRRADIANCE
from monopart.fields.part_field import PartFieldSpec
from monopart.geometry.errors import InputError

from .appearance import feature_width
from .config import AppearanceConfig, FieldConfig, GeometryConfig


def field_spec(
    spec: FieldConfig,
    parts: int,
    appearance: AppearanceConfig | None = None,
    lit: bool = False,
) -> PartFieldSpec:
    """Sizes of the part fields.

    Args:
        spec: the configuration.
        parts: number of parts.
        appearance: decides the length of the appearance feature of a sample; None has none.
        lit: whether the colour sees how light falls.

    Raises:
        InputError: capacities of another number of parts.
    """
    _check("field.part_log2_size", spec.part_log2_size, parts)
    _check("field.part_finest", spec.part_finest, parts)
    return PartFieldSpec(
        levels=spec.levels,
        features=spec.features,
        log2_size=spec.part_log2_size or spec.log2_size,
        base=spec.base,
        finest=spec.part_finest or spec.finest,
        hidden=spec.hidden,
        geometry=spec.geometry_features,
        code=0 if appearance is None else feature_width(appearance),
        light=NUM_IRRADIANCE if lit else 0,
        density_code=appearance is not None and appearance.density_sees_fusion,
        sharpness=spec.sharpness,
    )


def part_radii(spec: GeometryConfig, parts: int) -> tuple[float, ...]:
    """How far each part reaches from its surface, metres.

    Args:
        spec: the configuration.
        parts: number of parts.

    Raises:
        InputError: radii of another number of parts.
    """
    _check("geometry.part_radius", spec.part_radius, parts)
    return spec.part_radius or (spec.radius,) * parts


def _check(name: str, values: Sequence[int | float], parts: int) -> None:
    if values and len(values) != parts:
        raise InputError(
            f"{name}: expected {parts} numbers, one per part, found {len(values)}; leave it out"
        )
