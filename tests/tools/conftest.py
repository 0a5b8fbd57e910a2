"""Lets the tests of the tools import what they share: `from mesh_samples import tube`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
