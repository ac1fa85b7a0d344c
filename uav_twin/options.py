"""What the commands of this package have in common."""

from typing import TYPE_CHECKING, Any

import typer

from reporting import terminal

if TYPE_CHECKING:
    from reporting.page import Words


def show(command: str, *, words: "Words | None" = None, **values: Any) -> None:
    """Print what a command found as `[printed]` of a file of words says, by default `words.toml` here.

    It lists blocks as `Words.told` takes them. A row of a table with `colours` has that of its first cell of
    which they hold one.
    """
    from reporting.page import Words

    words = words or Words("uav_twin")
    for kind, what in words.told(words.content["printed"][command], **values):
        if kind == "table":
            name, table = what
            colours = words.content["tables"][name].get("colours", {})
            styles = [next((colours[cell] for cell in row if cell in colours), "") for row in table.rows]
            terminal.print_table([column.name for column in table.columns], table.rows, styles)
        else:
            terminal.say(what)


def answer(command: str, record: dict[str, Any], *, json: bool, **values: Any) -> None:
    """Print a record as JSON, or as `show` does."""
    if json:
        terminal.print_json(record)
    else:
        show(command, record=record, **values)


def refused(text: str) -> typer.Exit:
    """Return the end of a command that found something wrong, and say what on the error stream."""
    typer.secho(text, fg="red", err=True)
    return typer.Exit(1)
