"""What goes into the compiled FMU: description, sources, FMI headers, data file."""

from collections.abc import Mapping, Sequence
from importlib.metadata import distribution, version
from importlib.resources import files
from pathlib import Path

from fe.runtime.reduced_arrays import ReducedArrays
from fe.runtime.structure_arrays import StructureArrays
from fmu_asset.archive.design_record import DESIGN_RECORD, design_record
from fmu_asset.description import documentation_page, model_description
from fmu_asset.errors import FmuBuildError
from fmu_asset.slaves.variables import UNITS, FmuVariable, Unit

from .compiler import PLATFORM, compile_library
from .data_file import data_file_bytes
from .variable_header import Roles, variable_sources

DATA_FILE = "resources/reduced_model.bin"

FMI_HEADERS = ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h")
"""The headers of FMI 2.0 as fmpy ships them, with their licence (2-clause BSD) in them."""

HOST = "It is compiled C and needs nothing but the C library; its sources are inside."


def compiled_members(
    model: ReducedArrays | StructureArrays,
    table: Sequence[FmuVariable],
    roles: Roles,
    *,
    units: Sequence[Unit] = UNITS,
    model_name: str,
    identifier: str,
    guid: str,
    content_tag: str,
    description: str,
) -> dict[str, bytes]:
    """Return the files of a compiled FMU, all but its binary.

    Parameters
    ----------
    model : ReducedArrays or StructureArrays
        The reduced wing or structure.
    table : sequence of FmuVariable
        The variables, in order of their value reference.
    roles : Roles
        Which of them is what.
    units : sequence of Unit
        Units of the table.
    model_name, identifier : str
        Model name and model identifier.
    guid, content_tag : str
        GUID, and the mark of saved states; placeholders, as long as the content is not known.
    description : str
        One sentence for people.

    Returns
    -------
    dict of str to bytes
        Content by name in the archive.

    Raises
    ------
    FmuBuildError
        If fmpy's headers are missing.
    """
    sources = {
        entry.name: entry.read_bytes()
        for entry in (files("fmu_asset.compiled") / "sources").iterdir()
        if entry.name.endswith((".c", ".h"))
    }
    made = variable_sources(table, roles, guid=guid, content_tag=content_tag)
    sources |= {name: text.encode() for name, text in made.items()}
    return {
        "modelDescription.xml": model_description(
            model_name=model_name,
            identifier=identifier,
            guid=guid,
            table=table,
            units=units,
            description=description,
            version=version("uav-twin"),
            generation_tool="uav-twin",
            source_files=sorted(name for name in sources if name.endswith(".c")),
        ),
        "documentation/index.html": documentation_page(table, description, host=HOST),
        DATA_FILE: data_file_bytes(model),
        f"resources/{DESIGN_RECORD}": design_record(model.design_hash),
        **{f"sources/{name}": content for name, content in sources.items()},
        **{f"sources/{name}": content for name, content in fmi_headers().items()},
    }


def fmi_headers() -> dict[str, bytes]:
    """Return the headers of FMI 2.0 by name, from the installed fmpy.

    Raises
    ------
    FmuBuildError
        If they are missing from the installation.
    """
    folder = Path(str(distribution("fmpy").locate_file("fmpy"))) / "c-code"
    try:
        return {name: (folder / name).read_bytes() for name in FMI_HEADERS}
    except OSError as error:
        raise FmuBuildError(
            f"The FMI header {error.filename} is missing from the installation of fmpy; install it again."
        ) from error


def binary_of(members: Mapping[str, bytes], identifier: str) -> dict[str, bytes]:
    """Return the binary of a compiled FMU, made of the sources among its files.

    Parameters
    ----------
    members : mapping of str to bytes
        The files of the FMU.
    identifier : str
        Model identifier.

    Returns
    -------
    dict of str to bytes
        The binary under its name in the archive.

    Raises
    ------
    FmuBuildError
        If it cannot be compiled.
    """
    sources = {
        name.removeprefix("sources/"): content
        for name, content in members.items()
        if name.startswith("sources/")
    }
    return {f"binaries/{PLATFORM}/{identifier}.so": compile_library(sources)}
