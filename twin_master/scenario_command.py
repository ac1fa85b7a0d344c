"""Commands `uav-twin scenarios` and `uav-twin scenario check`."""

from collections.abc import Mapping
from typing import Annotated

import typer

from reporting import terminal
from reporting.terminal import JsonOption
from scenarios import scenario_files
from twin_master.command_options import CalibrationOption, complete_scenario


def list_scenarios() -> None:
    """List the scenarios that are shipped.

    Example: `uav-twin scenarios`
    """
    from twin_master.scenario.reading import load_scenario

    files = scenario_files()
    rows = []
    for name, path in files.items():
        scenario = load_scenario(path).scenario
        levels = {factor.name: len(factor.levels) for factor in scenario.state}
        controls = ", ".join(scenario.control_names)
        steps = str(scenario.mission.steps)
        rows.append([name, scenario.mission.title, steps, _levels_in_words(levels), controls])
    terminal.print_table(["scenario", "title", "steps", "states", "controls"], rows)
    folder = next(iter(files.values())).parent
    terminal.say(f"The files, to copy and change: {folder}")


def _levels_in_words(levels: Mapping[str, int]) -> str:
    """Return the state factors with the number of their levels."""
    return ", ".join(f"{factor} ({count} levels)" for factor, count in levels.items())


def check_scenario(
    file: Annotated[
        str,
        typer.Argument(
            show_default=False,
            metavar="FILE",
            autocompletion=complete_scenario,
            help="A scenario file, or a shipped name.",
        ),
    ],
    *,
    calibration: CalibrationOption = None,
    json: JsonOption = False,
) -> None:
    """Say what a scenario flies, believes and takes; exit code 1 if anything is wrong with it.

    Example: `uav-twin scenario check level_turns`
    """
    from twin_master.scenario.reading import load_scenario
    from twin_master.workflow import check_scenario as scenario_record

    record = scenario_record(load_scenario(file), {"calibration": calibration})
    if json:
        terminal.print_json(record)
        return
    memory = record["memory"] / 2**20
    terminal.say(f"{record['name']}: {record['title']}")
    terminal.say(f"Flown: {record['flown']}.")
    terminal.say(f"Believed: {record['believed']}.")
    terminal.say(f"Uncertain: {record['uncertain']}, {record['draws']} draws.")
    terminal.say(f"State: {record['states']} states, {_levels_in_words(record['levels'])}.")
    terminal.say(f"Controls: {', '.join(record['controls'])}. Sensors: {record['sensors']}.")
    terminal.say(
        f"Mission: {record['steps']} {record['step_name']}s, {record['prediction_steps']} ahead."
    )
    terminal.say(f"Memory of the twin: about {memory:.3g} MiB.")
