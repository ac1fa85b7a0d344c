"""`uav-twin structure fmu`."""

from pathlib import Path
from typing import Annotated

import typer

from reporting import terminal
from uav_twin.structure_arguments import File, MemoryLimit, reduced


def fmu(
    file: File,
    out: Annotated[
        Path | None,
        typer.Option(help="The FMU to write; by default beside the structure file, with its name."),
    ] = None,
    binding: Annotated[
        Path | None, typer.Option(help="Write the binding of the FMU to this file, too.")
    ] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace the files if they exist.")] = False,
    memory_limit: MemoryLimit = None,
) -> None:
    """Pack the reduced model of a structure as an FMI 2.0 FMU; equal input gives equal bytes."""
    from fmu_asset.packing.contents import checked_target
    from fmu_asset.structures.binding import names_of_model, structure_binding_text
    from fmu_asset.structures.build import build_structure_fmu
    from reporting.errors import FileNotWrittenError
    from reporting.files import atomic_write_text

    target = checked_target(file.with_suffix(".fmu") if out is None else out, replace=replace)
    if binding is not None and binding.exists() and not replace:
        raise FileNotWrittenError(f"{binding} exists: choose another --binding or give --replace.")
    model = reduced(file, memory_limit)
    info = build_structure_fmu(model, target, replace=replace)
    terminal.say(f"{info.path}: {info.size / 1024:.0f} KiB, GUID {info.guid}, design {info.design_hash[:12]}")
    if binding is not None:
        atomic_write_text(binding, structure_binding_text(names_of_model(model)))
        terminal.say(f"{binding}: its binding")
