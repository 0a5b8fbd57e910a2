"""Canary: the shape contracts are on while the suite runs."""

import pytest
import torch

from monopart.fields.part_union import union_by_density
from monopart.geometry.rotations import axis_angle_to_rotmat
from monopart.geometry.skinning import blend_transforms, skin

REFUSED = "Type-check error"


def test_last_axis_is_checked() -> None:
    with pytest.raises(Exception, match=REFUSED):
        axis_angle_to_rotmat(torch.zeros(5, 4))


def test_sizes_are_bound_across_arguments() -> None:
    with pytest.raises(Exception, match=REFUSED):
        blend_transforms(torch.eye(4).expand(3, 4, 4), torch.ones(5, 2) / 2)
    with pytest.raises(Exception, match=REFUSED):
        skin(torch.zeros(5, 3), torch.eye(4).expand(6, 4, 4))


def test_types_are_checked() -> None:
    with pytest.raises(Exception, match=REFUSED):
        axis_angle_to_rotmat([0.0, 0.0, 0.0])  # pyright: ignore[reportArgumentType]
    with pytest.raises(Exception, match=REFUSED):
        axis_angle_to_rotmat(torch.zeros(3, dtype=torch.int64))


def test_fields_are_checked_too() -> None:
    with pytest.raises(Exception, match=REFUSED):
        union_by_density(torch.zeros(3), torch.zeros(2).long(), torch.zeros(3).long(), 3, 1)
