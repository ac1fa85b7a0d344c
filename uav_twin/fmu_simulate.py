"""`uav-twin fmu simulate`."""

from pathlib import Path
from typing import Annotated

import typer

from reporting import terminal


def simulate(
    file: Annotated[Path, typer.Argument(help="An FMU.", show_default=False)],
    binding: Annotated[Path, typer.Option(help="Its binding file.", show_default=False)],
    inputs: Annotated[
        Path,
        typer.Option(
            help="CSV: `time` (s, where each step begins) and the inputs by the binding's names.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path, typer.Option(help="The file to write: CSV, or NetCDF (.nc) with units.", show_default=False)
    ],
    in_process: Annotated[
        bool, typer.Option("--in-process", help="Faster, without protection from crashes and endless steps.")
    ] = False,
    step_timeout: Annotated[
        float | None, typer.Option(help="Wall-clock limit of a step in seconds.", min=0.0)
    ] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace the file if it exists.")] = False,
) -> None:
    """Simulate an FMU under input histories; inputs without a column keep their start values."""
    from fmu_asset.door.history_file import read_histories, write_history
    from fmu_asset.door.session import FmiAsset
    from fmu_asset.errors import FmuInputError

    if out.suffix not in (".csv", ".nc"):
        raise FmuInputError(f"{out} must end in .csv or .nc: choose another --out.")
    if out.exists() and not replace:
        raise FmuInputError(f"{out} exists: choose another --out or give --replace.")
    asset = FmiAsset(file, binding, isolated=not in_process, step_timeout=step_timeout)
    given = read_histories(inputs, asset.binding)
    with asset:
        history = asset.simulate(**given.roles, steps=given.steps, progress=terminal.progress())
        write_history(out, asset, history)
    end = history.time[-1] if len(history.time) else asset.time
    terminal.say(f"{out}: {len(history.time)} steps to t = {end:g} s.")
    if history.ended:
        terminal.say(history.ended)
