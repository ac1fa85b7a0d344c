"""The command line `uav-twin`: its commands in the order of the help, and how it ends."""

import inspect
from collections.abc import Callable
from typing import Annotated

import typer

from discrepancy.errors import DiscrepancyError
from reporting import terminal
from twin_master import (
    command,
    compare_command,
    fleet_command,
    plan_command,
    scenario_command,
    watch_command,
)
from uav_twin import (
    calibrate_commands,
    discrepancy_campaigns,
    discrepancy_commands,
    discrepancy_import,
    fmu,
    fmu_simulation,
    init_command,
    schema_command,
    structure,
    structure_from_deck,
    structure_suspects,
    wing_commands,
)
from uav_twin.cause_search import with_discrepancy_search

MISSIONS = "Missions: a twin flies, plans and watches"
MEASUREMENTS = "Measurements: calibrate a model, and find what it lacks"
MODELS = "Models: wings, structures and FMUs"


def _print_version(requested: bool) -> None:
    """Print the version and end, if the option was given."""
    if not requested:
        return
    from importlib.metadata import version

    typer.echo(f"uav-twin {version('uav-twin')}")
    raise typer.Exit


def _common_options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Accept the options before every command; `--version` acts by its callback."""


def _command_of_group(function: Callable[..., None]) -> Callable[..., None]:
    """Return a function as the command that runs if a group is called by its name alone.

    For example, `uav-twin calibrate` runs it, and `uav-twin calibrate simulate` does not. Typer
    also calls the function before each command of the group. It then only refuses its own options,
    as in `calibrate --seed 3 simulate`, where they would have no effect.
    """

    def command_of_group(context: typer.Context, **options: object) -> None:
        if context.invoked_subcommand is None:
            function(**options)
            return
        sources = [context.get_parameter_source(name) for name in context.params]
        if any(source is not None and source.name == "COMMANDLINE" for source in sources):
            raise typer.BadParameter(
                f"options go after the command: {context.info_name} {context.invoked_subcommand} "
                "..."
            )

    # Typer reads the options of a command from its signature: use that of the function, with the
    # parameter of the context before the others
    command_of_group.__doc__ = function.__doc__
    context_parameter = inspect.signature(command_of_group).parameters["context"]
    signature = inspect.signature(function)
    parameters = [context_parameter, *signature.parameters.values()]
    vars(command_of_group)["__signature__"] = signature.replace(parameters=parameters)
    return command_of_group


app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="A digital twin of a structure that loses stiffness: a wing, a mesh of yours, or any FMU.",
)
app.callback()(_common_options)


def _add_group(name: str, panel: str, text: str) -> typer.Typer:
    """Add a group of commands under a heading (`panel`) of the help, and return it."""
    group = typer.Typer(no_args_is_help=True, help=text)
    app.add_typer(group, name=name, rich_help_panel=panel)
    return group


def watch_with_search() -> Callable[..., None]:
    """Return the command `uav-twin watch`, which can look for the cause of its alarms.

    Typer reads the options of a command from its signature, and the search is not an option.
    """
    command_with_search = with_discrepancy_search(watch_command.watch)
    signature = inspect.signature(watch_command.watch)
    options = [option for name, option in signature.parameters.items() if name != "cause_search"]
    vars(command_with_search)["__signature__"] = signature.replace(parameters=options)
    return command_with_search


def _add_group_command(
    name: str, panel: str, text: str, function: Callable[..., None]
) -> typer.Typer:
    """Add a group of commands that is also a command itself, and return the group.

    `text` describes the group in the list of commands; its own help is the docstring of `function`,
    which runs if the group is called by its name alone.
    """
    group = typer.Typer()
    group.callback(invoke_without_command=True)(_command_of_group(function))
    app.add_typer(group, name=name, short_help=text, rich_help_panel=panel)
    return group


app.command("init", rich_help_panel=MISSIONS)(init_command.init)
app.command("run", rich_help_panel=MISSIONS)(command.run)
app.command("plan", rich_help_panel=MISSIONS)(plan_command.plan)
app.command("design", rich_help_panel=MISSIONS)(plan_command.design)
app.command("view", rich_help_panel=MISSIONS)(command.view)
app.command("watch", rich_help_panel=MISSIONS)(watch_with_search())
app.command("compare", rich_help_panel=MISSIONS)(compare_command.compare)
app.command("scenarios", rich_help_panel=MISSIONS)(scenario_command.list_scenarios)

scenario_group = _add_group("scenario", MISSIONS, "Check a scenario before it is flown.")
scenario_group.command("check")(scenario_command.check_scenario)

wing_group = _add_group_command(
    "wing",
    MODELS,
    "Print the mass and the modes of a wing; verify its model.",
    wing_commands.wing,
)
wing_group.command("verify")(wing_commands.verify_wing)

calibrate_group = _add_group_command(
    "calibrate",
    MEASUREMENTS,
    "Tailor the model to one wing: all steps in order, or one of them.",
    calibrate_commands.calibrate_wing,
)
calibrate_group.command("ringdown")(calibrate_commands.calibrate_ringdown)
calibrate_group.command("simulate")(calibrate_commands.calibrate_simulate)
calibrate_group.command("campaign")(calibrate_commands.calibrate_campaign)

discrepancy_group = _add_group(
    "discrepancy",
    MEASUREMENTS,
    "Find, name, add and prove what a model lacks compared with measured data.",
)
discrepancy_group.command("run")(discrepancy_commands.run)
discrepancy_group.command("apply")(discrepancy_commands.apply)
discrepancy_group.command("check")(discrepancy_commands.check)
discrepancy_group.command("effects")(discrepancy_campaigns.effects)
discrepancy_group.command("example")(discrepancy_campaigns.example)
discrepancy_group.command("import")(discrepancy_import.import_files)
discrepancy_group.command("convert")(discrepancy_campaigns.convert)

fleet_group = _add_group("fleet", MISSIONS, "Fly fleets of assets, and learn across them.")
fleet_group.command("watch")(fleet_command.watch)
fleet_group.command("run")(fleet_command.run)
fleet_group.command("learn")(fleet_command.learn)

fmu_group = _add_group("fmu", MODELS, "Build, describe, bind, check and simulate FMUs.")
fmu_group.command("build")(fmu.build)
fmu_group.command("info")(fmu.info)
fmu_group.command("bind")(fmu.bind)
fmu_group.command("check")(fmu.check)
fmu_group.command("simulate")(fmu_simulation.simulate)

library_group = _add_group("library", MODELS, "Sample FMUs into observation libraries.")
library_group.command("sample")(fmu_simulation.sample)

ssp_group = _add_group("ssp", MODELS, "Write, check and simulate systems of FMUs as SSP files.")
ssp_group.command("export")(fmu.export)
ssp_group.command("simulate")(fmu_simulation.simulate_system)
ssp_group.command("check")(fmu.check_system)

structure_group = _add_group(
    "structure",
    MODELS,
    "Look at a structure from a mesh or matrices, verify it against CalculiX, reduce it, pack it.",
)
structure_group.command("info")(structure.info)
structure_group.command("verify")(structure.verify)
structure_group.command("field")(structure.field)
structure_group.command("reduce")(structure.reduce)
structure_group.command("fmu")(structure.fmu)
structure_group.command("suspects")(structure_suspects.suspects)
structure_group.command("from-deck")(structure_from_deck.from_deck)


app.command("schema", rich_help_panel=MODELS)(schema_command.schema)


def main() -> None:
    """Run `uav-twin`."""
    command.run_command_line(
        lambda: terminal.with_common_options(app)(prog_name="uav-twin"), DiscrepancyError
    )
