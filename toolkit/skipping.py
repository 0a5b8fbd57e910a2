"""The kinds of work that rendering and training leave out, each with a switch."""

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

from monopart.geometry.errors import InputError

PRUNE = 2e-3  # absorption of a step below which a canonical cell counts as empty in training


@dataclass(frozen=True)
class Skipping:
    """What is left out; all of it by default.

    All but `light` (within 5e-5 of full scale) and `cells` (learned, approximate) are exact.
    """

    box: bool = True
    """rays outside the screen box of the body shell"""
    shell: bool = True
    """rays of that box that miss the body shell"""
    voxels: bool = True
    """samples in voxels that no part reaches"""
    parts: bool = True
    """searches of parts that do not reach the voxel of a sample"""
    light: bool = True
    """samples behind a front that leaves less than 5e-5 of the light"""
    colors: bool = True
    """colours of pairs that are not the densest of their sample"""
    cells: bool = True
    """cells that training has seen empty or hidden, where the caller allows that"""

    def without(self, kinds: Iterable[str]) -> "Skipping":
        """The same with some kinds switched off.

        Args:
            kinds: names of kinds.

        Raises:
            InputError: no kind of that name.
        """
        names = tuple(kinds)
        for name in names:
            if name not in KINDS:
                raise InputError(
                    f"--no-skip: expected {', '.join(KINDS)}, found {name!r}; choose some of these"
                )
        return dataclasses.replace(self, **dict.fromkeys(names, False))


KINDS = tuple(f.name for f in dataclasses.fields(Skipping))
EVERY = Skipping()
NONE = EVERY.without(KINDS)
