"""Compiling the C sources of an FMU to a shared library, the same bytes every time."""

import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, get_args

from fmpy import platform as fmi_platform

from fmu_asset.errors import FmuBuildError
from reporting.choices import require_one_of

COMPILERS = ("cc", "gcc", "clang")
"""Compilers that are tried in this order if the environment variable CC names none."""


Platform = Literal["linux64", "win64"]
"""Platforms that binaries are made for here; others compile the sources inside the FMU."""


PLATFORM: Platform = "linux64"
"""The platform that is compiled for by default, and on which every binary is made."""


CROSS_COMPILER = "x86_64-w64-mingw32-gcc"
"""Makes binaries for 64-bit Windows on Linux."""


_COMMON_FLAGS = (
    "-std=c11",
    "-O3",
    "-shared",
    "-fvisibility=hidden",
    "-ffp-contract=off",  # with fused multiplications the last bit would depend on the processor
    "-fno-math-errno",
    "-Wl,-s",
)


# The library must not depend on the place or time of the build, nor on what is installed where it
# runs.
FLAGS: Mapping[Platform, tuple[str, ...]] = {
    "linux64": (*_COMMON_FLAGS, "-fPIC", "-Wl,--build-id=none"),
    "win64": (*_COMMON_FLAGS, "-static-libgcc", "-Wl,--no-insert-timestamp"),
}


_LONGEST_BUILD_SECONDS = 300.0


_SHOWN_ERROR_LINES = 12


def find_compiler(platform: Platform = PLATFORM) -> list[str]:
    """Return the command of a C compiler: `$CC` if it is set, else the first one of `COMPILERS`.

    Parameters
    ----------
    platform : {"linux64", "win64"}
        The platform that it compiles for; for win64 there is one compiler only.

    Returns
    -------
    list of str
        The command, such as ["/usr/bin/cc"]; `$CC` may hold arguments.

    Raises
    ------
    FmuBuildError
        If there is no compiler.
    """
    require_one_of(platform, get_args(Platform), "platform")
    if platform != PLATFORM:
        cross_compiler = shutil.which(CROSS_COMPILER)
        if cross_compiler is None:
            raise FmuBuildError(
                f"A binary for 64-bit Windows needs {CROSS_COMPILER}, which was not found; install "
                "it (such as the package gcc-mingw-w64-x86-64), or build without --windows."
            )
        return [cross_compiler]
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
        "install one (such as the package gcc) or set CC, or build with --kind source and compile "
        "the FMU elsewhere."
    )


def compile_library(sources: Mapping[str, bytes], *, platform: Platform = PLATFORM) -> bytes:
    """Return the shared library of C sources; the same sources and compiler give the same bytes.

    Parameters
    ----------
    sources : mapping of str to bytes
        The content of the sources and headers by file name, all in one folder.
    platform : {"linux64", "win64"}
        The platform that the library runs on.

    Returns
    -------
    bytes
        The library.

    Raises
    ------
    FmuBuildError
        If there is no compiler, this is not 64-bit Linux, or the compiler fails.
    """
    require_one_of(platform, get_args(Platform), "platform")
    if fmi_platform != PLATFORM:
        raise FmuBuildError(
            f"Compiled FMUs are built on {PLATFORM} only, but this is {fmi_platform}; build with "
            "--kind source and compile the FMU with `fmpy compile`."
        )
    compiler = find_compiler(platform)
    with tempfile.TemporaryDirectory(prefix="uav-twin-cc-") as folder:
        for name, content in sources.items():
            (Path(folder) / name).write_bytes(content)
        units = sorted(name for name in sources if name.endswith(".c"))
        # Names relative to the working folder, so that no path gets into the library.
        command = [*compiler, *FLAGS[platform], "-o", "library.so", *units, "-lm"]
        failure = f"The C compiler {compiler[0]} could not be run ("
        with FmuBuildError.instead_of(
            OSError, subprocess.TimeoutExpired, before=failure, after=")."
        ):
            process = subprocess.run(
                command,
                cwd=folder,
                capture_output=True,
                text=True,
                timeout=_LONGEST_BUILD_SECONDS,
                check=False,
            )
        library = Path(folder) / "library.so"
        if process.returncode != 0 or not library.is_file():
            lines = (process.stderr or process.stdout).strip().splitlines()
            output = "\n  ".join(lines[:_SHOWN_ERROR_LINES])
            raise FmuBuildError(
                f"The C compiler {compiler[0]} failed with exit code {process.returncode}; set CC "
                "to another one. "
                f"It says:\n  {output}"
            )
        return library.read_bytes()
