"""Making a shared library of C sources with the compiler at hand."""

import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from fmpy import platform as fmi_platform

from fmu_asset.errors import FmuBuildError, said

COMPILERS = ("cc", "gcc", "clang")
"""Tried in this order where the environment variable CC names none."""

Platform = Literal["linux64", "win64"]
"""What is compiled for here; other platforms compile the sources inside the FMU."""

PLATFORM: Platform = "linux64"
"""The platform that is compiled for by default, and on which every binary is made."""

CROSS_COMPILER = "x86_64-w64-mingw32-gcc"
"""Makes binaries for 64-bit Windows on Linux."""

# Fused multiplications would make the last bit depend on the processor that is compiled for.
_COMMON_FLAGS = (
    "-std=c11", "-O3", "-shared", "-fvisibility=hidden", "-ffp-contract=off", "-fno-math-errno", "-Wl,-s",
)  # fmt: skip

# Nothing that depends on the place or the time of the build, or that is not there where the FMU runs.
FLAGS: Mapping[Platform, tuple[str, ...]] = {
    "linux64": (*_COMMON_FLAGS, "-fPIC", "-Wl,--build-id=none"),
    "win64": (*_COMMON_FLAGS, "-static-libgcc", "-Wl,--no-insert-timestamp"),
}

_LONGEST_BUILD = 300.0
_SHOWN_ERROR_LINES = 12


def find_compiler(platform: Platform = PLATFORM) -> list[str]:
    """Return the command of a C compiler: `$CC` if it is set, else the first of `COMPILERS` that is there.

    Parameters
    ----------
    platform : {"linux64", "win64"}
        What it compiles for; for the latter there is one only.

    Returns
    -------
    list of str
        The command, such as ["/usr/bin/cc"]; `$CC` may hold arguments.

    Raises
    ------
    FmuBuildError
        If there is none.
    """
    if platform != PLATFORM:
        if program := shutil.which(CROSS_COMPILER):
            return [program]
        raise FmuBuildError(said("compiled.no_cross_compiler", CROSS_COMPILER=CROSS_COMPILER))
    given = shlex.split(os.environ.get("CC", ""))
    for command in [given] if given else [[name] for name in COMPILERS]:
        program = shutil.which(command[0])
        if program is not None:
            return [program, *command[1:]]
    looked_for = f"CC={os.environ['CC']}" if given else ", ".join(COMPILERS)
    raise FmuBuildError(said("compiled.no_compiler", looked_for=looked_for))


def compile_library(sources: Mapping[str, bytes], *, platform: Platform = PLATFORM) -> bytes:
    """Return the shared library of C sources; the same sources and compiler give the same bytes.

    Parameters
    ----------
    sources : mapping of str to bytes
        Content of the sources and headers by file name, all in one folder.
    platform : {"linux64", "win64"}
        What it is to run on.

    Returns
    -------
    bytes
        The library.

    Raises
    ------
    FmuBuildError
        If there is no compiler, this is not 64-bit Linux, or the compiler fails.
    """
    if fmi_platform != PLATFORM:
        raise FmuBuildError(said("compiled.platform", PLATFORM=PLATFORM, fmi_platform=fmi_platform))
    compiler = find_compiler(platform)
    with tempfile.TemporaryDirectory(prefix="uav-twin-cc-") as folder:
        for name, content in sources.items():
            (Path(folder) / name).write_bytes(content)
        units = sorted(name for name in sources if name.endswith(".c"))
        # Names relative to the working folder, so that no path gets into the library.
        command = [*compiler, *FLAGS[platform], "-o", "library.so", *units, "-lm"]
        try:
            done = subprocess.run(
                command, cwd=folder, capture_output=True, text=True, timeout=_LONGEST_BUILD, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise FmuBuildError(f"The C compiler {compiler[0]} could not be run ({error}).") from error
        library = Path(folder) / "library.so"
        if done.returncode != 0 or not library.is_file():
            lines = (done.stderr or done.stdout).strip().splitlines()[:_SHOWN_ERROR_LINES]
            raise FmuBuildError(
                f"The C compiler {compiler[0]} failed with exit code {done.returncode}; set CC to another "
                "one. It says:\n  " + "\n  ".join(lines)
            )
        return library.read_bytes()
