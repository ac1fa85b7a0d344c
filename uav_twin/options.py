"""What the commands of this package have in common."""

from typing import TYPE_CHECKING, Any

import typer

from reporting import terminal
from uav_twin.sentences import said

if TYPE_CHECKING:
    from fmu_asset.packing.contents import FmuInfo
    from reporting.page import Words

told = terminal.told_by("uav_twin")


def refuse_before(context: typer.Context) -> None:
    """Refuse options that stand before a sub-command, which would not see them; raises `BadParameter`."""
    sources = map(context.get_parameter_source, context.params)
    if any(source is not None and source.name == "COMMANDLINE" for source in sources):
        raise typer.BadParameter(said("options.before", context=context))


def show(command: str, *, words: "Words | None" = None, **values: Any) -> None:
    """Print what a command found as `[printed]` of a file of words says, by default `words.toml` here.

    It lists blocks as `Words.told` takes them.
    """
    from reporting.page import Words

    words = words or Words("uav_twin")
    for kind, what in words.told(words.content["printed"][command], **values):
        if kind == "table":
            terminal.print_table([column.name for column in what[1].columns], what[1].rows)
        else:
            terminal.say(what)


def say_packed(info: "FmuInfo") -> None:
    """Say where an FMU was written, and which it is."""
    terminal.say(f"{info.path}: {info.size / 1024:.0f} KiB, GUID {info.guid}, design {info.design_hash[:12]}")
