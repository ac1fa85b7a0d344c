"""`uav-twin discrepancy ...`: what a model lacks beside measured data."""

import typer

from uav_twin.discrepancy_apply import apply
from uav_twin.discrepancy_catalogue import convert, effects, example
from uav_twin.discrepancy_check import check
from uav_twin.discrepancy_import import import_files
from uav_twin.discrepancy_run import run

discrepancy_app = typer.Typer(
    no_args_is_help=True, help="Find, name, add and prove what a model lacks beside measured data."
)
discrepancy_app.command("run")(run)
discrepancy_app.command("apply")(apply)
discrepancy_app.command("check")(check)
discrepancy_app.command("effects")(effects)
discrepancy_app.command("example")(example)
discrepancy_app.command("import")(import_files)
discrepancy_app.command("convert")(convert)
