"""`uav-twin ssp ...`."""

import tempfile
from dataclasses import asdict
from pathlib import Path

import typer

from fmu_asset.errors import FmuInputError, SspError
from reporting import terminal
from reporting.errors import ReportingError
from reporting.toml_file import read_toml
from uav_twin.options import show, told
from uav_twin.simulated import (
    finish,
    interpolated,
    refuse_files,
    values_of,
)

ssp_app = typer.Typer(no_args_is_help=True, help="Write, check and simulate systems of FMUs as SSP files.")


@ssp_app.command("export")
@told("ssp export")
def export(what: str, *, out: Path, seed: int | None = None, replace: bool = False) -> None:
    """Write what a scenario flies, or the wing of a design, as an SSP 1.0 file: SSD, SSV, SSM and FMUs."""
    from fmu_asset.packing.contents import checked_target
    from twin_master.assets.system_export import export_design, export_scenario
    from twin_master.scenario.reading import load_scenario

    checked_target(out, replace=replace, what="An SSP file", suffix=".ssp", error=SspError)
    progress = terminal.progress()
    if _is_design(what):
        design = None if what == "uav_wing" else Path(what)
        path = export_design(design, out, replace_file=replace, progress=progress)
    else:
        path = export_scenario(load_scenario(what), out, seed=seed, replace_file=replace, progress=progress)
    terminal.say(f"{path}: {path.stat().st_size / 1024:.0f} KiB")


def _is_design(what: str) -> bool:
    """Return whether a name or path is that of a wing design: a TOML file without a mission."""
    if what == "uav_wing":
        return True
    try:
        return "planform" in read_toml(what, ReportingError)
    except ReportingError:
        return False


@ssp_app.command("simulate")
@told("ssp simulate")
def simulate(
    file: Path,
    *,
    out: Path | None = None,
    stop_time: float | None = None,
    step_size: float | None = None,
    values: list[str] | None = None,
    plot: Path | None = None,
    algorithm: str = "gauss_seidel",
    iterations: int = 1,
    delay: list[str] | None = None,
    interpolation: str | None = None,
    in_process: bool = False,
    replace: bool = False,
) -> None:
    """Simulate the system of an SSP file from its start; all outputs of the system and its components."""
    from fmu_asset.coupling.asset import CoupledAsset
    from fmu_asset.coupling.system import system_description
    from fmu_asset.door.experiment import default_experiment, fly
    from fmu_asset.ssp.check import join_ssp, left_out_sentence
    from fmu_asset.ssp.reader import read_ssp
    from reporting.provenance import hash_file

    refuse_files(out, plot, replace=replace)
    given = _single_numbers(values or [])
    with tempfile.TemporaryDirectory() as folder:
        wiring = join_ssp(read_ssp(file, folder), delay or ())
        if left_out := left_out_sentence(wiring, file):
            terminal.say(f"warning: {left_out}")
        described = system_description(wiring)
        planned = default_experiment(described, stop_time=stop_time, step_size=step_size, values=given)
        with CoupledAsset(
            wiring,
            interpolated(planned.binding, interpolation),
            algorithm=algorithm,  # type: ignore[arg-type]  # said by itself
            iterations=iterations,
            isolated=not in_process,
            parameters=planned.parameters,
        ) as asset:
            history = fly(asset, planned, terminal.progress())
            finish(asset, history, (file, hash_file(file)), out, plot)


def _single_numbers(texts: list[str]) -> dict[str, float]:

    found: dict[str, float] = {}
    for name, value in values_of(texts).items():
        if isinstance(value, list):
            raise FmuInputError(f"--set {name} has {len(value)} values; ends of a system take one number.")
        found[name] = value
    return found


@ssp_app.command("check")
@told("ssp check")
def check(file: Path, *, json: bool = False) -> None:
    """Check an SSP file: archive, schemas, FMUs, connections, one step; exit code 1 if anything is wrong."""
    from fmu_asset.ssp.check import check_ssp

    result = check_ssp(file)
    for problem in result.problems:
        typer.secho(f"problem: {problem}", fg="red", err=True)
    if json:
        terminal.print_json({"passed": not result.problems} | asdict(result))
    else:
        show("ssp check", file=file, result=result)
    if result.problems:
        raise typer.Exit(1)
