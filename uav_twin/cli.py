"""The command line `uav-twin`."""

from __future__ import annotations

import typer

from discrepancy.errors import DiscrepancyError
from twin_master.command import guarded
from twin_master.command import run as run_command
from uav_twin.calibrate import calibrate_app
from uav_twin.discrepancy import discrepancy_app
from uav_twin.fmu import fmu_app
from uav_twin.library import library_app
from uav_twin.scenarios import list_scenarios
from uav_twin.ssp import ssp_app
from uav_twin.wing import wing_app

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="A predictive structural digital twin of a UAV wing.",
)
app.command("run")(run_command)
app.command("scenarios")(list_scenarios)
app.add_typer(wing_app, name="wing")
app.add_typer(calibrate_app, name="calibrate")
app.add_typer(discrepancy_app, name="discrepancy")
app.add_typer(fmu_app, name="fmu")
app.add_typer(library_app, name="library")
app.add_typer(ssp_app, name="ssp")


def main() -> None:
    """Run `uav-twin`."""
    guarded(lambda: app(prog_name="uav-twin"), DiscrepancyError)
