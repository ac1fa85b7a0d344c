"""The command line `uav-twin`."""

from typing import Annotated

import typer

from discrepancy.errors import DiscrepancyError
from reporting import terminal
from twin_master.command import guarded
from twin_master.command import run as run_command
from twin_master.fleet.command import compare, fleet_app
from twin_master.plan_command import design as design_command
from twin_master.plan_command import plan as plan_command
from twin_master.view_command import view as view_command
from twin_master.watch_command import watch as watch_command
from uav_twin.calibrate_commands import calibrate_app
from uav_twin.discrepancy import discrepancy_app
from uav_twin.fmu import fmu_app
from uav_twin.library import library_app
from uav_twin.scenarios import list_scenarios, scenario_app
from uav_twin.ssp import ssp_app
from uav_twin.structure import structure_app
from uav_twin.wing import wing_app

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="A digital twin of a structure that loses stiffness: a wing, a mesh of yours, or any FMU.",
)


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"uav-twin {version('uav-twin')}")
        raise typer.Exit


@app.callback()
def uav_twin(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Take what belongs to no command."""


app.command("run")(run_command)
app.command("plan")(plan_command)
app.command("design")(design_command)
app.command("view")(view_command)
app.command("watch")(watch_command)
app.command("compare")(compare)
app.command("scenarios")(list_scenarios)
app.add_typer(scenario_app, name="scenario", help="Check a scenario before it is flown.")
app.add_typer(wing_app, name="wing", help="Say what a wing weighs and how it vibrates; verify its model.")
app.add_typer(
    calibrate_app, name="calibrate", help="Tailor the model to one wing: all steps in order, or one of them."
)
app.add_typer(discrepancy_app, name="discrepancy")
app.add_typer(fleet_app, name="fleet")
app.add_typer(fmu_app, name="fmu")
app.add_typer(library_app, name="library")
app.add_typer(ssp_app, name="ssp")
app.add_typer(structure_app, name="structure")


def main() -> None:
    """Run `uav-twin`."""
    guarded(lambda: terminal.with_common_options(app)(prog_name="uav-twin"), DiscrepancyError)
