"""Compiles the C sources of an FMU for other platforms, by the compiler zig from PyPI."""

import importlib.util
import os
import struct
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import get_args

from fe.reduction.built_once import cache_folder
from fmu_asset.errors import FmuBuildError
from reporting.choices import require_one_of
from reporting.progress import stage
from reporting.system.log import module_logger

from .compiler import COMMON_FLAGS, Compiler
from .platforms import Target, suffix_of

_logger = module_logger(__name__)

# The oldest systems on which the libraries run: glibc 2.17 is of 2012, macOS 11 of 2020.
_ZIG_TARGETS: Mapping[Target, str] = {
    "x86_64-linux": "x86_64-linux-gnu.2.17",
    "x86_64-windows": "x86_64-windows-gnu",
    "x86_64-darwin": "x86_64-macos.11.0",
    "aarch64-darwin": "aarch64-macos.11.0",
    "aarch64-linux": "aarch64-linux-gnu.2.17",
}

# The first library for Windows takes two minutes, as zig compiles parts of its C library.
_LONGEST_BUILD_SECONDS = 1800.0


def find_cross_compiler() -> list[str]:
    """Return the command of the C compiler of the package ziglang.

    Raises
    ------
    FmuBuildError
        If the package is not installed.
    """
    if importlib.util.find_spec("ziglang") is None:
        raise FmuBuildError(
            "Binaries for chosen platforms need the compiler zig, which is not installed: "
            "pip install 'uav-twin[cross]', or choose no platforms to compile for this host alone."
        )
    return [sys.executable, "-m", "ziglang", "cc"]


def cross_compile_library(sources: Mapping[str, bytes], targets: Sequence[Target]) -> bytes:
    """Compile C sources to a shared library for other platforms than this host.

    The same sources and version of ziglang give the same bytes.

    Parameters
    ----------
    targets : sequence of str
        Processor and system, such as ["x86_64-windows"]. Several processors are possible on macOS,
        whose file then contains the library of each.

    Raises
    ------
    InvalidChoiceError
        If a target is unknown.
    FmuBuildError
        If ziglang is not installed, or the compiler fails.
    """
    for target in targets:
        require_one_of(target, get_args(Target), "targets")
    command = find_cross_compiler()
    libraries = []
    for target in targets:
        flags = ["-target", _ZIG_TARGETS[target], *COMMON_FLAGS]
        if not target.endswith("-windows"):  # whose libraries need no such flag
            flags.append("-fPIC")
        with stage(f"Compiling for {target}"), zig_environment() as environment:
            compiler = Compiler(
                name="zig",
                command=[*command, *flags],
                advice="try another version of ziglang",
                environment=environment,
                longest_seconds=_LONGEST_BUILD_SECONDS,
            )
            # macOS keeps the name of the file inside the library.
            libraries.append(compiler.library(sources, f"library{suffix_of(target)}"))
    return libraries[0] if len(libraries) == 1 else fat_library(libraries)


@contextmanager
def zig_environment() -> Iterator[dict[str, str]]:
    """Provide the environment variables for a run of zig.

    zig stores what it compiles of its own C libraries in the folder `zig` of the cache of uav-twin,
    or in a temporary folder if that one cannot be written. The objects of the FMU are always in a
    temporary folder, so the cache grows only with new targets and versions of zig.
    """
    cache = cache_folder() / "zig"
    with tempfile.TemporaryDirectory(prefix="uav-twin-zig-") as scratch:
        try:
            cache.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=cache):  # whether files can be written
                pass
        except OSError as error:
            _logger.warning(
                "The folder %s cannot be written (%s), so zig compiles its C libraries anew.",
                cache,
                error.strerror,
            )
            cache = Path(scratch) / "libraries"
        yield {
            **os.environ,
            "ZIG_GLOBAL_CACHE_DIR": str(cache),
            "ZIG_LOCAL_CACHE_DIR": str(Path(scratch) / "objects"),
        }


FAT_MAGIC = 0xCAFEBABE
THIN_MAGIC = 0xFEEDFACF
"""Begins a 64-bit library for one processor; of little endian, as those of macOS are."""

_ALIGNMENT_EXPONENT = 14  # pages of macOS on Arm have 2**14 bytes
_FAT_HEADER = struct.Struct(">II")  # magic, number of libraries
_FAT_ENTRY = struct.Struct(">iiIII")  # processor, its subtype, offset, size, alignment exponent
_THIN_HEADER = struct.Struct("<Iii")  # magic, processor, its subtype


def fat_library(libraries: Sequence[bytes]) -> bytes:
    """Return one Mach-O file that contains the libraries of several processors.

    The system loads the library for its own processor. The file is laid out as in `fat.h` of macOS:
    header, an entry for each library, and the libraries at multiples of 2^14 bytes.

    Parameters
    ----------
    libraries : sequence of bytes
        64-bit Mach-O libraries, each for a different processor.

    Raises
    ------
    FmuBuildError
        If one of them is not a 64-bit Mach-O file.
    """
    alignment = 2**_ALIGNMENT_EXPONENT
    header = _FAT_HEADER.pack(FAT_MAGIC, len(libraries))
    # zeros take the place of the header until it is known
    content = bytes(_FAT_HEADER.size + len(libraries) * _FAT_ENTRY.size)
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
