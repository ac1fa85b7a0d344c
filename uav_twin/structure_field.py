"""`uav-twin structure field`."""

from pathlib import Path
from typing import Annotated

import typer

from reporting import terminal
from uav_twin.structure_arguments import File, MemoryLimit, assembled


def field(
    file: File,
    out: Annotated[Path, typer.Option(help="The VTU file to write.", show_default=False)],
    at: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="A parameter, loss, mass or control that is not nominal; may come again.",
        ),
    ] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace the file if it exists.")] = False,
    memory_limit: MemoryLimit = None,
) -> None:
    """Solve the full structure under all its loads, and write its field as VTU for ParaView."""
    from fe.structure.field import write_structure_vtu
    from reporting.errors import FileNotWrittenError
    from reporting.files import write_error

    if out.exists() and not replace:
        raise FileNotWrittenError(f"{out} exists: choose another --out or give --replace.")
    structure = assembled(file, memory_limit)
    known = (*structure.parameters, *structure.regions, *structure.masses, *structure.controls)
    values = dict(_named(text, known) for text in at or ())
    for name, value in values.items():
        lost, stiffness = name in structure.regions, name in structure.parameters
        if (
            (lost and not 0.0 <= value < 1.0)
            or (stiffness and value <= 0.0)
            or (name in structure.masses and value < 0.0)
        ):
            wanted = "at least 0 and below 1" if lost else "above 0" if stiffness else "at least 0"
            raise typer.BadParameter(f"{name} must be {wanted}, but is {value:g}.", param_hint="--at")
    try:
        with terminal.progress().stage("Solving and writing the field"):
            write_structure_vtu(out, structure, values)
    except OSError as error:
        raise write_error(error, out) from error
    terminal.say(f"{out}: {len(structure.mesh.cells):,} cells, displacement, strain, material, region, loss")


def _named(text: str, known: tuple[str, ...]) -> tuple[str, float]:
    """Return name and value of `NAME=VALUE`."""
    name, sign, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        sign = ""
    if not sign or number != number or number in (float("inf"), -float("inf")):
        raise typer.BadParameter(f"{text!r} is not NAME=VALUE with a finite number.", param_hint="--at")
    if name not in known:
        raise typer.BadParameter(
            f"the structure has nothing named {name!r}; it has {', '.join(known)}.", param_hint="--at"
        )
    return name, number
