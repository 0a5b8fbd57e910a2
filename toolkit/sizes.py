"""Sizes of the part fields from the configuration."""

from monopart.fields.irradiance import NUM_IRRADIANCE
from monopart.fields.part_field import PartFieldSpec
from monopart.geometry.errors import InputError

from .appearance import feature_width
from .config import AppearanceConfig, FieldConfig


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
    for name, values in (("log2_size", spec.part_log2_size), ("finest", spec.part_finest)):
        if values and len(values) != parts:
            raise InputError(
                f"field.part_{name}: expected {parts} numbers, one per part, found {len(values)}; "
                "leave it out"
            )
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
