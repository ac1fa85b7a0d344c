"""`uav-twin library sample`."""

import tempfile
from pathlib import Path

import typer

from reporting import terminal
from uav_twin import parts
from uav_twin.options import show


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
    if resume and replace:
        raise typer.BadParameter("give either --resume or --replace.", param_hint="--resume")
    if scenario is not None and role is not None:
        raise typer.BadParameter("the scenario says what is observed.", param_hint="--role")
    try:
        with tempfile.TemporaryDirectory(prefix="uav_twin_library_") as folder:
            if scenario is not None:
                wanted = parts.grid_of_scenario(
                    parts.load_scenario(scenario),
                    Path(folder),
                    grid or (),
                    overrides=parts.Overrides(seed=seed, fmu=fmu, binding=binding),
                    settling_steps=settle,
                )
            elif fmu is None or binding is None:
                raise typer.BadParameter("give a scenario, or --fmu and --binding.", param_hint="SCENARIO")
            else:
                wanted = parts.grid_of_fmu(fmu, binding, grid or (), role=role, settling_steps=settle)
            found = parts.sample_library(
                wanted, out, workers=workers, resume=resume, replace_existing=replace
            )
    except KeyboardInterrupt:
        kept = parts.blocks_folder(out).is_dir()
        hint = "go on with the same command and --resume" if kept else "nothing was sampled yet"
        typer.secho(f"Interrupted; finished blocks are kept: {hint}.", fg="red", err=True)
        raise typer.Exit(terminal.INTERRUPTED) from None
    show("library", found=found, library=found.library)
