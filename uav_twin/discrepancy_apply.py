"""`uav-twin discrepancy apply`: the patched model of a verdict."""

from pathlib import Path
from typing import Annotated

import typer

from reporting import terminal


def apply(
    verdict: Annotated[
        Path, typer.Argument(help="Folder of a verdict, or its verdict.json.", show_default=False)
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="The file: .toml (a lumped model), .json (any model) or .fmu (a wing).",
                     show_default="MODEL_patched"),
    ] = None,
    member: Annotated[
        str | None, typer.Option(metavar="NAME", help="Of a group: which; the most probable by default.")
    ] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace the file if it exists.")] = False,
) -> None:  # fmt: skip
    """Write the model with the effect that was found and the parameters beside it."""
    from discrepancy.application import apply_verdict

    done = apply_verdict(verdict, out, member=member, replace=replace, progress=terminal.progress())
    terminal.say(f"{done.path}: {done.sentence}")
    if done.command:
        terminal.say(f"Next: {done.command}")
