"""Joining libraries for macOS on several processors to one file, as the program lipo does."""

import struct
from collections.abc import Sequence

from fmu_asset.errors import FmuBuildError

FAT_MAGIC = 0xCAFEBABE
THIN_MAGIC = 0xFEEDFACF
"""Begins a 64-bit library for one processor; of little endian, as those of macOS are."""

_ALIGNMENT_EXPONENT = 14  # pages of macOS on Arm have 2**14 bytes
_FAT_HEADER = struct.Struct(">II")  # magic, number of libraries
_FAT_ENTRY = struct.Struct(">iiIII")  # processor, its subtype, offset, size, alignment exponent
_THIN_HEADER = struct.Struct("<Iii")  # magic, processor, its subtype


def fat_library(libraries: Sequence[bytes]) -> bytes:
    """Return one Mach-O file that holds the libraries of several processors.

    The system loads the library for its own processor. The file is laid out as in `fat.h` of
    macOS: header, an entry for each library, and the libraries at multiples of 2^14 bytes.

    Parameters
    ----------
    libraries : sequence of bytes
        64-bit Mach-O libraries, each for another processor.

    Raises
    ------
    FmuBuildError
        If one of them is not a 64-bit Mach-O file.
    """
    alignment = 2**_ALIGNMENT_EXPONENT
    header = _FAT_HEADER.pack(FAT_MAGIC, len(libraries))
    content = bytes(_FAT_HEADER.size + len(libraries) * _FAT_ENTRY.size)  # the place of the header
    for library in libraries:
        if library[:4] != struct.pack("<I", THIN_MAGIC):
            raise FmuBuildError(
                "A 64-bit Mach-O library was expected of the compiler for macOS, but its file "
                f"begins with {library[:4].hex() or 'nothing'}: try another version of ziglang."
            )
        _, processor, subtype = _THIN_HEADER.unpack_from(library)
        content += bytes(-len(content) % alignment)
        header += _FAT_ENTRY.pack(
            processor, subtype, len(content), len(library), _ALIGNMENT_EXPONENT
        )
        content += library
    return header + content[len(header) :]
