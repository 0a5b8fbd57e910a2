"""The elements of a PLY file as arrays, text or binary of either byte order."""

import codecs
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from monopart.geometry.errors import InputError

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8"},
    **{"float32": "f4", "float64": "f8"},
}


@dataclass(frozen=True)
class Lists:
    """Lists of different lengths, one behind the other."""

    sizes: np.ndarray
    """Length of each list."""
    values: np.ndarray
    """All of them in a row."""


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str
    count_kind: str | None
    """Type of the length of a list; None for a single number."""


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property]

    @property
    def has_lists(self) -> bool:
        return any(p.count_kind for p in self.properties)


@dataclass(frozen=True)
class PlyFile:
    """What a PLY file says."""

    elements: dict[str, dict[str, np.ndarray | Lists]]
    """Numbers (n,) or lists of each property of each element."""
    comments: tuple[str, ...]
    """Comment lines of the header."""


def parse_ply(data: bytes, source: Path) -> PlyFile:
    """Take a PLY file apart.

    Args:
        data: the file's bytes.
        source: what to call it in errors.

    Returns:
        Its elements and comments.

    Raises:
        InputError: no PLY, an unknown type, or fewer numbers than the header says.
    """
    layout, elements, comments, body = _header(data, source)
    reader = _Text(body, source) if layout == "ascii" else _Binary(body, layout, source)
    columns = {element.name: reader.element(element) for element in elements}
    return PlyFile(columns, tuple(comments))


def _header(data: bytes, source: Path) -> tuple[str, list[_Element], list[str], bytes]:
    data = data.removeprefix(codecs.BOM_UTF8)
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise InputError(
            f"{source}: expected a header from 'ply' to 'end_header', found none; export it as PLY"
        )
    newline = b"\n" if b"\n" in data[:end] else b"\r"  # as programs of old Macintoshes wrote
    start = data.find(newline, end) + 1
    if start == 0:
        start = len(data)
    lines = data[:end].decode("utf-8", "replace").splitlines()
    layout, elements, comments = "", [], []
    for line in lines[1:]:
        words = line.split() or [""]
        try:
            if words[0] == "format":
                layout = words[1]
            elif words[0] == "comment":
                comments.append(line.strip()[len("comment ") :])
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2]), []))
            elif words[0] == "property":
                elements[-1].properties.append(_property(words, source))
        except (IndexError, ValueError):
            raise InputError(
                f"{source}: header: expected lines such as 'element vertex 8' and then 'property "
                f"float x', found {line[:80]!r}; export it again"
            ) from None
    if layout not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise InputError(
            f"{source}: format: expected ascii, binary_little_endian or "
            f"binary_big_endian, found {layout or 'none'}; export it again"
        )
    return layout, elements, comments, data[start:]


def _property(words: list[str], source: Path) -> _Property:
    types = words[2:4] if words[1] == "list" else words[1:2]
    unknown = [name for name in types if name not in _TYPES]
    if unknown:
        raise InputError(
            f"{source}: property: expected a number type such as float, "
            f"found {unknown[0]!r}; export it again"
        )
    if words[1] == "list":
        return _Property(words[4], _TYPES[words[3]], _TYPES[words[2]])
    return _Property(words[2], _TYPES[words[1]], None)


class _Reader:
    """Reads elements one after the other; subclasses know how numbers lie in the file."""

    def __init__(self, source: Path) -> None:
        self.source = source

    def element(self, element: _Element) -> dict[str, np.ndarray | Lists]:
        if element.count < 0 or element.count > self.left():
            raise self.short(element)
        if element.count == 0 or not element.properties:
            return {p.name: self.none(p) for p in element.properties}
        sizes = self.first_sizes(element)
        try:
            table = self.table(element, sizes)
        except InputError:  # longer than the file: later lists may be shorter than the first
            if not element.has_lists:
                raise
            table = None
        return self.rows(element) if table is None else table

    def none(self, what: _Property) -> np.ndarray | Lists:
        empty = np.zeros(0, dtype=what.kind)
        return Lists(np.zeros(0, dtype=np.int64), empty) if what.count_kind else empty

    def short(self, element: _Element) -> InputError:
        return InputError(
            f"{self.source}: {element.name}: expected {element.count} rows, found the end of the "
            "file; it is cut short, copy or export it again"
        )

    def left(self) -> int:
        raise AttributeError

    def first_sizes(self, element: _Element) -> list[int]:
        raise AttributeError

    def table(self, element: _Element, sizes: list[int]) -> dict[str, Any] | None:
        raise AttributeError

    def rows(self, element: _Element) -> dict[str, np.ndarray | Lists]:
        """Row by row, for lists of different lengths."""
        numbers: dict[str, list[Any]] = {p.name: [] for p in element.properties}
        sizes: dict[str, list[int]] = {p.name: [] for p in element.properties}
        for _ in range(element.count):
            for what in element.properties:
                size = int(self.take(what.count_kind, 1, element)[0]) if what.count_kind else 1
                if size < 0:
                    raise self.short(element)
                sizes[what.name].append(size)
                numbers[what.name].append(self.take(what.kind, size, element))
        found: dict[str, np.ndarray | Lists] = {}
        for what in element.properties:
            values = np.concatenate(numbers[what.name])
            lengths = np.array(sizes[what.name], dtype=np.int64)
            found[what.name] = Lists(lengths, values) if what.count_kind else values
        return found

    def take(self, kind: str, size: int, element: _Element) -> np.ndarray:
        raise AttributeError


class _Binary(_Reader):
    def __init__(self, data: bytes, layout: str, source: Path) -> None:
        super().__init__(source)
        self.data, self.place = data, 0
        self.order = "<" if layout == "binary_little_endian" else ">"

    def left(self) -> int:
        return len(self.data) - self.place

    def take(self, kind: str, size: int, element: _Element) -> np.ndarray:
        dtype = np.dtype(self.order + kind)
        if size * dtype.itemsize > self.left():
            raise self.short(element)
        values = np.frombuffer(self.data, dtype, size, self.place)
        self.place += size * dtype.itemsize
        return values

    def first_sizes(self, element: _Element) -> list[int]:
        start, sizes = self.place, []
        for what in element.properties:
            size = int(self.take(what.count_kind, 1, element)[0]) if what.count_kind else 0
            self.take(what.kind, size if what.count_kind else 1, element)
            sizes.append(size)
        self.place = start
        return sizes

    def table(self, element: _Element, sizes: list[int]) -> dict[str, Any] | None:
        fields: list[Any] = []
        for n, (what, size) in enumerate(zip(element.properties, sizes, strict=True)):
            if what.count_kind:
                fields.append((f"n{n}", self.order + what.count_kind))
                fields.append((f"v{n}", self.order + what.kind, (size,)))
            else:
                fields.append((f"v{n}", self.order + what.kind))
        dtype = np.dtype(fields)
        if element.count * dtype.itemsize > self.left():
            raise self.short(element)
        rows = np.frombuffer(self.data, dtype, element.count, self.place)
        found: dict[str, np.ndarray | Lists] = {}
        for n, (what, size) in enumerate(zip(element.properties, sizes, strict=True)):
            if what.count_kind and not (rows[f"n{n}"] == size).all():
                return None
            found[what.name] = _column(rows[f"v{n}"], what, size, element.count)
        self.place += element.count * dtype.itemsize
        return found


class _Text(_Reader):
    def __init__(self, data: bytes, source: Path) -> None:
        super().__init__(source)
        words = data.split()
        # numbers of more than 53 bits do not occur in meshes: one float64 array holds them all
        self.numbers = np.array(words, dtype=object).astype(np.float64)
        self.place = 0

    def left(self) -> int:
        return len(self.numbers) - self.place

    def take(self, kind: str, size: int, element: _Element) -> np.ndarray:
        if size > self.left():
            raise self.short(element)
        values = self.numbers[self.place : self.place + size]
        self.place += size
        return values

    def first_sizes(self, element: _Element) -> list[int]:
        start, sizes = self.place, []
        for what in element.properties:
            size = int(self.take(what.kind, 1, element)[0]) if what.count_kind else 0
            self.take(what.kind, size if what.count_kind else 0, element)
            self.place += 0 if what.count_kind else 1
            sizes.append(size)
        self.place = start
        return sizes

    def table(self, element: _Element, sizes: list[int]) -> dict[str, Any] | None:
        widths = [
            1 + size if what.count_kind else 1
            for what, size in zip(element.properties, sizes, strict=True)
        ]
        width = sum(widths)
        if element.count * width > self.left():
            raise self.short(element)
        end = self.place + element.count * width
        rows = self.numbers[self.place : end].reshape(element.count, width)
        found: dict[str, np.ndarray | Lists] = {}
        column = 0
        for what, size, wide in zip(element.properties, sizes, widths, strict=True):
            if what.count_kind and not (rows[:, column] == size).all():
                return None
            skip = 1 if what.count_kind else 0
            block = rows[:, column + skip : column + wide]
            block = block if what.count_kind else block[:, 0]
            found[what.name] = _column(block, what, size, element.count)
            column += wide
        self.place = end
        return found


def _column(block: np.ndarray, what: _Property, size: int, count: int) -> np.ndarray | Lists:
    if what.count_kind is None:
        return block
    return Lists(np.full(count, size, dtype=np.int64), block.reshape(-1))
