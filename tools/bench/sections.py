"""Parts of a page that commands write: what lies between two marks."""

from pathlib import Path

from monopart.geometry.atomic import write_text
from monopart.geometry.errors import InputError


def marks(name: str) -> tuple[str, str]:
    """Begin and end of a part.

    >>> marks("uv")
    ('<!-- uv: begin -->', '<!-- uv: end -->')
    """
    return f"<!-- {name}: begin -->", f"<!-- {name}: end -->"


def read_page(page: Path) -> str:
    """The text of a page.

    Raises:
        InputError: no such page.
    """
    try:
        return page.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{page}: expected a Markdown page, found {error.strerror}") from None


def with_section(text: str, page: Path, name: str, body: str) -> str:
    """The text of a page with a part replaced.

    Args:
        text: of the page.
        page: what an error names.
        name: of the part.
        body: what goes between its marks.

    Raises:
        InputError: no marks.
    """
    begin, end = marks(name)
    if begin not in text or end not in text:
        raise InputError(f"{page}: expected the marks {begin} and {end}; add them where it goes")
    before, rest = text.split(begin, 1)
    return f"{before}{begin}\n{body}{end}{rest.split(end, 1)[1]}"


def write_section(page: Path, name: str, body: str) -> None:
    """Replace a part of a page.

    Args:
        page: a Markdown file with the marks.
        name: of the part.
        body: what goes between its marks.

    Raises:
        InputError: no such page, or no marks.
    """
    write_text(page, with_section(read_page(page), page, name, body))
