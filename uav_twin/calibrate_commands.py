"""`uav-twin calibrate ...`."""

import typer

from uav_twin import calibrate_campaign, calibrate_ringdown, calibrate_simulate
from uav_twin.calibrate_wing import calibrate_wing

calibrate_app = typer.Typer(no_args_is_help=False)
calibrate_app.callback(invoke_without_command=True)(calibrate_wing)
calibrate_app.command("ringdown")(calibrate_ringdown.calibrate_ringdown)
calibrate_app.command("simulate")(calibrate_simulate.calibrate_simulate)
calibrate_app.command("campaign")(calibrate_campaign.calibrate_campaign)
