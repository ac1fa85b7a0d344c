"""The command line `uav-twin`: the commands of `commands.toml`, and how it ends."""

import inspect
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Annotated

import typer

from discrepancy.errors import DiscrepancyError
from reporting import terminal
from twin_master.command import run_command_line


def _print_version(requested: bool) -> None:
    """Print the version and end, if the option was given."""
    if not requested:
        return
    from importlib.metadata import version

    typer.echo(f"uav-twin {version('uav-twin')}")
    raise typer.Exit


def _application() -> typer.Typer:
    """Return the command line with the commands and groups that `commands.toml` lists."""
    application = typer.Typer(
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        help=(
            "A digital twin of a structure that loses stiffness: a wing, a mesh of yours, or any "
            "FMU."
        ),
    )
    application.callback()(_common_options)
    groups = {"": application}
    for words, table in terminal.commands_of("uav_twin").items():
        is_command = "function" in table
        if "group" in table:
            groups[words] = typer.Typer(no_args_is_help=not is_command, help=table["group"])
            application.add_typer(groups[words], name=words)
        if is_command:
            _add_command(groups, words, table["function"])
    return application


def _add_command(groups: Mapping[str, typer.Typer], words: str, location: str) -> None:
    """Add a command to its group.

    Parameters
    ----------
    groups : mapping of str to Typer
        The groups by the words that call them; the application itself is "".
    words : str
        The words that call the command. Those of a group call it without a command of the group.
    location : str
        Where the function of the command is, "module:name".
    """
    module, _, name = location.partition(":")
    function = terminal.as_command(words, getattr(import_module(module), name))
    if words in groups:
        groups[words].callback(invoke_without_command=True)(_command_of_group(function))
        return
    group, _, last_word = words.rpartition(" ")
    groups[group].command(last_word)(function)


def _common_options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Take the options that belong to no command."""


def _command_of_group(function: Callable[..., None]) -> Callable[..., None]:
    """Return the command that has the name of a group, such as `calibrate`.

    It runs where no command of the group is called. Its own options may not stand before such a
    command.
    """

    def command(context: typer.Context, **options: object) -> None:
        if context.invoked_subcommand is None:
            function(**options)
            return
        sources = [context.get_parameter_source(name) for name in context.params]
        if any(source is not None and source.name == "COMMANDLINE" for source in sources):
            raise typer.BadParameter(
                "options go behind the command: "
                f"{context.info_name} {context.invoked_subcommand} ..."
            )

    # Typer reads the options of a command from its signature
    command.__doc__ = function.__doc__
    context_parameter = inspect.signature(command).parameters["context"]
    signature = inspect.signature(function)
    parameters = [context_parameter, *signature.parameters.values()]
    vars(command)["__signature__"] = signature.replace(parameters=parameters)
    return command


app = _application()


def main() -> None:
    """Run `uav-twin`."""
    run_command_line(
        lambda: terminal.with_common_options(app)(prog_name="uav-twin"), DiscrepancyError
    )
