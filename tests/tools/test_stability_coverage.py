"""Every public operation of geometry and fields is stressed, or exempt for a stated reason."""

import sys
from collections import defaultdict
from types import CodeType, FrameType
from typing import Any

import pytest
import torch

from monopart.tools.bench.stability import stresses
from monopart.tools.bench.stability_cases import Stress
from monopart.tools.bench.stability_coverage import COVERED, EXEMPT, code_of, operations

BY_NAME = {stress.name: stress for own in stresses().values() for stress in own}
PUBLIC = operations()
CLAIMS = defaultdict(list)
for operation, name in COVERED.items():
    CLAIMS[name].append(operation)


def test_every_public_operation_is_stressed_or_exempt() -> None:
    public = set(PUBLIC)
    assert len(public) > 100
    unknown = public - set(COVERED) - set(EXEMPT)
    assert not unknown, f"neither stressed nor exempt: {sorted(unknown)}; see stability_coverage.py"
    assert not (set(COVERED) | set(EXEMPT)) - public, "names that are no longer public operations"
    assert not set(COVERED) & set(EXEMPT)
    assert all(len(reason) > 8 for reason in EXEMPT.values())
    assert set(COVERED.values()) <= set(BY_NAME)
    assert len(EXEMPT) < len(COVERED) / 2


def _called(stress: Stress) -> set[CodeType]:
    """What our ways of a stress call, on one family each."""
    seen: set[CodeType] = set()

    def look(frame: FrameType, event: str, argument: Any) -> None:
        if event == "call":
            seen.add(frame.f_code)

    for way in stress.ways:
        if not way.ours:
            continue
        for family in [f for f in stress.families if not f.large and way.serves(f)]:
            inputs = family.make(torch.Generator().manual_seed(0), min(8, family.cases or 8))
            inputs = tuple(x.to(way.dtypes[0]) for x in inputs)
            before = sys.getprofile()
            sys.setprofile(look)
            try:
                way.run(family.extra, *inputs)
            finally:
                sys.setprofile(before)
            if _told(stress.name, seen):
                return seen
    return seen


def _told(name: str, seen: set[CodeType]) -> bool:
    return all(code_of(PUBLIC[o]) in seen for o in CLAIMS[name])


@pytest.mark.parametrize("name", sorted(CLAIMS))
def test_a_stress_calls_what_it_is_said_to_measure(name: str) -> None:
    seen = _called(BY_NAME[name])
    missing = [o for o in CLAIMS[name] if code_of(PUBLIC[o]) not in seen]
    assert not missing, f"{name} never calls {missing}"


def test_a_call_that_is_not_made_is_noticed() -> None:
    seen = _called(BY_NAME["rays_at"])
    assert code_of(PUBLIC["Rays.at"]) in seen
    assert code_of(PUBLIC["Camera.project"]) not in seen
