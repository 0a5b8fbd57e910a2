"""The planted bugs still apply to the code, and the script judges what pytest says."""

from collections import Counter
from pathlib import Path

import mutate
import pytest
from building import ROOT
from mutants import ALLOWED_TO_SURVIVE, MUTANTS, Mutant


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda m: m.name)
def test_every_mutant_applies_and_compiles(mutant: Mutant) -> None:
    text = (ROOT / mutant.file).read_text(encoding="utf-8")
    changed = mutate.planted(mutant, text)
    assert changed != text
    compile(changed, mutant.file, "exec")
    assert mutant.tests
    assert all((ROOT / test).is_file() for test in mutant.tests)


def test_there_are_many_of_many_kinds() -> None:
    assert len(MUTANTS) >= 30 and ALLOWED_TO_SURVIVE <= 1
    assert len({m.name for m in MUTANTS}) == len(MUTANTS)
    rooms = Counter(m.file.split("/")[0] for m in MUTANTS)
    assert set(rooms) == {"geometry", "fields", "toolkit"} and min(rooms.values()) >= 8
    assert sum("/kernels/" in m.file for m in MUTANTS) >= 10
    assert len({m.kind for m in MUTANTS}) >= 12


def test_a_mutant_that_no_longer_applies_is_named() -> None:
    mutant = Mutant("a slip", "sign", "a.py", "x + y", "x - y", ("t.py",))
    assert mutate.planted(mutant, "z = x + y\n") == "z = x - y\n"
    for text in ("z = x * y\n", "x + y\nx + y\n"):
        with pytest.raises(ValueError, match="a slip"):
            mutate.planted(mutant, text)


@pytest.mark.parametrize(
    ("code", "output", "verdict", "by"),
    [
        (0, "12 passed in 1 s", "missed", ""),
        (1, "FAILED tests/a.py::test_x[1] - assert\n1 failed", "caught", "tests/a.py::test_x[1]"),
        (1, "ERROR tests/a.py::test_x - boom\n1 error", "caught", "tests/a.py::test_x"),
        (1, "", "error", "nothing was written"),
        (2, "ERROR tests/a.py\n1 error in 1 s", "error", "1 error in 1 s"),
        (4, "ERROR: file or directory not found: x", "error", ""),
        (5, "no tests ran in 0 s", "error", "no tests ran in 0 s"),
        (-11, "", "error", "nothing was written"),
    ],
)
def test_only_a_failed_test_is_a_catch(code: int, output: str, verdict: str, by: str) -> None:
    found = mutate.judged(code, output)
    assert found.verdict == verdict
    assert by in found.by


def test_one_mutant_from_end_to_end(tmp_path: Path) -> None:
    """In a tree of two files: caught, missed, and the tree is left as it was."""
    tree = tmp_path / "tree"
    (tree / "geometry").mkdir(parents=True)
    (tree / "tests" / "geometry").mkdir(parents=True)
    (tree / "geometry" / "__init__.py").write_text("def add(x, y):\n    return x + y\n")
    test = "from monopart.geometry import add\n\ndef test_add():\n    assert add(1, {}) == {}\n"
    (tree / "tests" / "geometry" / "test_a.py").write_text(test.format(2, 3))
    (tree / "tests" / "geometry" / "test_b.py").write_text(test.format(0, 1))
    shop = mutate.Workshop(tmp_path / "copy", tree)
    shop.check()
    blind, sharp = ("tests/geometry/test_b.py",), ("tests/geometry/test_a.py",)
    assert shop.run_tests(blind + sharp).verdict == "missed"
    for tests in (sharp, blind):  # the blind one is followed by the rest of its folder
        slip = Mutant("a", "sign", "geometry/__init__.py", "x + y", "x - y", tests)
        assert shop.try_mutant(slip).by == "tests/geometry/test_a.py::test_add"
    same = Mutant("b", "none", "geometry/__init__.py", "x + y", "y + x", blind)
    assert shop.try_mutant(same).verdict == "missed"
    broken = Mutant("c", "syntax", "geometry/__init__.py", "x + y", "x +", blind)
    assert shop.try_mutant(broken).verdict == "error"
    source = (tree / "geometry" / "__init__.py").read_text()
    assert (tmp_path / "copy" / "geometry" / "__init__.py").read_text() == source


def test_results_are_kept_and_forgotten(tmp_path: Path) -> None:
    path, mutant = tmp_path / "results.json", MUTANTS[0]
    mutate.Results(path, False).put(mutant, mutate.Outcome("caught", "tests/a.py::test", 1.0))
    assert mutate.Results(path, False).get(mutant) is not None
    assert mutate.Results(path, True).get(mutant) is None
    kept = mutate.Results(path, False)
    kept.known[mutant.name]["digest"] = "other"
    assert kept.get(mutant) is None, "the code or its tests have changed"
    kept.put(mutant, mutate.Outcome("missed", "", 1.0))
    assert kept.get(mutant) is None, "what was missed is tried again"
    assert f"0 of {len(MUTANTS)} caught" in mutate.page(kept)
    assert f"| `{mutant.file}` |" in mutate.table(kept)
