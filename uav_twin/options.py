"""What the commands of this package have in common, and why options are refused: a file of sentences."""

from typing import TYPE_CHECKING, Any

import typer

from reporting import terminal
from reporting.sentences import Sentences

if TYPE_CHECKING:
    from reporting.page import Words

said = Sentences(__file__).said


def show(command: str, *, words: "Words | None" = None, **values: Any) -> None:
    """Print what a command found, see `terminal.show`; by default in the words of this package."""
    terminal.show(command, words or "uav_twin", **values)


def answer(command: str, record: dict[str, Any], *, json: bool, **values: Any) -> None:
    """Print a record as JSON, or as `show` does."""
    terminal.answer(command, "uav_twin", record, json=json, **values)


def refused(text: str) -> typer.Exit:
    """Return the end of a command that found something wrong, and say what on the error stream."""
    typer.secho(text, fg="red", err=True)
    return typer.Exit(1)
