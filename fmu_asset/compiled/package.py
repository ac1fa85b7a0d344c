"""The files of a compiled FMU: description, sources, headers of FMI, data file, and library.

The C sources in `sources` evaluate the reduced model; what differs from one model to the next is a
data file and two generated sources with the variables.
"""

import os
import shlex
import shutil
import struct
import subprocess
import tempfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from importlib.metadata import distribution
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from fmpy import platform as fmi_platform

from fe.runtime.arrays import FloatArray
from fe.runtime.reduced_arrays import ReducedArrays
from fmu_asset import description
from fmu_asset.errors import FmuBuildError
from fmu_asset.instances.plan import Interface
from fmu_asset.slaves.table import Roles
from fmu_asset.slaves.variables import ENUMERATIONS, TRANSIENT, FmuVariable
from reporting.choices import require_one_of

MAGIC = b"UAVTWIN\0"
VERSION = 2
NAME_BYTES = 32
_COUNT = struct.Struct("<II")

_NOT_IN_DATA_FILE = ("nominal", "damping", "validity_box", "followed_shapes")
"""Fields of the reduced model that the sources take from the variables, or do not need."""


def data_file_bytes(model: ReducedArrays) -> bytes:
    """Return the content of the file from which a compiled FMU reads its reduced model.

    Equal models give equal bytes.

    Parameters
    ----------
    model : ReducedArrays
        The reduced structure. Its arrays are written under their names, scalars as arrays without
        dimension, and names as their counts; arrays without values are left out.

    Returns
    -------
    bytes
        Magic, version, arrays, CRC-32.
    """
    values: dict[str, Any] = {}
    for field in fields(ReducedArrays):
        values[field.name] = getattr(model, field.name)
    names_to_choose = (model.parameters, model.regions, model.masses, model.controls)
    values["chosen_counts"] = [len(names) for names in names_to_choose]
    values["gauge_count"] = len(model.gauges)
    arrays = {}
    for name, value in values.items():
        is_array = not isinstance(value, str | tuple) and np.size(value) > 0
        if is_array and name not in _NOT_IN_DATA_FILE:
            arrays[name] = np.asarray(value, dtype=np.float64)
    return pack_arrays(arrays)


def pack_arrays(arrays: Mapping[str, FloatArray]) -> bytes:
    """Return arrays as the bytes of a data file, which the sources of a compiled FMU read.

    Parameters
    ----------
    arrays : mapping of str to ndarray
        The arrays of float64 by name, which has at most 31 ASCII letters.

    Returns
    -------
    bytes
        The content of the file.
    """
    parts = [MAGIC, _COUNT.pack(VERSION, len(arrays))]
    for name in sorted(arrays):
        array = arrays[name]
        parts.append(name.encode("ascii")[: NAME_BYTES - 1].ljust(NAME_BYTES, b"\0"))
        parts.append(_COUNT.pack(array.ndim, 0))
        parts.append(struct.pack(f"<{array.ndim}Q", *array.shape))
        parts.append(np.ascontiguousarray(array, dtype="<f8").tobytes())
    content = b"".join(parts)
    return content + struct.pack("<I", zlib.crc32(content))


STATES = {"modal_displacement": "Coordinate", "modal_velocity": "Rate of the coordinate"}
"""The two states of each mode in model exchange, with their descriptions."""


def exchange_table(
    table: Sequence[FmuVariable], mode_count: int, *, arrays: bool = False
) -> tuple[FmuVariable, ...]:
    """Return the variables of an FMU for model exchange, where the modes are states.

    Parameters
    ----------
    table : sequence of FmuVariable
        The variables for co-simulation.
    mode_count : int
        Number M of modes.
    arrays : bool
        Whether the rows will become arrays, whose derivative is an array too.

    Returns
    -------
    tuple of FmuVariable
        The same variables with discrete health and the transient response, then 2 M states
        (coordinates of the modes and their rates, mass-normalised), then their 2 M derivatives.
    """
    rows = []
    for row in table:
        if row.causality == "input" and row.name.startswith("health."):
            rows.append(replace(row, variability="discrete"))
        elif row.name == "response":
            rows.append(replace(row, start=float(TRANSIENT)))
        else:
            rows.append(row)
    derivative_name = "der({})[{}]" if arrays else "der({}[{}])"
    for name_format, prefix in (("{}[{}]", ""), (derivative_name, "Derivative of: ")):
        for state, description_of_state in STATES.items():
            for mode in range(1, mode_count + 1):
                row = FmuVariable(
                    name=name_format.format(state, mode),
                    reference=len(rows),
                    kind="Real",
                    causality="local",
                    variability="continuous",
                    description=f"{prefix}{description_of_state} of mode {mode}, mass-normalised",
                )
                rows.append(row)
    return tuple(rows)


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


DATA_FILE = "resources/reduced_model.bin"
"""The name of the data file in the archive."""

FmiVersion = Literal[2, 3]
"""Versions of FMI that a compiled FMU can be of."""

_BINARY_NAMES: Mapping[tuple[FmiVersion, Platform], str] = {
    (2, "linux64"): "binaries/linux64/{}.so",
    (2, "win64"): "binaries/win64/{}.dll",
    (3, "linux64"): "binaries/x86_64-linux/{}.so",
    (3, "win64"): "binaries/x86_64-windows/{}.dll",
}
"""Names of binaries in the archive, with braces for the model identifier."""

_TIME = FmuVariable("time", 0, "Real", "independent", "continuous", "Time", unit="s")

HOST = "It is compiled C and needs nothing but the C library; its sources are inside."


def compiled_members(
    model: ReducedArrays,
    declaration: description.Declaration,
    roles: Roles,
    *,
    fmi: FmiVersion = 2,
    interface: Interface = "co-simulation",
) -> dict[str, bytes]:
    """Return the files of a compiled FMU without binary; a placeholder stands for the content hash.

    Parameters
    ----------
    model : ReducedArrays
        The reduced structure.
    declaration : Declaration
        What the FMU declares for co-simulation.
    roles : Roles
        The role of each of its variables.
    fmi : {2, 3}
        The version of FMI: the same sources but for its functions. In FMI 3, numbered variables,
        and inputs and outputs such as `health.z1`, pass as arrays.
    interface : {"co-simulation", "model-exchange"}
        The interface of the FMU; in model exchange the modes are states.

    Returns
    -------
    dict of str to bytes
        The content by name in the archive.

    Raises
    ------
    FmuBuildError
        If fmpy's headers are missing.
    """
    require_one_of(fmi, get_args(FmiVersion), "fmi")
    require_one_of(interface, get_args(Interface), "interface")
    # variables
    table = declaration.table
    if interface == "model-exchange":
        table = exchange_table(table, model.mode_count, arrays=fmi == 3)
    if fmi == 3:
        table = (*table, replace(_TIME, reference=len(table)))
    declaration = replace(declaration, table=table)
    arrays = description.arrays_of(table) if fmi == 3 else ()
    # sources, and the files that build them
    sources = _common_sources(fmi) | variable_sources(table, roles, arrays)
    source_names = sorted(name for name in sources if name.endswith(".c"))
    build_files = ("CMakeLists.txt",) if fmi == 2 else ("CMakeLists.txt", "buildDescription.xml")
    for name in build_files:
        sources[name] = description.rendered(
            name, identifier=declaration.identifier, sources=source_names, fmi=fmi
        )
    # archive
    members = description.description_members(
        declaration,
        generation_tool="uav-twin",
        host=HOST,
        source_files=source_names,
        fmi=fmi,
        arrays=arrays,
    )
    members[DATA_FILE] = data_file_bytes(model)
    for name, content in (sources | fmi_headers(fmi)).items():
        members[f"sources/{name}"] = content
    return members


def variable_sources(
    table: Sequence[FmuVariable], roles: Roles, arrays: Sequence[description.ArrayVariable] = ()
) -> dict[str, bytes]:
    """Return the C sources that declare the variables; placeholders stand for GUID and content tag.

    Parameters
    ----------
    table : sequence of FmuVariable
        The variables, in order of their value reference.
    roles : Roles
        The role of each of them.
    arrays : sequence of ArrayVariable
        The rows of the table that pass together, in FMI 3.

    Returns
    -------
    dict of str to bytes
        `structure_variables.h` and `structure_variables.c` by their names.
    """
    # An element's name in messages; the length of the array at its first element, 0 at the others.
    array_elements = {}
    for array in arrays:
        for index, row in enumerate(array.rows):
            length = len(array.rows) if index == 0 else 0
            array_elements[row.reference] = (f"{array.name}[{index + 1}]", length)
    values = {
        "table": table,
        "place": {row.name: row.reference for row in table},
        "roles": roles,
        "shown": array_elements,
        "token": description.PLACEHOLDER,
        "categories": description.LOG_CATEGORIES,
        "enumerations": ENUMERATIONS,
    }
    names = ("structure_variables.h", "structure_variables.c")
    return {name: description.rendered(name, **values) for name in names}


def _common_sources(fmi: FmiVersion) -> dict[str, bytes]:
    """Return the C files that every compiled FMU of a version of FMI has, by name."""
    other_version = 3 if fmi == 2 else 2
    sources = {}
    for entry in (files("fmu_asset.compiled") / "sources").iterdir():
        is_source = entry.name.endswith((".c", ".h"))
        if is_source and entry.name != f"structure_fmi{other_version}.c":
            sources[entry.name] = entry.read_bytes()
    return sources


def fmi_headers(fmi: FmiVersion = 2) -> dict[str, bytes]:
    """Return the headers of a version of FMI by name, from the installed fmpy.

    Their licence (2-clause BSD) is in them.

    Raises
    ------
    FmuBuildError
        If they are missing from the installation.
    """
    require_one_of(fmi, get_args(FmiVersion), "fmi")
    folder = Path(str(distribution("fmpy").locate_file("fmpy"))) / "c-code"
    headers = {path.name: path.read_bytes() for path in folder.glob(f"fmi{fmi}*.h")}
    if not headers:
        raise FmuBuildError(
            f"The headers of FMI {fmi} are missing from the installation of fmpy; install it again."
        )
    return headers


def compiled_binaries(
    members: Mapping[str, bytes],
    identifier: str,
    fmi: FmiVersion = 2,
    platforms: Sequence[Platform] = (PLATFORM,),
) -> dict[str, bytes]:
    """Return the binaries of a compiled FMU, made from the sources among its files.

    Parameters
    ----------
    members : mapping of str to bytes
        The files of the FMU.
    identifier : str
        The model identifier.
    fmi : {2, 3}
        The version of FMI.
    platforms : sequence of {"linux64", "win64"}
        The platforms that the FMU runs on.

    Returns
    -------
    dict of str to bytes
        Each binary under its name in the archive.

    Raises
    ------
    FmuBuildError
        If a binary cannot be compiled.
    """
    require_one_of(fmi, get_args(FmiVersion), "fmi")
    for platform in platforms:
        require_one_of(platform, get_args(Platform), "platforms")
    sources = {}
    for name, content in members.items():
        if name.startswith("sources/"):
            sources[name.removeprefix("sources/")] = content
    binaries = {}
    for platform in platforms:
        name = _BINARY_NAMES[fmi, platform].format(identifier)
        binaries[name] = compile_library(sources, platform=platform)
    return binaries
