"""`uav-twin scenarios` and `uav-twin scenario check`."""

from pathlib import Path

import typer

from reporting import terminal
from scenarios import scenario_files
from uav_twin.options import show, told

scenario_app = typer.Typer(no_args_is_help=True)


@scenario_app.callback()
def scenario() -> None:
    """Check a scenario before it is flown."""


@told("scenarios")
def list_scenarios() -> None:
    """List the scenarios that are shipped."""
    from twin_master.scenario.reading import load_scenario

    rows = []
    for name, path in scenario_files().items():
        scenario = load_scenario(path).scenario
        rows.append(
            (
                name,
                scenario.mission.title,
                str(scenario.mission.steps),
                ", ".join(f"{factor.name} ({len(factor.levels)} levels)" for factor in scenario.state),
                ", ".join(scenario.control_names),
            )
        )
    terminal.print_table(("scenario", "title", "turns", "states", "controls"), rows)
    terminal.say(f"The files, to copy and change: {next(iter(scenario_files().values())).parent}")


@scenario_app.command("check")
@told("scenario check")
def check(file: str, *, calibration: Path | None = None, json: bool = False) -> None:
    """Say what a scenario flies and believes, and what it takes; exit code 1 if anything is wrong with it."""
    from twin_master.assets.resolution import Overrides
    from twin_master.scenario.reading import load_scenario
    from twin_master.scenario_check import check_scenario

    found = check_scenario(load_scenario(file), Overrides(calibration=calibration))
    if json:
        terminal.print_json(found)
    else:
        show("scenario check", **found)
