"""`uav-twin scenarios` and `uav-twin scenario check`."""

from typing import Annotated

import typer

from reporting import terminal
from twin_master.command import Calibration

scenario_app = typer.Typer(no_args_is_help=True)


@scenario_app.callback()
def scenario() -> None:
    """Check a scenario before it is flown."""


def list_scenarios() -> None:
    """List the scenarios that are shipped."""
    from scenarios import scenario_files
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
def check(
    file: Annotated[
        str, typer.Argument(metavar="FILE", help="A scenario file, or a shipped name.", show_default=False)
    ],
    calibration: Calibration = None,
    json: terminal.Json = False,
) -> None:
    """Say what a scenario flies and believes, and what it takes; exit code 1 if anything is wrong with it."""
    from dataclasses import asdict

    from twin_master.assets.resolution import Overrides
    from twin_master.scenario.reading import load_scenario
    from twin_master.scenario_check import check_scenario

    found = check_scenario(load_scenario(file), Overrides(calibration=calibration))
    if json:
        terminal.print_json(asdict(found))
        return
    for line in (
        f"{found.name}: {found.title}",
        f"Flown: {found.flown}.",
        f"Believed: {found.believed}.",
        f"Uncertain: {found.uncertain}, {found.draws} draws.",
        f"State: {found.states} states, {', '.join(f'{n} ({c} levels)' for n, c in found.levels.items())}.",
        f"Controls: {', '.join(found.controls)}. Sensors: {found.sensors}.",
        f"Mission: {found.turns} {found.step_name}s, {found.prediction_steps} ahead.",
        f"Memory of the twin: about {found.memory / 2**20:.3g} MiB.",
    ):
        terminal.say(line)
