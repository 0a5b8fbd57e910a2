"""The tutorial is a notebook: every block runs, and prints what the page says."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tutorial import PAGE, run


@pytest.mark.slow
def test_every_printed_number() -> None:
    pictures: dict[str, Any] = {}
    text = PAGE.read_text(encoding="utf-8")
    page, differences = run(text, lambda name, image: pictures.update({name: np.asarray(image)}))
    assert not differences
    assert page == text
    assert set(pictures) == {p.stem for p in (PAGE.parent / "tutorial").glob("*.png")}
    for name, image in pictures.items():
        assert f"(tutorial/{name}.png)" in text
        assert image.shape[-1] == 3 and 0 <= image.min() < image.max() <= 1
        assert image.std() > 0.05  # something is to be seen


def test_a_wrong_number_is_found() -> None:
    page = "```python\nprint(6 * 7)\n```\n\n```text\n41\n```\n\n```python\nx = 1\n```\n"
    fresh, differences = run(page, lambda name, image: None)
    assert len(differences) == 1 and "41" in differences[0] and "42" in differences[0]
    assert fresh == page.replace("41", "42")
    assert run(fresh, lambda name, image: None) == (fresh, [])


def test_the_page_is_linked() -> None:
    root = Path(__file__).resolve().parents[2]
    assert "tutorial.md" in (root / "mkdocs.yml").read_text()
