"""What makes a training run cheap enough for a test."""

TINY = (
    "field.levels=2",
    "field.log2_size=8",
    "field.hidden=16",
    "field.prior_slope=0",
    "deform.hidden=16",
    "deform.log2_size=8",
    "train.rays=128",
    "train.patch=16",
    "train.lpips_start=0",
    "train.checkpoint_seconds=1000",
)
"""Entries of the configuration, as `--set` takes them."""
