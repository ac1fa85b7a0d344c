"""What goes into the compiled FMU: description, sources, FMI headers, data file."""

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from importlib.metadata import distribution
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import numpy.typing as npt

from fe.runtime.reduced_arrays import ReducedArrays
from fmu_asset.archive.fmu_file import DESIGN_RECORD, design_record
from fmu_asset.description import (
    Declaration,
    arrays_of,
    documentation_page,
    model_description,
    xml_bytes,
)
from fmu_asset.errors import FmuBuildError
from fmu_asset.instances.plan import Interface
from fmu_asset.slaves.table import Roles
from fmu_asset.slaves.variables import TRANSIENT, FmuVariable

from .compiler import PLATFORM, Platform, compile_library
from .variable_header import variable_sources

FloatArray = npt.NDArray[np.float64]

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
    values["chosen_counts"] = tuple(
        len(names) for names in (model.parameters, model.regions, model.masses, model.controls)
    )
    values["gauge_count"] = len(model.gauges)
    arrays = {
        name: np.asarray(value, dtype=np.float64)
        for name, value in values.items()
        if name not in _UNUSED and not isinstance(value, str) and np.size(value)
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


STATES = ("modal_displacement", "modal_velocity")


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
    states = [f"{name}[{mode}]" for name in STATES for mode in range(1, mode_count + 1)]
    rates = [f"der({name})[{mode}]" for name in STATES for mode in range(1, mode_count + 1)]
    for name in (*states, *(rates if arrays else (f"der({state})" for state in states))):
        what = "Coordinate" if "displacement" in name else "Rate of the coordinate"
        text = f"{what} of mode {name.partition('[')[2].partition(']')[0]}, mass-normalised"
        rows.append(
            FmuVariable(
                name=name,
                reference=len(rows),
                kind="Real",
                causality="local",
                variability="continuous",
                description=f"Derivative of: {text}" if name.startswith("der(") else text,
            )
        )
    return tuple(rows)


DATA_FILE = "resources/reduced_model.bin"

FmiVersion = Literal[2, 3]
"""Versions of FMI that a compiled FMU can be of."""

FMI_HEADERS: Mapping[FmiVersion, tuple[str, ...]] = {
    2: ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
    3: ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
}
"""The headers of FMI as fmpy ships them, with their licence (2-clause BSD) in them."""

_BINARIES: Mapping[tuple[FmiVersion, Platform], str] = {
    (2, "linux64"): "binaries/linux64/{}.so",
    (2, "win64"): "binaries/win64/{}.dll",
    (3, "linux64"): "binaries/x86_64-linux/{}.so",
    (3, "win64"): "binaries/x86_64-windows/{}.dll",
}

_TIME = FmuVariable(
    name="time",
    reference=0,
    kind="Real",
    causality="independent",
    variability="continuous",
    description="Time",
    unit="s",
)

HOST = "It is compiled C and needs nothing but the C library; its sources are inside."


def compiled_members(
    model: ReducedArrays,
    declared: Declaration,
    roles: Roles,
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
    roles : Roles
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
    sources, table = _sources(fmi), declared.table
    if interface == "model-exchange":
        table = exchange_table(table, model.mode_count, arrays=fmi == 3)
    if fmi == 3:
        table = (*table, replace(_TIME, reference=len(table)))
    declared = replace(declared, table=table)
    arrays = arrays_of(table) if fmi == 3 else ()
    sources |= variable_sources(table, roles, arrays)
    listed = sorted(name for name in sources if name.endswith(".c"))
    sources["CMakeLists.txt"] = _cmake_lists(declared.identifier, listed, fmi)
    if fmi == 3:
        sources["buildDescription.xml"] = _build_description(declared.identifier, listed)
    return {
        "modelDescription.xml": model_description(
            declared, generation_tool="uav-twin", source_files=listed, fmi=fmi, arrays=arrays
        ),
        "documentation/index.html": documentation_page(declared, HOST, fmi=fmi, interface=interface),
        DATA_FILE: data_file_bytes(model),
        f"resources/{DESIGN_RECORD}": design_record(model.design_hash),
        **{f"sources/{name}": content for name, content in sources.items()},
        **{f"sources/{name}": content for name, content in fmi_headers(fmi).items()},
    }


def _build_description(identifier: str, source_files: Sequence[str]) -> bytes:
    """Return sources/buildDescription.xml: which sources the binary of that identifier is made of."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = SubElement(root, "BuildConfiguration", modelIdentifier=identifier)
    listed = SubElement(configuration, "SourceFileSet", language="C11")
    for name in source_files:
        SubElement(listed, "SourceFile", name=name)
    return xml_bytes(root)


def _cmake_lists(identifier: str, names: Sequence[str], fmi: FmiVersion) -> bytes:
    """Return the CMake project that makes the binary of any platform, in its place beside the sources."""
    folder = (
        "${machine}-${system}" if fmi == 3 else "${system}64"  # FMI 2 has names for x86-64 alone
    )
    systems = {"Windows": "windows" if fmi == 3 else "win", "Darwin": "darwin"}
    named = "".join(
        f'elseif(CMAKE_SYSTEM_NAME STREQUAL "{k}")\n  set(system {v})\n' for k, v in systems.items()
    )
    text = f"""# cmake -S sources -B build && cmake --build build --config Release
cmake_minimum_required(VERSION 3.16)
project({identifier} C)
if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release)
endif()
set(system linux)
if(CMAKE_SYSTEM_NAME STREQUAL "Linux")
{named}endif()
set(machine x86_64)
if(CMAKE_SYSTEM_PROCESSOR MATCHES "arm64|aarch64")
  set(machine aarch64)
endif()
add_library({identifier} SHARED {" ".join(names)})
set_target_properties({identifier} PROPERTIES
  PREFIX "" C_STANDARD 11 C_VISIBILITY_PRESET hidden
  LIBRARY_OUTPUT_DIRECTORY "$<1:${{CMAKE_CURRENT_SOURCE_DIR}}/../binaries/{folder}>"
  RUNTIME_OUTPUT_DIRECTORY "$<1:${{CMAKE_CURRENT_SOURCE_DIR}}/../binaries/{folder}>")
if(APPLE)
  set_target_properties({identifier} PROPERTIES SUFFIX ".dylib")
endif()
if(NOT MSVC)
  # Fused multiplications would make the last bit depend on the processor that is compiled for.
  target_compile_options({identifier} PRIVATE -ffp-contract=off -fno-math-errno)
  target_link_libraries({identifier} PRIVATE m)
endif()
"""
    return text.encode()


def _sources(fmi: FmiVersion) -> dict[str, bytes]:
    """Return the C files that every compiled FMU of a version of FMI has, by name."""
    return {
        entry.name: entry.read_bytes()
        for entry in (files("fmu_asset.compiled") / "sources").iterdir()
        if entry.name.endswith((".c", ".h")) and entry.name != f"structure_fmi{5 - fmi}.c"
    }


def fmi_headers(fmi: FmiVersion = 2) -> dict[str, bytes]:
    """Return the headers of a version of FMI by name, from the installed fmpy.

    Raises
    ------
    FmuBuildError
        If they are missing from the installation.
    """
    folder = Path(str(distribution("fmpy").locate_file("fmpy"))) / "c-code"
    try:
        return {name: (folder / name).read_bytes() for name in FMI_HEADERS[fmi]}
    except OSError as error:
        raise FmuBuildError(
            f"The FMI header {error.filename} is missing from the installation of fmpy; install it again."
        ) from error


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
    sources = {
        name.removeprefix("sources/"): content
        for name, content in members.items()
        if name.startswith("sources/")
    }
    return {
        _BINARIES[fmi, platform].format(identifier): compile_library(sources, platform=platform)
        for platform in platforms
    }
