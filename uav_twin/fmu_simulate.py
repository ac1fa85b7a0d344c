"""`uav-twin fmu simulate`."""

from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from reporting import terminal
from uav_twin.simulated import (
    InProcess,
    InterpolationName,
    OutFile,
    PlotFile,
    Replace,
    draw,
    interpolated,
    refuse_files,
    say,
    values_of,
)


def simulate(
    file: Annotated[Path, typer.Argument(help="An FMU.", show_default=False)],
    binding: Annotated[
        Path | None, typer.Option(help="Its binding file; without one, all outputs in the FMU's units.")
    ] = None,
    inputs: Annotated[
        Path | None,
        typer.Option(help="CSV: `time` (s, where each step begins) and the inputs by the binding's names."),
    ] = None,
    out: OutFile = None,
    stop_time: Annotated[
        float | None, typer.Option(help="End in seconds; the FMU's own by default, or 1 s after the start.")
    ] = None,
    step_size: Annotated[
        float | None,
        typer.Option(help="Communication step size in seconds; the FMU's own by default.", min=0.0),
    ] = None,
    values: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A parameter (of any kind) or input of the FMU."),
    ] = None,
    plot: PlotFile = None,
    interpolation: InterpolationName = None,
    in_process: InProcess = False,
    step_timeout: Annotated[
        float | None, typer.Option(help="Wall-clock limit of a step in seconds.", min=0.0)
    ] = None,
    replace: Replace = False,
) -> None:
    """Simulate an FMU: its default experiment, or with --binding and --inputs under histories."""
    from fmu_asset.archive.fmu_file import read_fmu
    from fmu_asset.door.binding import load_binding
    from fmu_asset.door.experiment import default_experiment, fly, fly_histories
    from fmu_asset.door.history_file import read_histories, write_history
    from fmu_asset.door.session import FmiAsset

    refuse_files(out, plot, replace=replace)
    _refuse_mixture(
        binding, inputs, interpolation, others=stop_time is not None or step_size is not None or bool(values)
    )
    if binding is not None and inputs is not None:
        bound = interpolated(load_binding(binding), interpolation)
        asset = FmiAsset(file, bound, isolated=not in_process, step_timeout=step_timeout)
        given = read_histories(inputs, asset.binding)
    else:
        planned = default_experiment(
            read_fmu(file), stop_time=stop_time, step_size=step_size, values=values_of(values or [])
        )
        asset = FmiAsset(file, planned.binding, isolated=not in_process, step_timeout=step_timeout)
    with closing(asset):
        if inputs is not None:
            history = fly_histories(asset, given, terminal.progress())
        else:
            history = fly(asset, planned, terminal.progress())
        if out is not None:
            write_history(out, asset, (file.name, asset.description.sha256), history)
        if plot is not None:
            draw(plot, asset, history)
    say(asset, history, file, [out, plot])


def _refuse_mixture(
    binding: Path | None, inputs: Path | None, interpolation: str | None, *, others: bool
) -> None:
    """Refuse half of a simulation under histories, and one that is half without."""
    from fmu_asset.errors import FmuInputError

    if (binding is None) != (inputs is None):
        raise FmuInputError("--binding and --inputs go together: one names the columns of the other.")
    if binding is not None and others:
        raise FmuInputError(
            "--stop-time, --step-size and --set are for a simulation without --binding, which says these "
            "itself."
        )
    if interpolation is not None and inputs is None:
        raise FmuInputError("--interpolation says how inputs go on between the rows of --inputs: give these.")
