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

    It lists blocks. `say` is a line, and `table` a table of the file that is printed where it has rows; `of`
    is an expression of the values that gives the rows, or what is said one by one, each as `row`. A block
    whose `when` is false is left out, and so is a line that is empty.
    """
    from reporting.page import Words, evaluated, rendered

    words = words or Words("uav_twin")
    for block in words.content["printed"][command]:
        if "when" in block and not evaluated(block["when"], **values):
            continue
        rows = evaluated(block["of"], **values) if "of" in block else None
        if "table" in block:
            columns, cells = words.table(block["table"], rows or (), **values)
            if cells:
                terminal.print_table([column.name for column in columns], cells)
            continue
        for row in (None,) if rows is None else rows:
            if line := rendered(block["say"], **values, row=row):
                terminal.say(line)


def say_packed(info: "FmuInfo") -> None:
    """Say where an FMU was written, and which it is."""
    terminal.say(f"{info.path}: {info.size / 1024:.0f} KiB, GUID {info.guid}, design {info.design_hash[:12]}")
