"""Compiles the C sources of an FMU to a shared library, with the same bytes every time."""

import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from fmpy import platform_tuple

from fmu_asset.errors import FmuBuildError

from .platforms import HOST_TARGET

COMPILERS = ("cc", "gcc", "clang")
"""Compilers that are tried in this order if the environment variable CC names none."""

# The library must not depend on the place or time of the build, nor on what is installed where it
# runs.
COMMON_FLAGS = (
    "-std=c11",
    "-O3",
    "-shared",
    "-fvisibility=hidden",
    "-ffp-contract=off",  # with fused multiplications the last bit would depend on the processor
    "-fno-math-errno",
    "-Wl,-s",
)
"""Flags of every compiler of shared libraries."""

_HOST_FLAGS = (*COMMON_FLAGS, "-fPIC", "-Wl,--build-id=none")

_SHOWN_ERROR_LINES = 12


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
    """

    name: str
    command: Sequence[str]
    advice: str
    environment: Mapping[str, str] | None = None
    longest_seconds: float = 300.0

    def library(self, sources: Mapping[str, bytes], file_name: str) -> bytes:
        """Compile C sources to a shared library, and return its bytes.

        Parameters
        ----------
        sources : mapping of str to bytes
            The content of sources and headers by file name, all in one folder.
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
            units = sorted(name for name in sources if name.endswith(".c"))
            # Names relative to the working folder, so that no path gets into the library.
            words = [*self.command, "-o", file_name, *units, "-lm"]
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


def compile_library(sources: Mapping[str, bytes]) -> bytes:
    """Compile C sources to a shared library for this host; equal sources give equal bytes.

    Parameters
    ----------
    sources : mapping of str to bytes
        The content of sources and headers by file name, all in one folder.

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
    return compiler.library(sources, "library.so")
