"""What the commands of `uav-twin structure` share."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from reporting import terminal

if TYPE_CHECKING:
    from fe.runtime.reduced import ReducedModel
    from fe.structure.affine import DesignedStructure
    from fe.structure.operators import Structure

File = Annotated[
    Path,
    typer.Argument(
        help="A structure file (TOML) beside its mesh or matrices, or a shipped one.", show_default=False
    ),
]
MemoryLimit = Annotated[
    float | None, typer.Option(min=0.1, help="GiB that it may take; what the machine has left by default.")
]


def located(file: Path) -> Path:
    """Return a structure file, or the shipped one of that name where there is no such file."""
    from scenarios import structure_files

    return file if file.exists() else structure_files().get(str(file), file)


def names_structure(design: Path) -> bool:
    """Return whether a design is that of a structure, and not of a wing."""
    from fe.runtime.errors import DesignFileError
    from fe.structure.design import is_structure
    from reporting.toml_file import read_toml

    return is_structure(read_toml(located(design), DesignFileError, what="wing design"))


def assembled(file: Path, memory_limit: float | None, *, mass_as_stiffness: bool = False) -> "Structure":
    """Return the full model of a mesh; `memory_limit` in GiB."""
    from fe.structure.operators import load_and_assemble

    with terminal.progress().stage("Reading the mesh and assembling"):
        return load_and_assemble(located(file), _bytes(memory_limit), mass_as_stiffness=mass_as_stiffness)


def assembled_of_any(file: Path, memory_limit: float | None) -> "DesignedStructure":
    """Return the full model of a mesh or of matrices; `memory_limit` in GiB."""
    from fe.structure.operators import assemble_structure

    with terminal.progress().stage("Reading and assembling"):
        return assemble_structure(located(file), _bytes(memory_limit))


def reduced(file: Path, memory_limit: float | None) -> "ReducedModel":
    """Return the reduced model, from the cache where it is there."""
    from fe.reduction.model_cache import reduced_structure

    return reduced_structure(located(file), progress=terminal.progress(), memory_limit=_bytes(memory_limit))


def _bytes(memory_limit: float | None) -> float | None:
    from fe.structure.mesh_file import GIB

    return None if memory_limit is None else memory_limit * GIB
