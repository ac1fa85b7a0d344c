"""`uav-twin fmu bind`."""

from pathlib import Path
from typing import Annotated

import typer

from reporting import terminal


def bind(
    file: Annotated[Path, typer.Argument(help="An FMU.", show_default=False)],
    out: Annotated[
        Path | None, typer.Option(help="The binding file to write; on the terminal by default.")
    ] = None,
    step_size: Annotated[
        float | None,
        typer.Option(help="Communication step size in seconds; the FMU's own by default.", min=0.0),
    ] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace the file if it exists.")] = False,
) -> None:
    """Draft a binding for an FMU: which variable is which role, in which unit."""
    import gc

    from fmu_asset.archive.fmu_file import read_fmu
    from fmu_asset.door.draft import draft_binding
    from reporting.files import atomic_write_text, refuse_existing

    refuse_existing(out, replace=replace)
    gc.disable()  # of 100,000 variables nothing is garbage, and looking for it takes a third of the time
    try:
        text = draft_binding(read_fmu(file), step_size=step_size)
    finally:
        gc.enable()
    if out is None:
        typer.echo(text, nl=False)
        return
    atomic_write_text(out, text)
    terminal.say(f"{out}: drafted; correct the roles, then run `uav-twin fmu check {file} --binding {out}`.")
