"""What the commands of this package have in common."""

from typing import TYPE_CHECKING, Any

import typer

from reporting import terminal

if TYPE_CHECKING:
    from reporting.page import Words


def show(command: str, *, words: "Words | None" = None, **values: Any) -> None:
    """Print what a command found as `[printed]` of a file of words says, by default `words.toml` here.

    It lists blocks. `say` is a line, and `table` a table of the file that is printed where it has rows; `of`
    is an expression of the values that gives the rows, or what is said one by one, each as `row`, and
    `colour` one of the style of a row. A block whose `when` is false is left out, and so is a line that is
    empty.
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
                colours = [rendered(block.get("colour", ""), **values, row=row) for row in rows or ()]
                terminal.print_table([column.name for column in columns], cells, colours)
            continue
        for row in (None,) if rows is None else rows:
            if line := rendered(block["say"], **values, row=row):
                terminal.say(line, bold=block.get("bold"))


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
