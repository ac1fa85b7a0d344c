"""`uav-twin scenarios` and `uav-twin scenario check`; what a scenario flies as an SSP file, and sampled.

`uav-twin ssp export` and `check`, `uav-twin library sample`.
"""

import tempfile
from dataclasses import asdict
from pathlib import Path

import typer

from fmu_asset.errors import SspError
from reporting import terminal
from reporting.errors import ReportingError
from scenarios import scenario_files
from uav_twin import parts
from uav_twin.options import answer, show


def list_scenarios() -> None:
    """List the scenarios that are shipped."""
    files = scenario_files()
    shown = {name: parts.load_scenario(path).scenario for name, path in files.items()}
    show("scenarios", shown=shown, folder=next(iter(files.values())).parent)


def check(file: str, *, calibration: Path | None = None, json: bool = False) -> None:
    """Say what a scenario flies and believes, and what it takes; exit code 1 if anything is wrong with it."""
    record = parts.check_scenario(parts.load_scenario(file), {"calibration": calibration})
    answer("scenario check", record, json=json)


def export(what: str, *, out: Path, seed: int | None = None, replace: bool = False) -> None:
    """Write what a scenario flies, or the wing of a design, as an SSP 1.0 file: SSD, SSV, SSM and FMUs."""
    parts.checked_target(out, replace=replace, what="An SSP file", suffix=".ssp", error=SspError)
    if _is_design(what):
        path = parts.export_design(None if what == "uav_wing" else Path(what), out, replace_file=replace)
    else:
        path = parts.export_scenario(parts.load_scenario(what), out, seed=seed, replace_file=replace)
    terminal.say(f"{path}: {path.stat().st_size / 1024:.0f} KiB")


def _is_design(what: str) -> bool:
    """Return whether a name or path is that of a wing design: a TOML file without a mission."""
    try:
        return what == "uav_wing" or "planform" in parts.read_toml(what, ReportingError)
    except ReportingError:
        return False


def check_system(file: Path, *, json: bool = False) -> None:
    """Check an SSP file: archive, schemas, FMUs, connections, one step; exit code 1 if anything is wrong."""
    result = parts.check_ssp(file)
    for problem in result.problems:
        typer.secho(f"problem: {problem}", fg="red", err=True)
    answer("ssp check", {"passed": not result.problems} | asdict(result), json=json, file=file)
    if result.problems:
        raise typer.Exit(1)


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
