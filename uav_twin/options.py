"""What the commands of this package have in common, and why their options are refused: a file of sentences."""

from typing import TYPE_CHECKING, Any

import typer

from reporting import terminal
from reporting.sentences import Sentences

if TYPE_CHECKING:
    from reporting.page import Words


def show(command: str, *, words: "Words | None" = None, **values: Any) -> None:
    """Print what a command found, see `terminal.show`; by default in the words of this package."""
    from reporting.page import Words

    terminal.show(command, words or Words("uav_twin"), **values)


def answer(command: str, record: dict[str, Any], *, json: bool, **values: Any) -> None:
    """Print a record as JSON, or as `show` does."""
    from reporting.page import Words

    terminal.answer(command, Words("uav_twin"), record, json=json, **values)


def refused(text: str) -> typer.Exit:
    """Return the end of a command that found something wrong, and say what on the error stream."""
    typer.secho(text, fg="red", err=True)
    return typer.Exit(1)


said = Sentences(__file__).said
