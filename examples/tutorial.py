"""Runs docs/tutorial.md as a notebook: ``python examples/tutorial.py --write``.

Blocks of Python on the page share one namespace; the block of text behind one is what it prints.
With ``--write`` outputs and pictures are made anew; without, they are compared. In a block,
``picture(name, image)`` stands for a picture of the page.
"""

import argparse
import contextlib
import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

PAGE = Path(__file__).resolve().parents[1] / "docs" / "tutorial.md"
BLOCK = re.compile(r"```python\n(.*?)```\n(\n```text\n(.*?)```\n)?", re.DOTALL)


def run(text: str, picture: Callable[[str, Any], None]) -> tuple[str, list[str]]:
    """The page with fresh outputs, and a line for each output that differs.

    Args:
        text: the page.
        picture: receives the pictures, name and [H, W, 3] in [0, 1].
    """
    names: dict[str, Any] = {"picture": picture, "__name__": "tutorial"}
    differences: list[str] = []

    def again(block: re.Match[str]) -> str:
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            exec(compile(block[1], f"{PAGE.name}: {block[1].splitlines()[0]}", "exec"), names)  # noqa: S102
        if said.getvalue() != (block[3] or ""):
            differences.append(f"expected {block[3]!r}, found {said.getvalue()!r}")
        output = f"\n```text\n{said.getvalue()}```\n" if said.getvalue() else ""
        return f"```python\n{block[1]}```\n{output}"

    return BLOCK.sub(again, text), differences


def main() -> int:
    """Exit code 1 where an output differs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", action="store_true", help="outputs and pictures anew")
    write = parser.parse_args().write

    def save(name: str, image: Any) -> None:
        from monopart.toolkit.video import save_png

        if write:
            folder = PAGE.parent / "tutorial"
            folder.mkdir(exist_ok=True)
            save_png(folder / f"{name}.png", np.asarray(image, dtype=np.float32))

    page, differences = run(PAGE.read_text(encoding="utf-8"), save)
    if write:
        PAGE.write_text(page, encoding="utf-8")
        return 0
    print(*differences, sep="\n")
    return int(bool(differences))


if __name__ == "__main__":
    raise SystemExit(main())
