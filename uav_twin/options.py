"""What the commands of this package have in common, and why options are refused: a file of sentences."""

from functools import partial

import typer

from reporting import terminal
from reporting.sentences import Sentences

said = Sentences(__file__).said
show = partial(terminal.show, words="uav_twin")
"""Prints what a command found, see `terminal.show`; by default in the words of this package."""
answer = partial(terminal.answer, words="uav_twin")
"""Prints a record as JSON, or as `show` does."""


def refused(text: str) -> typer.Exit:
    """Return the end of a command that found something wrong, and say what on the error stream."""
    typer.secho(text, fg="red", err=True)
    return typer.Exit(1)
