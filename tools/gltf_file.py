"""The container of glTF 2.0: JSON, buffers and accessors, every bound checked."""

import base64
import binascii
import json
import math
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from monopart.geometry.errors import InputError

MAGIC = b"glTF"
JSON_CHUNK, BIN_CHUNK = 0x4E4F534A, 0x004E4942
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
SHAPES = {"SCALAR": (), "VEC2": (2,), "VEC3": (3,), "VEC4": (4,), "MAT4": (4, 4)}
_KNOWN = {"KHR_texture_transform", "KHR_materials_unlit", "KHR_mesh_quantization"}


class GltfFile:
    """A glTF file that is read: its JSON and the arrays of its accessors."""

    def __init__(self, path: Path) -> None:
        """Read the JSON and remember where the binary data stands.

        Raises:
            InputError: damaged container, another version, or an extension that is required.
        """
        self.path = path
        data = path.read_bytes()
        text, self._chunk = _chunks(data, path) if data[:4] == MAGIC else (data, None)
        document = json.loads(text)
        if not isinstance(document, dict) or "asset" not in document:
            raise self.error("expected the JSON of a glTF file, found other JSON")
        version = str(document["asset"].get("version", "none"))
        if version.partition(".")[0] != "2":
            raise self.error(f"asset.version: expected 2, found {version}")
        needed = set(document.get("extensionsRequired", ())) - _KNOWN
        if needed:
            raise self.error(
                f"expected plain arrays, found the extension {', '.join(sorted(needed))}; "
                "export it without compression"
            )
        self.json: dict[str, Any] = document
        self._buffers: dict[int, bytes] = {}

    def error(self, message: str) -> InputError:
        """An error that names the file, and a fix where the message has none."""
        fix = "" if ";" in message else "; export it again"
        return InputError(f"{self.path}: {message}{fix}")

    def item(self, kind: str, index: int) -> dict[str, Any]:
        """An entry of one of the lists of the file.

        Raises:
            InputError: no such entry.
        """
        entries = self.json.get(kind, [])
        if not isinstance(index, int) or not 0 <= index < len(entries):
            raise self.error(f"{kind}: expected an index below {len(entries)}, found {index}")
        return entries[index]

    def buffer(self, index: int) -> bytes:
        """The bytes of a buffer: the binary chunk, a data URI or a file beside."""
        if index not in self._buffers:
            entry = self.item("buffers", index)
            data = self._chunk if "uri" not in entry else self.linked(entry["uri"])
            size = int(entry["byteLength"])
            if data is None or len(data) < size:
                found = 0 if data is None else len(data)
                raise self.error(f"buffer {index}: expected {size} bytes, found {found}")
            self._buffers[index] = data
        return self._buffers[index]

    def linked(self, uri: str) -> bytes:
        """What a URI names: data in itself or a file beside this one.

        Raises:
            InputError: another kind of URI, a file outside the folder, or none.
        """
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            if not head.endswith(";base64"):
                raise self.error("uri: expected base64 data, found another encoding")
            try:
                return base64.b64decode(body, validate=True)
            except binascii.Error as error:
                raise self.error(f"uri: expected base64 data, found damage ({error})") from error
        name = unquote(uri)
        file = self.path.parent / name
        inside = file.resolve().is_relative_to(self.path.parent.resolve())
        if "://" in name or not inside or not file.is_file():
            raise self.error(f"uri: expected a file beside it, found no {name}; put it there")
        return file.read_bytes()

    def view(self, index: int) -> tuple[bytes, int]:
        """Bytes of a buffer view and its stride (0: tightly packed)."""
        entry = self.item("bufferViews", index)
        data = self.buffer(entry["buffer"])
        start, size = int(entry.get("byteOffset", 0)), int(entry["byteLength"])
        if start < 0 or size < 0 or start + size > len(data):
            raise self.error(f"bufferView {index}: expected it inside its buffer, found it beyond")
        return data[start : start + size], int(entry.get("byteStride", 0))

    def array(self, index: int) -> np.ndarray:
        """Values of an accessor, (n, …); normalised integers become float64.

        Raises:
            InputError: unknown type, or values beyond the buffer view.
        """
        entry = self.item("accessors", index)
        kind, code, count = entry["type"], entry["componentType"], int(entry["count"])
        if kind not in SHAPES or code not in COMPONENTS or count < 0:
            raise self.error(f"accessor {index}: expected a known type, found {kind} of {code}")
        dtype, shape = np.dtype(COMPONENTS[code]), SHAPES[kind]
        if "bufferView" in entry:
            values = self._strided(index, entry, dtype, shape)
        else:
            if count > 1 << 28:
                raise self.error(f"accessor {index}: expected a smaller count, found {count}")
            values = np.zeros((count, *shape), dtype)
        if "sparse" in entry:
            values = self._sparse(values.copy(), entry["sparse"], dtype, shape)
        if entry.get("normalized") and dtype.kind in "iu":
            scaled = values.astype(np.float64) / np.iinfo(dtype).max
            return np.maximum(scaled, -1.0)
        return values

    def _strided(
        self, index: int, entry: dict[str, Any], dtype: np.dtype, shape: tuple[int, ...]
    ) -> np.ndarray:
        data, stride = self.view(entry["bufferView"])
        start, count = int(entry.get("byteOffset", 0)), int(entry["count"])
        size = dtype.itemsize * math.prod(shape)
        stride = stride or size
        if (
            start < 0
            or stride < size
            or (count and start + (count - 1) * stride + size > len(data))
        ):
            raise self.error(
                f"accessor {index}: expected {count} values inside its buffer view, found it too "
                "short; the file is damaged"
            )
        if count == 0:
            return np.zeros((0, *shape), dtype)
        inner = tuple(dtype.itemsize * math.prod(shape[place + 1 :]) for place in range(len(shape)))
        return np.ndarray((count, *shape), dtype, data, start, (stride, *inner)).copy()

    def _sparse(
        self, values: np.ndarray, sparse: dict[str, Any], dtype: np.dtype, shape: tuple[int, ...]
    ) -> np.ndarray:
        count = int(sparse["count"])
        where = sparse["indices"]
        places = self._part(where, np.dtype(COMPONENTS[where["componentType"]]), count, ())
        if count and places.max() >= len(values):
            raise self.error(f"sparse: expected indices below {len(values)}, found {places.max()}")
        values[places] = self._part(sparse["values"], dtype, count, shape)
        return values

    def _part(
        self, entry: dict[str, Any], dtype: np.dtype, count: int, shape: tuple[int, ...]
    ) -> np.ndarray:
        data, _ = self.view(entry["bufferView"])
        size = count * math.prod(shape)
        return np.frombuffer(data, dtype, size, int(entry.get("byteOffset", 0))).reshape(
            count, *shape
        )


def _chunks(data: bytes, path: Path) -> tuple[bytes, bytes | None]:
    """JSON and binary chunk of a glb."""
    version, length = struct.unpack_from("<II", data.ljust(12, b"\0"), 4)
    if version != 2 or length > len(data):
        raise InputError(
            f"{path}: expected {length} bytes of glb version 2, found {len(data)} of version "
            f"{version}; it is cut short or of another kind"
        )
    found: dict[int, bytes] = {}
    place = 12
    while place + 8 <= length:
        size, kind = struct.unpack_from("<II", data, place)
        if place + 8 + size > length:
            raise InputError(f"{path}: expected whole chunks, found one cut short")
        found.setdefault(kind, data[place + 8 : place + 8 + size])
        place += 8 + size
    if JSON_CHUNK not in found:
        raise InputError(f"{path}: expected a JSON chunk, found none; the file is damaged")
    return found[JSON_CHUNK], found.get(BIN_CHUNK)


class GltfBuilder:
    """Gathers arrays into one buffer and lists buffer views and accessors for them."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, target: int | None = None) -> int:
        """Append bytes, aligned to four, and return the buffer view.

        Args:
            data: what to append.
            target: 34962 for vertex attributes, 34963 for indices.
        """
        self.data += b"\0" * (-len(self.data) % 4)
        entry = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        self.views.append(entry | ({} if target is None else {"target": target}))
        self.data += data
        return len(self.views) - 1

    def array(self, values: np.ndarray, target: int | None = None, bounds: bool = False) -> int:
        """Append an array and return its accessor.

        Args:
            values: (n), (n, 2), (n, 3), (n, 4) or (n, 4, 4) of a component type of glTF.
            target: see `view`.
            bounds: state the least and largest values.
        """
        kinds = {shape: kind for kind, shape in SHAPES.items()}
        codes = {np.dtype(text): code for code, text in COMPONENTS.items()}
        entry: dict[str, Any] = {
            "bufferView": self.view(values.tobytes(), target),
            "componentType": codes[values.dtype],
            "count": len(values),
            "type": kinds[values.shape[1:]],
        }
        if bounds:
            entry["min"] = np.atleast_1d(values.min(axis=0)).tolist()
            entry["max"] = np.atleast_1d(values.max(axis=0)).tolist()
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def packed(self, document: dict[str, Any], binary: bool) -> bytes:
        """The whole file: a glb, or JSON with the buffer as a data URI.

        Args:
            document: the rest of the JSON.
            binary: glb.
        """
        self.data += b"\0" * (-len(self.data) % 4)
        buffer: dict[str, Any] = {"byteLength": len(self.data)}
        if not binary:
            text = base64.b64encode(self.data).decode("ascii")
            buffer["uri"] = f"data:application/octet-stream;base64,{text}"
        whole = document | {
            "buffers": [buffer],
            "bufferViews": self.views,
            "accessors": self.accessors,
        }
        text = json.dumps(whole, ensure_ascii=False, allow_nan=False).encode("utf-8")
        if not binary:
            return text
        text += b" " * (-len(text) % 4)
        length = 12 + 8 + len(text) + 8 + len(self.data)
        return b"".join(
            [
                struct.pack("<4sII", MAGIC, 2, length),
                struct.pack("<II", len(text), JSON_CHUNK),
                text,
                struct.pack("<II", len(self.data), BIN_CHUNK),
                bytes(self.data),
            ]
        )
