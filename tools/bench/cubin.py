"""What a compiled CUDA program says of its kernels: registers and stack, read from the ELF file."""

import struct
from dataclasses import dataclass

from monopart.geometry.errors import InputError

_REGISTERS, _FRAME = 0x2F, 0x11  # attributes of .nv.info, as `cuobjdump -elf` names them
_FIXED, _SIZED = 0x03, 0x04  # forms of an attribute: a 16-bit value; a size and that many bytes


@dataclass(frozen=True)
class KernelFacts:
    """Needs of one kernel."""

    registers: int
    """Registers of a thread; 255 at most."""
    stack: int
    """Bytes of local memory of a thread: arrays, and registers that had to be spilled."""


def kernel_facts(data: bytes) -> dict[str, KernelFacts]:
    """Registers and stack of the kernels of a cubin.

    Args:
        data: a 64-bit little-endian ELF file, as NVRTC and ptxas write it.

    Returns:
        Facts by the name of the entry point.

    Raises:
        InputError: another kind of file.
    """
    if data[:6] != b"\x7fELF\x02\x01":
        raise InputError(f"cubin: expected a 64-bit ELF file, found {data[:6]!r}; compile it anew")
    try:
        return _facts(data)
    except (struct.error, IndexError, ValueError) as error:
        raise InputError(f"cubin: expected an ELF file, found {error}; compile it anew") from None


def _facts(data: bytes) -> dict[str, KernelFacts]:
    (table,) = struct.unpack_from("<Q", data, 0x28)
    size, count, names_at = struct.unpack_from("<HHH", data, 0x3A)
    # name, type, flags, address, offset, size, link, info
    sections = [struct.unpack_from("<IIQQQQII", data, table + i * size) for i in range(count)]
    names = sections[names_at][4]
    symbol_of: dict[str, int] = {}
    registers: dict[int, int] = {}
    frames: dict[int, int] = {}
    for name_at, _, _, _, offset, length, _, info in sections:
        name = data[names + name_at : data.index(b"\0", names + name_at)].decode()
        if name.startswith(".text."):
            symbol_of[name.removeprefix(".text.")] = info & 0xFFFFFF
        elif name == ".nv.info":
            registers, frames = _attributes(data[offset : offset + length])
    return {n: KernelFacts(registers[s], frames.get(s, 0)) for n, s in symbol_of.items()}


def _attributes(data: bytes) -> tuple[dict[int, int], dict[int, int]]:
    """Registers and frame sizes by symbol."""
    found: dict[int, dict[int, int]] = {_REGISTERS: {}, _FRAME: {}}
    at = 0
    while at + 4 <= len(data):
        form, kind, size = struct.unpack_from("<BBH", data, at)
        at += 4
        if form == _SIZED:
            if kind in found:
                symbol, value = struct.unpack_from("<II", data, at)
                found[kind][symbol] = value
            at += size
        elif form > _FIXED:
            raise ValueError(f"an attribute of form {form}")
    return found[_REGISTERS], found[_FRAME]
