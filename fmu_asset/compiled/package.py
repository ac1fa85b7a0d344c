"""The files of a compiled FMU: description, sources, headers of FMI, data file, and library.

The C sources in `sources` evaluate the reduced model. Models differ only in a data file and two
generated sources with the variables.
"""

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from importlib.metadata import distribution
from importlib.resources import files
from pathlib import Path
from typing import get_args

import numpy as np

from fe.runtime.arrays import FloatArray
from fe.runtime.reduced_arrays import ReducedArrays
from fmu_asset import description
from fmu_asset.errors import FmuBuildError
from fmu_asset.instances.plan import Interface
from fmu_asset.slaves.table import StructureRoles
from fmu_asset.slaves.variables import ENUMERATIONS, TRANSIENT, FmuVariable
from reporting.choices import require_one_of

from .compiler import compile_library
from .cross_compiler import cross_compile_library
from .platforms import FmiVersion, Platform, binary_name, host_binary_name, targets_by_folder

MAGIC = b"UAVTWIN\0"
VERSION = 2
NAME_BYTES = 32
_COUNT = struct.Struct("<II")

_NOT_IN_DATA_FILE = ("nominal", "damping", "validity_box", "followed_shapes")
"""Fields of the reduced model that the sources take from the variables, or do not need."""


def data_file_bytes(model: ReducedArrays) -> bytes:
    """Return the data file from which a compiled FMU reads its reduced model.

    Each array of the model is written under its name, and a scalar as an array without dimension.
    Of names (parameters, regions, masses, controls, gauges) only the counts are written. Empty
    arrays are left out. Equal models give equal bytes. `pack_arrays` defines the layout.
    """
    values: dict[str, object] = {}
    for field in fields(ReducedArrays):
        values[field.name] = getattr(model, field.name)
    names_to_choose = (model.parameters, model.regions, model.masses, model.controls)
    values["chosen_counts"] = [len(names) for names in names_to_choose]
    values["gauge_count"] = len(model.gauges)
    arrays = {}
    for name, value in values.items():
        if isinstance(value, str | tuple) or name in _NOT_IN_DATA_FILE:
            continue
        array = np.asarray(value, dtype=np.float64)
        if array.size:
            arrays[name] = array
    return pack_arrays(arrays)


def pack_arrays(arrays: Mapping[str, FloatArray]) -> bytes:
    """Return the bytes of a data file with the given arrays: magic, version, arrays and CRC-32.

    Parameters
    ----------
    arrays : mapping of str to ndarray
        Arrays of float64; a name has at most 31 ASCII letters.
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
    """Convert the variables of an FMU for co-simulation to those of one for model exchange.

    Parameters
    ----------
    table : sequence of FmuVariable
        The variables for co-simulation.
    mode_count : int
        Number M of modes.
    arrays : bool
        Whether the states are declared as arrays (FMI 3), with derivatives that are arrays, too.

    Returns
    -------
    tuple of FmuVariable
        The given variables, of which the health inputs become discrete and `response` starts as
        transient; then the 2 M states (mass-normalised coordinates of the modes, and their rates);
        then the 2 M derivatives of the states.
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


DATA_FILE = "resources/reduced_model.bin"
"""The name of the data file in the archive."""

VARIABLE_SOURCES = ("structure_variables.h", "structure_variables.c")
"""The generated sources, which differ between FMUs."""

_TIME = FmuVariable("time", 0, "Real", "independent", "continuous", "Time", unit="s")

HOST = "It is compiled C and needs nothing but the C library; its sources are inside."


def compiled_members(
    model: ReducedArrays,
    declaration: description.Declaration,
    roles: StructureRoles,
    *,
    fmi: FmiVersion = 2,
    interface: Interface = "co-simulation",
) -> dict[str, bytes]:
    """Return the files of a compiled FMU without its binary, with the placeholder for the hash.

    Parameters
    ----------
    declaration : Declaration
        The declarations for co-simulation.
    fmi : {2, 3}
        The version of FMI. The sources are the same except for its functions. In FMI 3, numbered
        variables, and inputs and outputs such as `health.z1`, are passed as arrays.
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
    table: Sequence[FmuVariable],
    roles: StructureRoles,
    arrays: Sequence[description.ArrayVariable] = (),
) -> dict[str, bytes]:
    """Return the C sources that declare the variables, with placeholders for GUID and content tag.

    Parameters
    ----------
    table : sequence of FmuVariable
        In the order of the value references.
    arrays : sequence of ArrayVariable
        Rows of the table that are passed together in FMI 3.

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
    return {name: description.rendered(name, **values) for name in VARIABLE_SOURCES}


def _common_sources(fmi: FmiVersion) -> dict[str, bytes]:
    """Return the C files that all compiled FMUs of a version of FMI share, by name."""
    other_version = 3 if fmi == 2 else 2
    sources = {}
    for entry in (files("fmu_asset.compiled") / "sources").iterdir():
        is_source = entry.name.endswith((".c", ".h"))
        if is_source and entry.name != f"structure_fmi{other_version}.c":
            sources[entry.name] = entry.read_bytes()
    return sources


def fmi_headers(fmi: FmiVersion = 2) -> dict[str, bytes]:
    """Return the C headers of a version of FMI by file name, as the package fmpy ships them.

    Each contains its licence (2-clause BSD).

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
    platforms: Sequence[Platform] | None = None,
) -> dict[str, bytes]:
    """Compile the sources among an FMU's files, and return the binaries by name.

    Parameters
    ----------
    members : mapping of str to bytes
        The files of the FMU.
    platforms : sequence of str, optional
        The platforms of the binaries, see `targets_by_folder`; zig compiles for them. By default,
        the C compiler of this host compiles for this host.

    Raises
    ------
    InvalidChoiceError
        If the version or a platform is unknown.
    FmuBuildError
        If a binary cannot be compiled.
    """
    require_one_of(fmi, get_args(FmiVersion), "fmi")
    sources = {}
    for name, content in members.items():
        if name.startswith("sources/"):
            sources[name.removeprefix("sources/")] = content
    if platforms is None:
        library = compile_library(sources, generated=VARIABLE_SOURCES)
        return {host_binary_name(identifier, fmi): library}
    binaries = {}
    for folder, targets in targets_by_folder(platforms, fmi).items():
        name = binary_name(folder, targets[0], identifier)
        binaries[name] = cross_compile_library(sources, targets)
    return binaries
