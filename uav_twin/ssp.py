"""`uav-twin ssp export` and `uav-twin ssp check`."""

from dataclasses import asdict
from pathlib import Path

import typer

from fmu_asset.errors import SspError
from reporting import terminal
from reporting.errors import ReportingError
from uav_twin import parts
from uav_twin.options import answer


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


def check(file: Path, *, json: bool = False) -> None:
    """Check an SSP file: archive, schemas, FMUs, connections, one step; exit code 1 if anything is wrong."""
    result = parts.check_ssp(file)
    for problem in result.problems:
        typer.secho(f"problem: {problem}", fg="red", err=True)
    answer("ssp check", {"passed": not result.problems} | asdict(result), json=json, file=file)
    if result.problems:
        raise typer.Exit(1)
