"""The command line `uav-twin`: the commands of `commands.toml`, and how it ends."""

import inspect
from collections.abc import Callable
from importlib import import_module
from typing import Annotated, Any

import typer

from discrepancy.errors import DiscrepancyError
from reporting import terminal
from twin_master.command import guarded
from uav_twin.options import said


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"uav-twin {version('uav-twin')}")
        raise typer.Exit


def _application() -> typer.Typer:
    """Return the command line that `commands.toml` lists."""
    whole = typer.Typer(
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        help="A digital twin of a structure that loses stiffness: a wing, a mesh of yours, or any FMU.",
    )
    whole.callback()(_uav_twin)
    groups = {"": whole}
    for words, table in terminal.commands_of("uav_twin").items():
        if "group" in table:
            groups[words] = typer.Typer(no_args_is_help="function" not in table, help=table["group"])
            whole.add_typer(groups[words], name=words)
        if "function" in table:
            module, _, name = table["function"].partition(":")
            function = terminal.as_command(words, getattr(import_module(module), name))
            group, _, last = words.rpartition(" ")
            if words in groups:
                groups[words].callback(invoke_without_command=True)(_alone(function))
            else:
                groups[group].command(last)(function)
    return whole


def _uav_twin(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Take what belongs to no command."""


def _alone(function: Callable[..., None]) -> Callable[..., None]:
    """Return the command of a group's own name; its options do not stand before a command of the group."""

    def alone(context: typer.Context, **given: Any) -> None:
        if context.invoked_subcommand is None:
            function(**given)
            return
        sources = map(context.get_parameter_source, context.params)
        if any(source is not None and source.name == "COMMANDLINE" for source in sources):
            raise typer.BadParameter(said("options.before", context=context))

    alone.__doc__ = function.__doc__
    own, signature = inspect.signature(alone).parameters["context"], inspect.signature(function)
    vars(alone)["__signature__"] = signature.replace(parameters=[own, *signature.parameters.values()])
    return alone


app = _application()


def main() -> None:
    """Run `uav-twin`."""
    guarded(lambda: terminal.with_common_options(app)(prog_name="uav-twin"), DiscrepancyError)
