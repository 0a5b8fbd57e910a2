"""Run every doctest under its installed name (pytest --doctest-modules would import bare names)."""

import contextlib
import doctest
import importlib
import io
import re

import pytest
from building import ROOT, source_files


def _module(parts: tuple[str, ...]) -> str:
    return ".".join(("monopart", *(p for p in parts if p != "__init__")))


MODULES = [
    _module(p.relative_to(ROOT).with_suffix("").parts)
    for p in source_files()
    if p.name != "__main__.py"
]


@pytest.mark.parametrize("name", MODULES)
def test_doctests(name: str) -> None:
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    result = doctest.testmod(importlib.import_module(name), optionflags=flags)
    assert result.failed == 0


def test_there_are_doctests() -> None:
    finder = doctest.DocTestFinder(exclude_empty=True)
    counts = {
        name: sum(bool(t.examples) for t in finder.find(importlib.import_module(name)))
        for name in MODULES
        if name.startswith("monopart.geometry")
    }
    assert sum(counts.values()) >= 15, counts


def test_readme_example() -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        exec(compile(code, "README.md", "exec"), {})
    error, count = re.fullmatch(r"(\S+) m, (\d+) vertices in the image\n", said.getvalue()).groups()
    assert float(error) < 1e-5
    assert int(count) == 5600
