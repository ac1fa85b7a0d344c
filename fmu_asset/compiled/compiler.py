"""Compiles the C sources of an FMU to a shared library, with the same bytes every time."""

import hashlib
import os
import re
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from fmpy import platform_tuple

from fe.reduction.built_once import built_once, cache_folder
from fmu_asset.errors import FmuBuildError
from reporting.files import atomic_write_bytes

from .platforms import HOST_TARGET

COMPILERS = ("cc", "gcc", "clang")
"""Compilers that are tried in this order if the environment variable CC names none."""

# The library must not depend on the place or time of the build, nor on what is installed where it
# runs.
_CODE_FLAGS = (
    "-std=c11",
    "-O3",
    "-fvisibility=hidden",
    "-ffp-contract=off",  # with fused multiplications the last bit would depend on the processor
    "-fno-math-errno",
)
_LINK_FLAGS = ("-shared", "-Wl,-s")
COMMON_FLAGS = (*_CODE_FLAGS, *_LINK_FLAGS)
"""Flags of every compiler of shared libraries."""

_HOST_CODE_FLAGS = (*_CODE_FLAGS, "-fPIC")
_HOST_FLAGS = (*_HOST_CODE_FLAGS, *_LINK_FLAGS, "-Wl,--build-id=none")

_SHOWN_ERROR_LINES = 12

_INCLUDE = re.compile(rb'^[ \t]*#[ \t]*include[ \t]*"([^"]+)"', re.MULTILINE)


@dataclass(frozen=True, kw_only=True)
class Compiler:
    """A C compiler for shared libraries, with its flags.

    Attributes
    ----------
    name : str
        Its name in messages.
    command : sequence of str
        The command, with the flags that it is called with.
    advice : str
        What to do if it fails, such as "set CC to another one".
    environment : mapping of str to str, optional
        Its environment variables; by default those of this process.
    longest_seconds : float
        The time after which it is stopped.
    libraries : sequence of str
        The flags that name libraries.
    """

    name: str
    command: Sequence[str]
    advice: str
    environment: Mapping[str, str] | None = None
    longest_seconds: float = 300.0
    libraries: Sequence[str] = ("-lm",)

    def library(self, sources: Mapping[str, bytes], file_name: str) -> bytes:
        """Compile C sources to a shared library, and return its bytes.

        Parameters
        ----------
        sources : mapping of str to bytes
            The content of sources, headers and object code (`.o`) by file name, all in one folder.
        file_name : str
            The name of the file that the compiler writes.

        Raises
        ------
        FmuBuildError
            If the compiler cannot be run, or fails.
        """
        with tempfile.TemporaryDirectory(prefix="uav-twin-cc-") as folder:
            for name, content in sources.items():
                (Path(folder) / name).write_bytes(content)
            units = sorted(name for name in sources if name.endswith((".c", ".o")))
            # Names relative to the working folder, so that no path gets into the library.
            words = [*self.command, "-o", file_name, *units, *self.libraries]
            failure = f"The C compiler {self.name} could not be run ("
            with FmuBuildError.instead_of(
                OSError, subprocess.TimeoutExpired, before=failure, after=")."
            ):
                process = subprocess.run(
                    words,
                    cwd=folder,
                    env=self.environment,
                    capture_output=True,
                    text=True,
                    timeout=self.longest_seconds,
                    check=False,
                )
            library = Path(folder) / file_name
            if process.returncode != 0 or not library.is_file():
                lines = (process.stderr or process.stdout).strip().splitlines()
                output = "\n  ".join(lines[:_SHOWN_ERROR_LINES])
                raise FmuBuildError(
                    f"The C compiler {self.name} failed with exit code {process.returncode}; "
                    f"{self.advice}. It says:\n  {output}"
                )
            return library.read_bytes()


def find_compiler() -> list[str]:
    """Return the command of this host's C compiler: `$CC`, which may have arguments, or one found.

    Raises
    ------
    FmuBuildError
        If there is none.
    """
    command_from_environment = shlex.split(os.environ.get("CC", ""))
    if command_from_environment:
        commands = [command_from_environment]
        looked_for = f"CC={os.environ['CC']}"
    else:
        commands = [[name] for name in COMPILERS]
        looked_for = ", ".join(COMPILERS)
    for name, *arguments in commands:
        program = shutil.which(name)
        if program is not None:
            return [program, *arguments]
    raise FmuBuildError(
        f"A compiled FMU needs a C compiler, but none was found (looked for: {looked_for}); "
        "install one (such as the package gcc, or pip install 'uav-twin[cross]' and choose "
        "platforms) or set CC, or build with --kind source and compile the FMU elsewhere."
    )


def compile_library(sources: Mapping[str, bytes], generated: Collection[str] = ()) -> bytes:
    """Compile C sources to a shared library for this host; equal sources give equal bytes.

    Parameters
    ----------
    sources : mapping of str to bytes
        The content of sources and headers by file name, all in one folder.
    generated : collection of str, optional
        The names of sources and headers that differ between FMUs. The object code of the sources
        that include none of them is kept in the cache folder for the next FMU, which is built in
        a quarter of the time. By default, nothing is kept.

    Raises
    ------
    FmuBuildError
        If there is no compiler, this is not 64-bit Linux, or the compiler fails.
    """
    if platform_tuple != HOST_TARGET:
        raise FmuBuildError(
            f"The C compiler of the host is used on {HOST_TARGET} only, but this is "
            f"{platform_tuple}; choose the platforms, for which zig compiles, or build with --kind "
            "source and compile the FMU with `fmpy compile`."
        )
    program, *arguments = find_compiler()
    compiler = Compiler(
        name=program,
        command=[program, *arguments, *_HOST_FLAGS],
        advice="set CC to another one",
    )
    if generated:
        command = [program, *arguments, *_HOST_CODE_FLAGS, "-r", "-nostdlib"]
        relocatable = replace(compiler, command=command, libraries=())
        sources = _with_kept_object_code(sources, generated, relocatable)
    return compiler.library(sources, "library.so")


def _with_kept_object_code(
    sources: Mapping[str, bytes], generated: Collection[str], compiler: Compiler
) -> dict[str, bytes]:
    """Return the sources with one object file in the place of those that all FMUs share.

    The file is read from the cache folder, or compiled and written there. Its name is a digest of
    all that it depends on: the compiler with its version and flags, sources and included headers.
    """
    read_for_unit = {
        name: _names_of_all_included(name, sources) for name in sources if name.endswith(".c")
    }
    shared = {name: read for name, read in read_for_unit.items() if read.isdisjoint(generated)}
    needed = {name: sources[name] for name in sorted(set().union(*shared.values()))}
    version = b""
    with suppress(OSError):  # without a version, the compiler fails below and says why
        program = [compiler.name, "--version"]
        version = subprocess.run(program, capture_output=True, check=False).stdout
    digest = hashlib.sha256(repr((compiler.command, version, needed)).encode()).hexdigest()
    path = cache_folder() / "objects" / f"{digest[:32]}.o"
    object_code = built_once(
        path,
        path.read_bytes,
        lambda: compiler.library(needed, "shared.o"),
        lambda content: atomic_write_bytes(path, content),
    )
    others = {name: content for name, content in sources.items() if name not in shared}
    return others | {"shared.o": object_code}


def _names_of_all_included(name: str, sources: Mapping[str, bytes]) -> set[str]:
    """Return the name of a source and the names of all files that it includes, also indirectly."""
    names = {name}
    unread = [name]
    while unread:
        for include in _INCLUDE.findall(sources[unread.pop()]):
            header = include.decode()
            if header in sources and header not in names:
                names.add(header)
                unread.append(header)
    return names
