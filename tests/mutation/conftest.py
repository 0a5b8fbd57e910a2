"""Lets the tests here import what they test: `from mutants import MUTANTS`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
