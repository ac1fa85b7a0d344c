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
    from reporting.files import refuse_existing, write_error

    refuse_existing(out, replace=replace)
    structure = assembled(file, memory_limit)
    known = (*structure.parameters, *structure.regions, *structure.masses, *structure.controls)
    values: dict[str, float] = {}
    for text in at or ():
        name, value = _named(text, known)
        if name in values:
            raise typer.BadParameter(f"{name} is given twice; give it once.", param_hint="--at")
        low, high = structure.ranges[name]
        if not low <= value <= high:
            raise typer.BadParameter(
                f"{name} must lie between {low:g} and {high:g}, but is {value:g}; give a value inside, or "
                "widen its range in the structure file.",
                param_hint="--at",
            )
        values[name] = value
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
