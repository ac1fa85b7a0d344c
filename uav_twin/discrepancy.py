"""`uav-twin discrepancy ...`: what a model lacks beside measured data, and the model with it (`apply`)."""

from pathlib import Path
from typing import Annotated

import typer

from reporting import terminal
from uav_twin.discrepancy_catalogue import convert, effects, example
from uav_twin.discrepancy_check import check
from uav_twin.discrepancy_import import import_files
from uav_twin.discrepancy_run import run
from uav_twin.options import Replace


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
    replace: Replace = False,
) -> None:  # fmt: skip
    """Write the model with the effect that was found and the parameters beside it."""
    from discrepancy.application import apply_verdict

    done = apply_verdict(verdict, out, member=member, replace=replace, progress=terminal.progress())
    terminal.say(f"{done.path}: {done.sentence}")
    if done.command:
        terminal.say(f"Next: {done.command}")


discrepancy_app = typer.Typer(
    no_args_is_help=True, help="Find, name, add and prove what a model lacks beside measured data."
)
discrepancy_app.command("run")(run)
discrepancy_app.command("apply")(apply)
discrepancy_app.command("check")(check)
discrepancy_app.command("effects")(effects)
discrepancy_app.command("example")(example)
discrepancy_app.command("import")(import_files)
discrepancy_app.command("convert")(convert)
