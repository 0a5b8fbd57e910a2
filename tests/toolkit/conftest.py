"""Lets the tests of the toolkit import what they share: `from miniature import write_miniature`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
