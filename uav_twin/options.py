"""What the commands of this package have in common."""

import typer

from reporting import terminal
from uav_twin.sentences import said

told = terminal.told_by("uav_twin")


def refuse_before(context: typer.Context) -> None:
    """Refuse options that stand before a sub-command, which would not see them; raises `BadParameter`."""
    sources = map(context.get_parameter_source, context.params)
    if any(source is not None and source.name == "COMMANDLINE" for source in sources):
        raise typer.BadParameter(said("options.before", context=context))
