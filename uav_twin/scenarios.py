"""`uav-twin scenarios`."""

from __future__ import annotations


def list_scenarios() -> None:
    """List the scenarios that are shipped."""
    from rich.console import Console
    from rich.table import Table

    from scenarios import scenario_files
    from twin_master.scenario_file import load_scenario

    table = Table("scenario", "title", "turns", "states", "controls")
    console = Console(highlight=False)
    for name, path in scenario_files().items():
        scenario = load_scenario(path).scenario
        table.add_row(
            name,
            scenario.mission.title,
            str(scenario.mission.steps),
            ", ".join(f"{factor.name} ({len(factor.levels)} levels)" for factor in scenario.state),
            ", ".join(scenario.control_names),
        )
    console.print(table)
    console.print(
        f"The files, to copy and change: {next(iter(scenario_files().values())).parent}", soft_wrap=True
    )
