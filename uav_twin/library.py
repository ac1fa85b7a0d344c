"""`uav-twin library`."""

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from reporting import terminal
from uav_twin.options import Replace

library_app = typer.Typer(no_args_is_help=True, help="Sample FMUs into observation libraries.")


@library_app.callback()
def library() -> None:
    """Sample FMUs into observation libraries."""


Scenario = Annotated[
    str | None,
    typer.Argument(help="A scenario, whose FMU is sampled at its states, controls and draws."),
]
Grid = Annotated[
    list[str] | None,
    typer.Option(
        help="NAME=VALUES with a name of the binding, such as wear=0,0.2,0.4 or wear=0:0.4:3; repeated.",
        show_default=False,
    ),
]
Role = Annotated[
    str | None, typer.Option(help="Observation of the binding, where it has several.", show_default=False)
]
Settle = Annotated[
    int,
    typer.Option(min=0, help="Steps from a fresh start at every point, for an FMU with memory."),
]
Workers = Annotated[int | None, typer.Option(min=1, help="Processes.", show_default="one for each processor")]
Resume = Annotated[bool, typer.Option("--resume", help="Go on with the blocks of an interrupted sampling.")]


@library_app.command("sample")
def sample(
    out: Annotated[Path, typer.Option(help="The NetCDF file to write.", show_default=False)],
    scenario: Scenario = None,
    fmu: Annotated[Path | None, typer.Option(help="The FMU to sample.", show_default=False)] = None,
    binding: Annotated[Path | None, typer.Option(help="Its binding.", show_default=False)] = None,
    grid: Grid = None,
    role: Role = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the draws of a scenario.")] = None,
    settle: Settle = 0,
    workers: Workers = None,
    resume: Resume = False,
    replace: Replace = False,
) -> None:
    """Ask an FMU for its observation at every draw, state and control; write an observation library."""
    from twin_master.assets.resolution import Overrides
    from twin_master.library.request import grid_of_fmu, grid_of_scenario
    from twin_master.library.sampling import blocks_folder, sample_library
    from twin_master.scenario.reading import load_scenario

    progress = terminal.progress()
    if resume and replace:
        raise typer.BadParameter("give either --resume or --replace.", param_hint="--resume")
    if scenario is None and (fmu is None or binding is None):
        raise typer.BadParameter("give a scenario, or --fmu and --binding.", param_hint="SCENARIO")
    try:
        with tempfile.TemporaryDirectory(prefix="uav_twin_library_") as folder:
            if scenario is not None:
                if role is not None:
                    raise typer.BadParameter("the scenario says what is observed.", param_hint="--role")
                wanted = grid_of_scenario(
                    load_scenario(scenario),
                    Path(folder),
                    grid or (),
                    overrides=Overrides(seed=seed, fmu=fmu, binding=binding),
                    settling_steps=settle,
                    progress=progress,
                )
            else:
                assert fmu is not None
                assert binding is not None
                wanted = grid_of_fmu(fmu, binding, grid or (), role=role, settling_steps=settle)
            outcome = sample_library(
                wanted, out, workers=workers, resume=resume, replace_existing=replace, progress=progress
            )
    except KeyboardInterrupt:
        kept = blocks_folder(out).is_dir()
        hint = "go on with the same command and --resume" if kept else "nothing was sampled yet"
        typer.secho(f"Interrupted; finished blocks are kept: {hint}.", fg="red", err=True)
        raise typer.Exit(terminal.INTERRUPTED) from None
    values = outcome.library.values
    note = f", {outcome.kept_blocks} of {outcome.block_count} blocks kept" if outcome.kept_blocks else ""
    terminal.say(
        f"{outcome.path}: {' x '.join(str(n) for n in values.shape)} (draws, states, controls, sensors), "
        f"{outcome.workers} processes, {outcome.seconds:.1f} s{note}, FMU {outcome.library.fmu_hash[:12]}"
    )
