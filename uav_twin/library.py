"""`uav-twin library`."""

import tempfile
from pathlib import Path

import typer

from reporting import terminal
from uav_twin.options import told

library_app = typer.Typer(no_args_is_help=True, help="Sample FMUs into observation libraries.")


@library_app.callback()
def library() -> None:
    """Sample FMUs into observation libraries."""


@library_app.command("sample")
@told("library sample")
def sample(
    scenario: str | None = None,
    *,
    out: Path,
    fmu: Path | None = None,
    binding: Path | None = None,
    grid: list[str] | None = None,
    role: str | None = None,
    seed: int | None = None,
    settle: int = 0,
    workers: int | None = None,
    resume: bool = False,
    replace: bool = False,
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
