"""Lets the tests of the tools import what they share: `from mesh_samples import tube`."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(autouse=True)
def _no_plain_progress(monkeypatch):
    """On a busy machine even small work takes the ten seconds after which a line is printed."""
    monkeypatch.setattr("monopart.tools.progress.PLAIN_EVERY", 1e9)
