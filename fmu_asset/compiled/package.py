"""What goes into the compiled FMU: description, sources, FMI headers, data file, and their library."""

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
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from fmpy import platform as fmi_platform

from fe.runtime.arrays import FloatArray
from fe.runtime.reduced_arrays import ReducedArrays
from fmu_asset import description
from fmu_asset.errors import FmuBuildError, said
from fmu_asset.instances.plan import Interface
from fmu_asset.slaves.table import StructureRoles
from fmu_asset.slaves.variables import ENUMERATIONS, TRANSIENT, FmuVariable
from reporting.choices import require_one_of

MAGIC = b"UAVTWIN\0"
VERSION = 2
NAME_BYTES = 32
_COUNT = struct.Struct("<II")


_UNUSED = ("nominal", "damping", "validity_box", "followed_shapes")
"""What the sources take from the variables, or do not need."""


def data_file_bytes(model: ReducedArrays) -> bytes:
    """Return the content of the data file of a model; equal models give equal bytes.

    Parameters
    ----------
    model : ReducedArrays
        The reduced structure. Its arrays are written under their names, scalars as arrays without dimension,
        and how many of each kind can be chosen in the place of names; arrays without values are left out.

    Returns
    -------
    bytes
        Magic, version, arrays, CRC-32.
    """
    values: dict[str, Any] = {item.name: getattr(model, item.name) for item in fields(ReducedArrays)}
    values["chosen_counts"] = [
        len(names) for names in (model.parameters, model.regions, model.masses, model.controls)
    ]
    values["gauge_count"] = len(model.gauges)
    arrays = {
        name: np.asarray(value, dtype=np.float64)
        for name, value in values.items()
        if name not in _UNUSED and not isinstance(value, str | tuple) and np.size(value)
    }
    return pack_arrays(arrays)


def pack_arrays(arrays: Mapping[str, FloatArray]) -> bytes:
    """Return arrays as the bytes of a data file.

    Parameters
    ----------
    arrays : mapping of str to ndarray
        The arrays by name, at most 31 ASCII letters; float64.

    Returns
    -------
    bytes
        The file.
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
"""What the states of model exchange are of each mode."""


def exchange_table(
    table: Sequence[FmuVariable], mode_count: int, *, arrays: bool = False
) -> tuple[FmuVariable, ...]:
    """Return the table for model exchange.

    Parameters
    ----------
    table : sequence of FmuVariable
        That of co-simulation.
    mode_count : int
        Number M of modes.
    arrays : bool
        Whether the rows are to become arrays, whose derivative is an array too.

    Returns
    -------
    tuple of FmuVariable
        The same with discrete health and the transient response, then 2 M states (coordinates of the modes
        and their rates, mass-normalised) and as many derivatives of them.
    """
    rows = []
    for row in table:
        if row.causality == "input" and row.name.startswith("health."):
            row = replace(row, variability="discrete")
        elif row.name == "response":
            row = replace(row, start=float(TRANSIENT))
        rows.append(row)
    derivative = "der({})[{}]" if arrays else "der({}[{}])"
    for form, before in (("{}[{}]", ""), (derivative, "Derivative of: ")):
        for (name, what), mode in product(STATES.items(), range(1, mode_count + 1)):
            text = f"{before}{what} of mode {mode}, mass-normalised"
            rows.append(FmuVariable(form.format(name, mode), len(rows), "Real", "local", "continuous", text))
    return tuple(rows)


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
    require_one_of(platform, get_args(Platform), "platform")
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
    require_one_of(platform, get_args(Platform), "platform")
    if fmi_platform != PLATFORM:
        raise FmuBuildError(said("compiled.platform", PLATFORM=PLATFORM, fmi_platform=fmi_platform))
    compiler = find_compiler(platform)
    with tempfile.TemporaryDirectory(prefix="uav-twin-cc-") as folder:
        for name, content in sources.items():
            (Path(folder) / name).write_bytes(content)
        units = sorted(name for name in sources if name.endswith(".c"))
        # Names relative to the working folder, so that no path gets into the library.
        command = [*compiler, *FLAGS[platform], "-o", "library.so", *units, "-lm"]
        before = f"The C compiler {compiler[0]} could not be run ("
        with FmuBuildError.instead_of(OSError, subprocess.TimeoutExpired, before=before, after=")."):
            done = subprocess.run(
                command, cwd=folder, capture_output=True, text=True, timeout=_LONGEST_BUILD, check=False
            )
        library = Path(folder) / "library.so"
        if done.returncode != 0 or not library.is_file():
            lines = (done.stderr or done.stdout).strip().splitlines()[:_SHOWN_ERROR_LINES]
            raise FmuBuildError(
                f"The C compiler {compiler[0]} failed with exit code {done.returncode}; set CC to another "
                "one. It says:\n  " + "\n  ".join(lines)
            )
        return library.read_bytes()


DATA_FILE = "resources/reduced_model.bin"

FmiVersion = Literal[2, 3]
"""Versions of FMI that a compiled FMU can be of."""

_BINARIES: Mapping[tuple[FmiVersion, Platform], str] = {
    (2, "linux64"): "binaries/linux64/{}.so",
    (2, "win64"): "binaries/win64/{}.dll",
    (3, "linux64"): "binaries/x86_64-linux/{}.so",
    (3, "win64"): "binaries/x86_64-windows/{}.dll",
}

_TIME = FmuVariable("time", 0, "Real", "independent", "continuous", "Time", unit="s")

HOST = "It is compiled C and needs nothing but the C library; its sources are inside."


def compiled_members(
    model: ReducedArrays,
    declared: description.Declaration,
    roles: StructureRoles,
    *,
    fmi: FmiVersion = 2,
    interface: Interface = "co-simulation",
) -> dict[str, bytes]:
    """Return the files of a compiled FMU, all but its binary; a placeholder stands for the content hash.

    Parameters
    ----------
    model : ReducedArrays
        The reduced structure.
    declared : Declaration
        What it declares for co-simulation.
    roles : StructureRoles
        Which of its variables is what.
    fmi : {2, 3}
        Version of FMI: the same sources but for its functions. In 3 numbered variables, and inputs and
        outputs such as `health.z1`, pass as arrays.
    interface : {"co-simulation", "model-exchange"}
        How it is run; in model exchange the modes are states.

    Returns
    -------
    dict of str to bytes
        Content by name in the archive.

    Raises
    ------
    FmuBuildError
        If fmpy's headers are missing.
    """
    require_one_of(fmi, get_args(FmiVersion), "fmi")
    require_one_of(interface, get_args(Interface), "interface")
    sources, table = _sources(fmi), declared.table
    if interface == "model-exchange":
        table = exchange_table(table, model.mode_count, arrays=fmi == 3)
    if fmi == 3:
        table = (*table, replace(_TIME, reference=len(table)))
    declared = replace(declared, table=table)
    arrays = description.arrays_of(table) if fmi == 3 else ()
    sources |= variable_sources(table, roles, arrays)
    listed = sorted(name for name in sources if name.endswith(".c"))
    for name in ("CMakeLists.txt", "buildDescription.xml")[: fmi - 1]:
        sources[name] = description.rendered(name, identifier=declared.identifier, sources=listed, fmi=fmi)
    return {
        **description.description_members(
            declared, generation_tool="uav-twin", host=HOST, source_files=listed, fmi=fmi, arrays=arrays
        ),
        DATA_FILE: data_file_bytes(model),
        **{f"sources/{name}": content for name, content in sources.items()},
        **{f"sources/{name}": content for name, content in fmi_headers(fmi).items()},
    }


def variable_sources(
    table: Sequence[FmuVariable], roles: StructureRoles, arrays: Sequence[description.ArrayVariable] = ()
) -> dict[str, bytes]:
    """Return the C sources that say what the variables are; placeholders stand for GUID and content tag.

    Parameters
    ----------
    table : sequence of FmuVariable
        The variables, in order of their value reference.
    roles : StructureRoles
        Which of them is what.
    arrays : sequence of ArrayVariable
        Which rows of the table pass together, in FMI 3.

    Returns
    -------
    dict of str to bytes
        File name to content: `structure_variables.h` and `structure_variables.c`.
    """
    elements = {
        row.reference: (f"{array.name}[{index + 1}]", 0 if index else len(array.rows))
        for array in arrays
        for index, row in enumerate(array.rows)
    }
    values = {
        "table": table,
        "place": {row.name: row.reference for row in table},
        "roles": roles,
        "shown": elements,
        "token": description.PLACEHOLDER,
        "categories": description.LOG_CATEGORIES,
        "enumerations": ENUMERATIONS,
    }
    return {
        name: description.rendered(name, **values)
        for name in ("structure_variables.h", "structure_variables.c")
    }


def _sources(fmi: FmiVersion) -> dict[str, bytes]:
    """Return the C files that every compiled FMU of a version of FMI has, by name."""
    return {
        entry.name: entry.read_bytes()
        for entry in (files("fmu_asset.compiled") / "sources").iterdir()
        if entry.name.endswith((".c", ".h")) and entry.name != f"structure_fmi{5 - fmi}.c"
    }


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
    found = {path.name: path.read_bytes() for path in folder.glob(f"fmi{fmi}*.h")}
    if not found:
        raise FmuBuildError(said("compiled.no_headers", fmi=fmi))
    return found


def binaries_of(
    members: Mapping[str, bytes],
    identifier: str,
    fmi: FmiVersion = 2,
    platforms: Sequence[Platform] = (PLATFORM,),
) -> dict[str, bytes]:
    """Return the binaries of a compiled FMU, made of the sources among its files.

    Parameters
    ----------
    members : mapping of str to bytes
        The files of the FMU.
    identifier : str
        Model identifier.
    fmi : {2, 3}
        Version of FMI.
    platforms : sequence of {"linux64", "win64"}
        What it is to run on.

    Returns
    -------
    dict of str to bytes
        Each binary under its name in the archive.

    Raises
    ------
    FmuBuildError
        If one cannot be compiled.
    """
    require_one_of(fmi, get_args(FmiVersion), "fmi")
    for platform in platforms:
        require_one_of(platform, get_args(Platform), "platforms")
    sources = {
        name.removeprefix("sources/"): content
        for name, content in members.items()
        if name.startswith("sources/")
    }
    return {
        _BINARIES[fmi, platform].format(identifier): compile_library(sources, platform=platform)
        for platform in platforms
    }
