"""The names that shared libraries of Linux, Windows and macOS export, read from their headers."""

import struct

from fmu_asset.compiled.cross_compiler import FAT_MAGIC, THIN_MAGIC

_DYNAMIC_SYMBOLS = 11
"""Type of the section of an ELF file with the symbols that are looked up when it is loaded."""

_SYMBOL_TABLE = 2
"""Load command of a Mach-O file that says where its symbols are."""

_ADDED_BY_THE_LINKER = {"__mh_dylib_header", "___dso_handle"}
"""Symbols of every library for macOS."""


def exported_names(library: bytes) -> list[set[str]]:
    """Return the exported names of each library in a file, which is several only for macOS."""
    if library[:4] == b"\x7fELF":
        return [_names_in_elf(library)]
    if library[:2] == b"MZ":
        return [_names_in_pe(library)]
    return [_names_in_mach_o(part) for part in mach_o_parts(library)]


def mach_o_parts(library: bytes) -> list[bytes]:
    """Return the libraries that a Mach-O file holds, one for each processor."""
    magic, count = struct.unpack_from(">II", library)
    if magic != FAT_MAGIC:
        return [library]
    parts = []
    for index in range(count):
        _, _, offset, size, _ = struct.unpack_from(">5I", library, 8 + 20 * index)
        parts.append(library[offset : offset + size])
    return parts


def _text_at(content: bytes, position: int) -> str:
    """Return the text that begins at a position and ends before the next zero."""
    return content[position : content.index(b"\0", position)].decode("ascii")


def _names_in_elf(library: bytes) -> set[str]:
    (table,) = struct.unpack_from("<Q", library, 40)
    size, count = struct.unpack_from("<HH", library, 58)
    sections = [struct.unpack_from("<IIQQQQIIQQ", library, table + size * i) for i in range(count)]
    (symbols,) = (section for section in sections if section[1] == _DYNAMIC_SYMBOLS)
    strings = sections[symbols[6]]
    names = set()
    for position in range(symbols[4], symbols[4] + symbols[5], 24):
        name, _, _, section = struct.unpack_from("<IBBH", library, position)
        if section:  # a symbol of another library has no section
            names.add(_text_at(library, strings[4] + name))
    return names


def _names_in_pe(library: bytes) -> set[str]:
    (header,) = struct.unpack_from("<I", library, 60)
    section_count, options_size = struct.unpack_from("<H12xH", library, header + 6)
    options = header + 24
    sections = []
    for index in range(section_count):
        entry = options + options_size + 40 * index
        sections.append(struct.unpack_from("<IIII", library, entry + 8))

    def position_of(address: int) -> int:
        """Return the position in the file of an address in memory."""
        for size, begin, _, position in sections:
            if begin <= address < begin + size:
                return position + address - begin
        raise AssertionError(f"no section holds the address {address:#x}")

    (exports,) = struct.unpack_from("<I", library, options + 112)
    count, _, name_table = struct.unpack_from("<III", library, position_of(exports) + 24)
    addresses = struct.unpack_from(f"<{count}I", library, position_of(name_table))
    return {_text_at(library, position_of(address)) for address in addresses}


def _names_in_mach_o(library: bytes) -> set[str]:
    magic, _, _, _, command_count = struct.unpack_from("<5I", library)
    assert magic == THIN_MAGIC
    names = set()
    position = 32
    for _ in range(command_count):
        command, size = struct.unpack_from("<II", library, position)
        if command == _SYMBOL_TABLE:
            symbols, count, strings, _ = struct.unpack_from("<4I", library, position + 8)
            for index in range(count):
                name, kind, section = struct.unpack_from("<IBB", library, symbols + 16 * index)
                # external, in a section of this library, and not private to it
                if section and kind & 0x11 == 0x01:
                    names.add(_text_at(library, strings + name))
        position += size
    return {name.removeprefix("_") for name in names - _ADDED_BY_THE_LINKER}
