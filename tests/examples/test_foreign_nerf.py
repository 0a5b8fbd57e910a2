"""The loss of ours in a method that is not."""

import pytest
from foreign_nerf import train


@pytest.mark.slow
def test_our_loss_binds_a_foreign_warp() -> None:
    """Colours are learned with it and without it; only with it the warp can be undone."""
    errors, gaps = train(weight=0.03, steps=200)
    free_errors, free_gaps = train(weight=0.0, steps=200)
    assert errors[-1] < 0.2 * errors[0]
    assert free_errors[-1] < 0.2 * free_errors[0]
    assert gaps[-1] < 0.05  # metres, in a block of one metre
    assert gaps[-1] < 0.1 * free_gaps[-1]
